"""The parameters that a motion can tell: independent combinations of a model's.

Many of a model's parameters move the torques alike, or not at all. A rank-revealing decomposition
of its regressor in many random states finds a set of columns that are independent, and how the
others follow from these (Gautier 1991, Numerical calculation of the base inertial parameters of
robots); Businger and Golub's pivots (1965) and columns of equal length make the choice sound.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import qr, solve_triangular

from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import Motion
from visioncal.types import FloatArray, IntArray

# States that stand for all, and their greatest speeds [rad/s] and accelerations [rad/s^2]; at these
# gravity, speed and acceleration have like shares in the torques.
_STATES, _FASTEST, _HARDEST = 200, 3.0, 10.0
# A column is another's multiple where less than this share of it is left, and has no effect where
# its length is less than this share of the longest. True shares are above 1e-3, rounding 1e-13.
_RANK = 1e-8
# Coefficients smaller than this share of a row's columns are rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class BaseModel:
    """A model in its b base parameters.

    Attributes:
        model: In its p standard parameters.
        independent: (b,) ascending places of the standard parameters whose columns are kept.
        dependence: (b, p) `base = dependence @ standard`; the identity in the kept columns.
    """

    model: DynamicModel
    independent: IntArray
    dependence: FloatArray

    @classmethod
    def reduce(cls, model: DynamicModel, rng: np.random.Generator | None = None) -> Self:
        """Finds the base parameters of a model.

        Args:
            model: The model.
            rng: Chooses the states; always the same ones where None.
        """
        states = random_motion(model, rng or np.random.default_rng(0))
        matrix = model.regressor(states).reshape(-1, len(model.names))
        lengths = np.linalg.norm(matrix, axis=0)
        acts = np.flatnonzero(lengths > _RANK * lengths.max())
        scaled = matrix[:, acts] / lengths[acts]
        upper, order = qr(scaled, mode="r", pivoting=True)
        left = np.abs(np.diag(upper))
        rank = int(np.sum(left > _RANK * left[0]))
        mixed = solve_triangular(upper[:rank, :rank], upper[:rank, rank:])
        mixed[np.abs(mixed) < _ROUNDING] = 0.0
        kept, others = acts[order[:rank]], acts[order[rank:]]
        dependence = np.zeros((rank, len(model.names)))
        dependence[range(rank), kept] = 1.0
        dependence[:, others] = mixed * lengths[others] / lengths[kept][:, None]
        ascending = np.argsort(kept)
        return cls(model, kept[ascending], dependence[ascending])

    @property
    def rank(self) -> int:
        """The number b of base parameters."""
        return len(self.independent)

    @property
    def names(self) -> tuple[str, ...]:
        """What each base parameter is made of, as `m6*cz6 + 0.0922*m5`."""
        return tuple(
            _sum_text(self.model.names, row, int(own))
            for row, own in zip(self.dependence, self.independent, strict=True)
        )

    def regressor(self, motion: Motion) -> FloatArray:
        """Derivatives (m, n, b) of the torques by the base parameters."""
        return self.model.regressor(motion, self.independent)

    def of(self, standard: FloatArray) -> FloatArray:
        """The (b,) base parameters that (p,) standard parameters make up."""
        return np.asarray(self.dependence @ standard)


def random_motion(model: DynamicModel, rng: np.random.Generator) -> Motion:
    """States all around, at random."""
    shape = (_STATES, model.robot.joint_count)
    q, dq, ddq = (rng.uniform(-it, it, shape) for it in (np.pi, _FASTEST, _HARDEST))
    return Motion(np.arange(float(_STATES)), q, dq, ddq)


def _sum_text(names: tuple[str, ...], row: FloatArray, own: int) -> str:
    """A sum of parameters in words, the kept one first."""
    said = names[own]
    for place in np.flatnonzero(row):
        if place != own:
            size = abs(float(row[place]))
            factor = "" if abs(size - 1.0) < 1e-9 else f"{size:.4g}*"
            said += f" {'-' if row[place] < 0.0 else '+'} {factor}{names[place]}"
    return said
