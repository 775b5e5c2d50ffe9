"""Base parameters: the independent combinations of standard parameters that torques identify.

Many standard parameters affect the torques alike, or not at all. A rank-revealing QR decomposition
of the regressor in many random states finds a set of independent columns, and how the others depend
on these (Gautier 1991, Numerical calculation of the base inertial parameters of robots); Businger
and Golub's pivoting (1965) and columns of unit length make the choice well conditioned.

The rest of the standard parameters follows a prior at the robot's own inertias, in log-Cholesky
coordinates, in which every link is physically consistent (Wensing, Kim and Slotine 2018; Lee,
Wensing and Park 2019; Rucker and Wensing 2022).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import block_diag, cholesky, qr, solve_triangular
from scipy.special import logsumexp, softmax

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.linalg import covariance_from
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import DynamicModel, JointMotion
from visioncal.dynamics.regression import NoiseBlock
from visioncal.robot.inertia import Inertias, LogCholesky

# A column is dependent where less than this share of it is left, and has no effect where its norm
# is less than this share of the largest. True shares are above 1e-3, rounding 1e-13.
_RANK = 1e-8
# Avoids division by zero for parameters without effect.
_TINY = 1e-12
_NEXT = (
    "Let all joints move at once, to and fro, fast and over a wide range: visioncal dynamics plan "
    "writes such a motion."
)
# Standard deviation of the prior in each log-Cholesky coordinate: 30 % of a link's extent, twice
# that of its mass.
PRIOR_SIGMA = 0.3
# Prefixes of the joint parameters that cannot be negative.
_POSITIVE = ("Fc", "Fv", "Ia")


@dataclass(frozen=True, eq=False)
class BaseModel:
    """A dynamic model in its b base parameters."""

    model: DynamicModel  # The model in its p standard parameters.
    # (b,) ascending indices of the standard parameters whose columns are kept.
    independent: IntArray
    # (b, p) `base = dependence @ standard`; the identity in the kept columns.
    dependence: FloatArray

    @classmethod
    def reduce(cls, model: DynamicModel, rng: np.random.Generator | None = None) -> Self:
        """Finds the base parameters of a model, in random states (seed 0 by default)."""
        matrix = _random_regressor(model, rng or np.random.default_rng(0))
        lengths = np.linalg.norm(matrix, axis=0)
        effective = np.flatnonzero(lengths > _RANK * lengths.max())
        # Equal columns, as those of a rotor and of its link about the first joint, are chosen in
        # their order whatever rounding says.
        weights = 1.0 - 1e-4 * np.arange(len(effective)) / len(effective)
        upper, order = qr(
            matrix[:, effective] * (weights / lengths[effective]), mode="r", pivoting=True
        )
        remaining = np.abs(np.diag(upper))
        rank = int(np.sum(remaining > _RANK * remaining[0]))
        return cls.keeping(model, np.sort(effective[order[:rank]]))

    @classmethod
    def keeping(cls, model: DynamicModel, independent: IntArray) -> Self:
        """Builds the base model that keeps (b,) given independent parameters, in ascending order.

        Raises:
            DataError: Their columns are dependent, or do not span the others.
        """
        matrix = _random_regressor(model, np.random.default_rng(0))
        lengths = np.linalg.norm(matrix, axis=0)
        lengths[lengths <= _RANK * lengths.max()] = np.inf
        unit_columns = matrix / lengths
        basis, upper = qr(unit_columns[:, independent], mode="economic")
        projected = basis.T @ unit_columns
        remaining = np.abs(np.diag(upper)).min(initial=1.0)
        if remaining <= _RANK or np.abs(unit_columns - basis @ projected).max() > _RANK:
            kept = ", ".join(model.names[index] for index in independent)
            raise DataError(
                f"robot {model.robot.name}: {kept} are no base parameters of it.",
                culprits=[model.robot.name],
            )
        coefficients = solve_triangular(upper, projected)
        # Rounding, between columns of unit length.
        coefficients[np.abs(coefficients) < 1e-9] = 0.0
        norms = np.where(np.isfinite(lengths), lengths, 0.0)
        dependence = coefficients * norms / lengths[independent][:, None]
        dependence[:, independent] = np.eye(len(independent))
        return cls(model, independent, dependence)

    @property
    def rank(self) -> int:
        """The number b of base parameters."""
        return len(self.independent)

    @property
    def names(self) -> tuple[str, ...]:
        """Expression of each base parameter, such as `m6*cz6 + 0.0922*m5`."""
        names, texts = self.model.names, []
        for row, kept in zip(self.dependence, self.independent.tolist(), strict=True):
            # The kept standard parameter is first.
            text = names[kept]
            for index in np.flatnonzero(row):
                if index != kept:
                    size = abs(float(row[index]))
                    factor = "" if abs(size - 1.0) < 1e-9 else f"{size:.4g}*"
                    text += f" {'-' if row[index] < 0.0 else '+'} {factor}{names[index]}"
            texts.append(text)
        return tuple(texts)

    def regressor(self, motion: JointMotion) -> FloatArray:
        """Regressor of the base parameters: derivatives (m, n, b) of the torques."""
        return self.model.regressor(motion, self.independent)

    def of(self, standard: FloatArray) -> FloatArray:
        """Base parameters (b,) of (p,) standard parameters."""
        return np.asarray(self.dependence @ standard)


def _random_regressor(model: DynamicModel, rng: np.random.Generator) -> FloatArray:
    """Regressor (m n, p) in random states."""
    return model.regressor(random_motion(model, rng)).reshape(-1, len(model.names))


def random_motion(model: DynamicModel, rng: np.random.Generator) -> JointMotion:
    """Random states over the full ranges of angle, speed and acceleration."""
    # Up to 3 rad/s and 10 rad/s^2 gravity, speed and acceleration contribute about equally to the
    # torques.
    shape = (200, model.robot.joint_count)
    q, dq, ddq = (rng.uniform(-value, value, shape) for value in (np.pi, 3.0, 10.0))
    return JointMotion(np.arange(200.0), q, dq, ddq)


def condition_of(base: BaseModel, motion: JointMotion, weights: FloatArray) -> float:
    """Condition number of an evenly sampled motion's regressor of the base parameters.

    Each joint's rows are weighted, and columns are of unit length: the parameters' units, which do
    not matter to a least-squares fit, would change it arbitrarily (van der Sluis 1969). The weights
    (n,) are inverse to each joint's torque noise, up to a common factor.
    """
    rows = (base.regressor(motion) * weights[:, None]).reshape(-1, base.rank)
    return float(np.linalg.cond(rows / np.maximum(np.linalg.norm(rows, axis=0), _TINY)))


def smooth_condition(rows: FloatArray, sharpness: float) -> tuple[float, FloatArray]:
    """Smooth approximation of the log condition number of column-scaled rows (r, b).

    The greatest and least eigenvalues of the information G are replaced by power means over all of
    them: with sharpness 1 it is half the logarithm of trace(G) trace(G^-1), A-optimality; with more
    it tends to the condition number.

    Returns:
        The value, and its gradient (r, b) with respect to the rows.
    """
    lengths = np.maximum(np.linalg.norm(rows, axis=0), _TINY)
    unit = rows / lengths
    values, vectors = np.linalg.eigh(unit.T @ unit)
    values = np.maximum(values, _TINY)
    powers = sharpness * np.log(values)
    value = 0.5 * (logsumexp(powers) + logsumexp(-powers)) / sharpness
    gradient_values = 0.5 * (softmax(powers) - softmax(-powers)) / values
    gradient_unit = 2.0 * unit @ ((vectors * gradient_values) @ vectors.T)
    gradient_rows = (gradient_unit - unit * np.sum(gradient_unit * unit, axis=0)) / lengths
    return float(value), np.asarray(gradient_rows)


def check_joints_move(base: BaseModel, streams: Sequence[Conditioned]) -> None:
    """Refuses motions in which a joint stands still, by a DegenerateError."""
    fastest = np.max(
        [np.abs(piece.measured.motion.dq).max(axis=0) for item in streams for piece in item.pieces],
        axis=0,
    )
    # A joint that never exceeds this stands still, and its speed is noise [rad/s].
    still = np.flatnonzero(fastest < 0.01)
    if not len(still):
        return
    names = base.model.robot.joint_names
    stopped = [f"joint {index + 1} ({names[index]})" for index in still]
    # The joint, from 1, of a parameter as `m4*cx4` or `Fc4`.
    kept = [base.model.names[at] for at in base.independent]
    joints = [int(name[len(name.rstrip("0123456789")) :]) for name in kept]
    lost = [name for name, at in zip(base.names, joints, strict=True) if at in still + 1]
    raise DegenerateError(
        f"dynamics: {some_of(stopped)} {'stands' if len(stopped) == 1 else 'stand'} still in "
        f"{some_of([stream.label for stream in streams])} "
        f"(at most {fastest[still].max():.2g} rad/s): "
        f"{len(lost)} of {base.rank} base parameters, {some_of(lost, 5)}, are not determined.",
        culprits=stopped,
        next_step=_NEXT,
    )


def check_identifiable(base: BaseModel, blocks: Sequence[NoiseBlock]) -> None:
    """Refuses motions that leave base parameters undetermined, by a DegenerateError."""
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
    """Indices of the base parameters in the null space of the motions' information."""
    information = np.zeros((base.rank, base.rank))
    rows = 0
    for block in blocks:
        for joint in range(block.y.shape[1]):
            x = block.x[:, joint]
            information += x.T @ x
            rows += len(x)
    # Scaled by the root mean square of each column in random states.
    states = random_motion(base.model, np.random.default_rng(1))
    column_rms = np.sqrt(np.mean(base.regressor(states).reshape(-1, base.rank) ** 2, axis=0))
    relative = information / np.outer(column_rms, column_rms) / max(rows, 1)
    values, vectors = np.linalg.eigh(relative)
    # Of a full motion's information, fast multi-sines have 1e-4 in the worst direction, and motion
    # about one axis 1e-16. Parameters with a share of such a direction are named with it.
    undetermined = np.flatnonzero(values < 1e-9)
    shares = np.sqrt(np.sum(vectors[:, undetermined] ** 2, axis=1))
    return [int(index) for index in np.flatnonzero(shares > 0.3)]


@dataclass(frozen=True, eq=False)
class Consistent:
    """Physically consistent standard parameters."""

    values: FloatArray  # (p,) in the order of `DynamicModel.names`.
    covariance: FloatArray  # (p, p) posterior covariance, given torques and prior.
    misfit: float  # Chi-square by which the torques fit worse than with the best base parameters.

    def inertias(self, joints: int) -> Inertias:
        """Inertial parameters of the links."""
        return Inertias(self.values[: 10 * joints].reshape(joints, 10))


def fit_consistent(
    base: BaseModel, values: FloatArray, covariance: FloatArray, known: Inertias
) -> Consistent:
    """Fits consistent standard parameters, near known inertias, to measured base parameters.

    Args:
        base: The model.
        values: (b,) measured base parameters.
        covariance: (b, b) their covariance.
        known: Prior inertias of the links.

    Raises:
        DataError: The prior inertias are physically inconsistent.
    """
    count, coordinates = known.values.size, LogCholesky.around(known)
    names = base.model.names[count:]
    scale = np.sqrt(np.diag(covariance))
    root = cholesky(covariance / np.outer(scale, scale), lower=True)

    def whitened(rows: FloatArray) -> FloatArray:
        return np.asarray(solve_triangular(root, (rows.T / scale).T, lower=True))

    # The unknowns are the links' coordinates in units of their prior sigma, and the joints' own.
    def links(unknowns: FloatArray) -> FloatArray:
        return PRIOR_SIGMA * unknowns[:count].reshape(-1, 10)

    def standard(unknowns: FloatArray) -> FloatArray:
        bodies = coordinates.values(links(unknowns)).ravel()
        return np.concatenate([bodies, unknowns[count:]])

    def jacobian(unknowns: FloatArray) -> FloatArray:
        """(p, p) Jacobian of the standard parameters."""
        bodies = PRIOR_SIGMA * coordinates.jacobians(links(unknowns))
        return np.asarray(block_diag(*bodies, np.eye(len(names))))

    def residuals(unknowns: FloatArray) -> FloatArray:
        torques = whitened(base.of(standard(unknowns)) - values)
        return np.concatenate([torques, unknowns[:count]])

    def slopes(unknowns: FloatArray) -> FloatArray:
        prior = np.eye(count, len(unknowns))
        return np.concatenate([whitened(base.dependence @ jacobian(unknowns)), prior])

    upper = np.full(count + len(names), np.inf)
    # Bound of the coordinates, in prior sigmas: extents of 90 times the known ones, short of
    # overflow.
    upper[:count] = 15.0
    lower = -upper
    # Negative friction or inertia is noise, or the model does not fit.
    lower[count:][[name.startswith(_POSITIVE) for name in names]] = 0.0
    start = np.zeros(len(lower))
    joint_columns = slopes(start)[: base.rank, count:]
    start[count:] = np.linalg.lstsq(joint_columns, -residuals(start)[: base.rank], rcond=None)[0]
    # An export of what was identified waits for no optimiser.
    from scipy.optimize import least_squares

    # Good fits take 200 to 500 evaluations; where no bodies fit, more of them change nothing.
    with np.errstate(over="ignore"):
        fit = least_squares(
            residuals,
            np.maximum(start, lower),
            slopes,
            (lower, upper),
            x_scale="jac",
            ftol=1e-9,
            max_nfev=1000,
        )
    free = fit.active_mask == 0
    estimate = np.where(free, fit.x, 0.0)
    rows = slopes(estimate)[:, free]
    by_unknowns = jacobian(estimate)[:, free]
    posterior = by_unknowns @ covariance_from(rows.T @ rows) @ by_unknowns.T
    left = residuals(estimate)[: base.rank]
    return Consistent(standard(estimate), posterior, float(left @ left))
