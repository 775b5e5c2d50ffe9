"""Base parameters, all that a motion can identify: independent combinations of a model's.

Many of a model's parameters move the torques alike, or not at all. A rank-revealing decomposition
of its regressor in many random states finds a set of columns that are independent, and how the
others follow from these (Gautier 1991, Numerical calculation of the base inertial parameters of
robots); Businger and Golub's pivots (1965) and columns of equal length make the choice sound.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import qr, solve_triangular

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import Motion

# States that stand for all, and their greatest speeds [rad/s] and accelerations [rad/s^2]; at these
# gravity, speed and acceleration have like shares in the torques.
_STATES, _FASTEST, _HARDEST = 200, 3.0, 10.0
# A column is another's multiple where less than this share of it is left, and has no effect where
# its length is less than this share of the longest. True shares are above 1e-3, rounding 1e-13.
_RANK = 1e-8
# Equal columns, as those of a rotor and of its link about the first joint, are taken in their order
# whatever rounding says: each counts for so much less than the first.
_TIE = 1e-4
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
        matrix = _columns(model, rng or np.random.default_rng(0))
        lengths = np.linalg.norm(matrix, axis=0)
        acts = np.flatnonzero(lengths > _RANK * lengths.max())
        favour = 1.0 - _TIE * np.arange(len(acts)) / len(acts)
        upper, order = qr(matrix[:, acts] * (favour / lengths[acts]), mode="r", pivoting=True)
        left = np.abs(np.diag(upper))
        rank = int(np.sum(left > _RANK * left[0]))
        return cls.keeping(model, np.sort(acts[order[:rank]]))

    @classmethod
    def keeping(cls, model: DynamicModel, independent: IntArray) -> Self:
        """Takes a model with columns that are known to be independent, and all that there are.

        Args:
            model: The model.
            independent: (b,) ascending places of the parameters that are kept.

        Raises:
            DataError: They are not independent, or others are independent of them.
        """
        matrix = _columns(model, np.random.default_rng(0))
        lengths = np.linalg.norm(matrix, axis=0)
        lengths[lengths <= _RANK * lengths.max()] = np.inf
        scaled = matrix / lengths
        across, upper = qr(scaled[:, independent], mode="economic")
        shares = across.T @ scaled
        left = np.abs(np.diag(upper)).min(initial=1.0)
        if left <= _RANK or np.abs(scaled - across @ shares).max() > _RANK:
            kept = ", ".join(model.names[it] for it in independent)
            raise DataError(
                f"robot {model.robot.name}: {kept} are no base parameters of it.",
                culprits=[model.robot.name],
            )
        mixed = solve_triangular(upper, shares)
        mixed[np.abs(mixed) < _ROUNDING] = 0.0
        sizes = np.where(np.isfinite(lengths), lengths, 0.0)
        dependence = mixed * sizes / lengths[independent][:, None]
        dependence[:, independent] = np.eye(len(independent))
        return cls(model, independent, dependence)

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


def _columns(model: DynamicModel, rng: np.random.Generator) -> FloatArray:
    """The regressor in random states, row by row: (m n, p)."""
    return model.regressor(random_motion(model, rng)).reshape(-1, len(model.names))


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
