"""Base parameters, all that a motion can identify: independent combinations of a model's.

What a motion does not determine of them is named, with its cause.

Many of a model's parameters move the torques alike, or not at all. A rank-revealing decomposition
of its regressor in many random states finds a set of columns that are independent, and how the
others follow from these (Gautier 1991, Numerical calculation of the base inertial parameters of
robots); Businger and Golub's pivots (1965) and columns of equal length make the choice sound.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.special import logsumexp, softmax

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import JointMotion
from visioncal.dynamics.regression import NoiseBlock

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
# A motion without effect on a parameter must not divide by zero.
_TINY = 1e-12
# A joint that never gets faster than this stands still, and its speed is noise [rad/s].
_STILL_RAD_S = 0.01
# Not determined are directions with less than this share of a full motion's information.
# Fast multi-sines get 1e-4 of it along the worst direction, motion about one axis 1e-16.
_UNDETERMINED = 1e-9
# Parameters with this share of an undetermined direction are named with it.
_SHARE = 0.3
_NEXT = (
    "Let all joints move at once, to and fro, fast and over a wide range: visioncal dynamics plan "
    "writes such a motion."
)


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
            kept = ", ".join(model.names[index] for index in independent)
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

    def regressor(self, motion: JointMotion) -> FloatArray:
        """Derivatives (m, n, b) of the torques by the base parameters."""
        return self.model.regressor(motion, self.independent)

    def of(self, standard: FloatArray) -> FloatArray:
        """The (b,) base parameters that (p,) standard parameters make up."""
        return np.asarray(self.dependence @ standard)


def _columns(model: DynamicModel, rng: np.random.Generator) -> FloatArray:
    """The regressor in random states, row by row: (m n, p)."""
    return model.regressor(random_motion(model, rng)).reshape(-1, len(model.names))


def random_motion(model: DynamicModel, rng: np.random.Generator) -> JointMotion:
    """States all around, at random."""
    shape = (_STATES, model.robot.joint_count)
    q, dq, ddq = (rng.uniform(-value, value, shape) for value in (np.pi, _FASTEST, _HARDEST))
    return JointMotion(np.arange(float(_STATES)), q, dq, ddq)


def _sum_text(names: tuple[str, ...], row: FloatArray, own: int) -> str:
    """A sum of parameters in words, the kept one first."""
    said = names[own]
    for place in np.flatnonzero(row):
        if place != own:
            size = abs(float(row[place]))
            factor = "" if abs(size - 1.0) < 1e-9 else f"{size:.4g}*"
            said += f" {'-' if row[place] < 0.0 else '+'} {factor}{names[place]}"
    return said


@dataclass(frozen=True)
class Condition:
    """Condition numbers of a motion's regressor of the base parameters.

    Units of the parameters do not matter to a least-squares fit, and change the raw figure at will:
    columns of unit length are the ones to compare by (van der Sluis 1969).

    Attributes:
        weighted: Each joint's rows divided by its noise, columns of unit length.
        scaled: Rows as they are, columns of unit length.
        raw: Rows and columns as they are, in SI units.
    """

    weighted: float
    scaled: float
    raw: float


def condition_of(base: BaseModel, motion: JointMotion, weights: FloatArray) -> Condition:
    """Computes the condition numbers of a motion.

    Args:
        base: The parameters.
        motion: Evenly sampled.
        weights: (n,) inverse of each joint's torque noise, up to a common factor.
    """
    rows = base.regressor(motion)
    flat = rows.reshape(-1, base.rank)
    weighted = (rows * weights[:, None]).reshape(-1, base.rank)
    figures = [float(np.linalg.cond(array)) for array in (_unit(weighted), _unit(flat), flat)]
    return Condition(*figures)


def _unit(rows: FloatArray) -> FloatArray:
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=0), _TINY))


def smooth_condition(rows: FloatArray, sharpness: float) -> tuple[float, FloatArray]:
    """The logarithm of the condition of column-scaled rows, made smooth.

    Greatest and least eigenvalue are taken by power means over all of them: with sharpness 1 it is
    half the logarithm of trace(G) trace(G^-1), A-optimality; with more it tends to the condition.

    Args:
        rows: (r, b).
        sharpness: Power of the means.

    Returns:
        The value, and its derivatives (r, b) by the rows.
    """
    lengths = np.maximum(np.linalg.norm(rows, axis=0), _TINY)
    unit = rows / lengths
    values, vectors = np.linalg.eigh(unit.T @ unit)
    values = np.maximum(values, _TINY)
    powers = sharpness * np.log(values)
    value = 0.5 * (logsumexp(powers) + logsumexp(-powers)) / sharpness
    by_values = 0.5 * (softmax(powers) - softmax(-powers)) / values
    by_unit = 2.0 * unit @ ((vectors * by_values) @ vectors.T)
    by_rows = (by_unit - unit * np.sum(by_unit * unit, axis=0)) / lengths
    return float(value), np.asarray(by_rows)


def check_turning(base: BaseModel, streams: Sequence[Conditioned]) -> None:
    """Refuses motions in which a joint stands still.

    Raises:
        DegenerateError: One does.
    """
    fastest = np.max(
        [np.abs(piece.measured.motion.dq).max(axis=0) for of in streams for piece in of.pieces],
        axis=0,
    )
    still = np.flatnonzero(fastest < _STILL_RAD_S)
    if not len(still):
        return
    names = base.model.robot.joint_names
    stopped = [f"joint {index + 1} ({names[index]})" for index in still]
    kept = zip(base.names, base.independent, strict=True)
    lost = [name for name, at in kept if _joint_of(base.model.names[at]) in still + 1]
    raise DegenerateError(
        f"dynamics: {some_of(stopped)} {'stands' if len(stopped) == 1 else 'stand'} still in "
        f"{some_of([stream.label for stream in streams])} "
        f"(at most {fastest[still].max():.2g} rad/s): "
        f"{len(lost)} of {base.rank} base parameters, {some_of(lost, 5)}, are not determined.",
        culprits=stopped,
        next_step=_NEXT,
    )


def _joint_of(name: str) -> int:
    """The joint, from 1, of a parameter as `m4*cx4` or `Fc4`."""
    return int(name[len(name.rstrip("0123456789")) :])


def check_identifiable(base: BaseModel, blocks: Sequence[NoiseBlock]) -> None:
    """Refuses motions that leave a combination of base parameters open.

    Raises:
        DegenerateError: There is one; its main parameters are named.
    """
    lost = null_space(base, blocks)
    if lost:
        names = base.names
        raise DegenerateError(
            f"dynamics: the motion does not determine {len(lost)} of {base.rank} base parameters: "
            f"{some_of([names[index] for index in lost], 5)}.",
            culprits=[names[index] for index in lost],
            next_step=_NEXT,
        )


def null_space(base: BaseModel, blocks: Sequence[NoiseBlock]) -> list[int]:
    """The base parameters in directions about which a motion says nothing."""
    information = np.zeros((base.rank, base.rank))
    rows = 0
    for block in blocks:
        for joint in range(block.y.shape[1]):
            x = block.x[:, joint]
            information += x.T @ x
            rows += len(x)
    sizes = _usual(base)
    relative = information / np.outer(sizes, sizes) / max(rows, 1)
    values, vectors = np.linalg.eigh(relative)
    null = np.flatnonzero(values < _UNDETERMINED)
    shares = np.sqrt(np.sum(vectors[:, null] ** 2, axis=1))
    return [int(index) for index in np.flatnonzero(shares > _SHARE)]


def _usual(base: BaseModel) -> FloatArray:
    """(b,) root mean square of each column in a motion all around."""
    rows = base.regressor(random_motion(base.model, np.random.default_rng(1)))
    return np.asarray(np.sqrt(np.mean(rows.reshape(-1, base.rank) ** 2, axis=0)))
