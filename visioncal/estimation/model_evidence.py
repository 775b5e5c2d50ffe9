"""Which change of a cell explains what a few stops show: marginal likelihoods of single causes.

A calibration says where the chain of frames closes, and how surely. New stops that do not close it
so are explained by one of several causes, each of a few further unknowns of a size that is not
known beforehand. Their marginal likelihoods compare causes of any number of unknowns fairly (Kass
and Raftery 1995, section 3): one that could explain anything pays for it. Everything is Gaussian
but the noise's common scale, which the calibration has estimated with so many degrees of freedom:
integrated out, it gives Student's distribution (Box and Tiao 1973, section 2.7).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from visioncal.core.transforms import adjoint, exp, inverse_right_jacobian, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Linear, Problem
from visioncal.estimation.variance import Knowledge

# Changes come in all sizes: from a tenth of a millimetre to a tenth of a metre, by half decades.
SIZES_M = tuple(float(value) for value in 10.0 ** np.arange(-4.0, -0.9, 0.5))
# A knock that shifts by a millimetre turns by 4 mrad.
TURN_PER_M = 4.0
# Steps of a cause settle after two or three; far beyond any arm's repeatability is far enough.
_ROUNDS, _AT_REST = 6, 1e-7
# No chain closes better [rad and m]; exact data would otherwise measure rounding by zero.
_LEAST_SIGMA = 1e-9


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known of a chain before it is looked at again.

    Attributes:
        state: The unknowns.
        covariance: (p, p) of their steps.
        noise: Its levels.
        freedom: Degrees of freedom that its scale was estimated with; infinite where it is known.
    """

    state: State
    covariance: FloatArray
    noise: Noise
    freedom: float


@dataclass(frozen=True, eq=False)
class Cause:
    """A change that could have happened since, of p unknowns.

    Attributes:
        name: Which.
        by_sensor: (n, 6, p) how each measured pose has to be moved to undo it, on its right.
        flange_jacobian: (s, 6, p) how the flange has to be at each stop, on its right.
        units: (p,) the size of each unknown, for a change of one metre.
        start: (p,) where to look for it.
        noise_factors: What the noise of the stops may have grown by, where that is the change.
    """

    name: str
    by_sensor: FloatArray
    flange_jacobian: FloatArray
    units: FloatArray
    start: FloatArray
    noise_factors: tuple[float, ...] = ()

    @property
    def trials(self) -> tuple[tuple[float, float], ...]:
        """Sizes [m] and factors of the noise to be tried, all as likely beforehand."""
        if self.noise_factors:
            return tuple((0.0, factor) for factor in self.noise_factors)
        return tuple((size, 1.0) for size in SIZES_M)


@dataclass(frozen=True, eq=False)
class CauseEvidence:
    """What the stops say under one cause.

    Attributes:
        likelihood: Logarithm of its marginal likelihood.
        values: (p,) its unknowns, as the stops alone say them.
        covariance: (p, p) of these.
        noise_factor: What the noise has most likely grown by.
        misfit: Squared distance, in units of sigma, that the cause leaves unexplained.
        freedom: How many directions of the residuals that is in.
    """

    likelihood: float
    values: FloatArray
    covariance: FloatArray
    noise_factor: float
    misfit: float
    freedom: int


def explain(problem: Problem, belief: Belief, cause: Cause | None = None) -> CauseEvidence:
    """Says how well a cause explains what was observed at some stops.

    Args:
        problem: The stops of one robot, with all unknowns of `belief`.
        belief: What the calibration says.
        cause: The change; None where nothing has.
    """
    cause = cause or _nothing(problem)
    units, (widest_m, factor) = cause.units, cause.trials[-1]
    stops = _rested(problem, belief, cause, widest_m * units, factor)
    scores = []
    for size_m, grown in cause.trials:
        if grown != factor:
            stops = _at(problem, belief, cause, stops.values, grown)
        scores.append(_score(stops, size_m * units, belief.freedom))
    grown = cause.trials[int(np.argmax(scores))][1]
    stops = _at(problem, belief, cause, stops.values, grown)
    # The change's size is left to the stops: what is known of it beforehand would shrink it.
    mean, covariance = _posterior(stops, widest_m * units)
    pulled = float(np.sum((mean / (widest_m * units)) ** 2))
    return CauseEvidence(
        float(np.logaddexp.reduce(scores) - np.log(len(scores))),
        mean,
        covariance,
        grown,
        _misfit(stops, widest_m * units)[0] - pulled,
        len(stops.residuals) - len(units),
    )


@dataclass(frozen=True, eq=False)
class _StopResiduals:
    """The residuals (n,) of all stops as they are linear in a cause's unknowns around some values.

    `residuals` are those at zero, by that linearisation; `jacobian` (n, p), `covariance` (n, n) of
    the noise and of the calibration's unknowns together, which are so small that they stay where
    the calibration has them.
    """

    values: FloatArray
    residuals: FloatArray
    jacobian: FloatArray
    covariance: FloatArray


def _nothing(problem: Problem) -> Cause:
    """No change at all."""
    (poses,) = problem.poses.values()
    still, resting, none = np.zeros((len(problem), 6, 0)), np.zeros((len(poses), 6, 0)), np.zeros(0)
    return Cause("nothing", still, resting, none, none, (1.0,))


def _rested(
    problem: Problem, belief: Belief, cause: Cause, sigmas: FloatArray, factor: float
) -> _StopResiduals:
    """Linearises at a cause's most likely values, which linearising finds."""
    stops = _at(problem, belief, cause, cause.start, factor)
    for _ in range(_ROUNDS if len(sigmas) else 0):
        after = _posterior(stops, sigmas)[0]
        moved = np.abs(after - stops.values).max()
        stops = _at(problem, belief, cause, after, factor)
        if moved < _AT_REST:
            break
    return stops


def _at(
    problem: Problem, belief: Belief, cause: Cause, values: FloatArray, factor: float
) -> _StopResiduals:
    """Linearises at some values (p,) of a cause."""
    without, known = undone(problem, cause, values), len(belief.covariance)
    linear = without.linear(with_change(belief.state, cause))
    noise = replace(belief.noise, robots=factor * belief.noise.robots)
    jacobian = linear.jacobian.reshape(-1, without.size)
    before, own = jacobian[:, :known], jacobian[:, known:]
    covariance = _spread(without, linear, noise) + before @ belief.covariance @ before.T
    covariance += _LEAST_SIGMA**2 * np.eye(len(covariance))
    return _StopResiduals(values, linear.residuals.reshape(-1) - own @ values, own, covariance)


def _spread(problem: Problem, linear: Linear, noise: Noise) -> FloatArray:
    """(6 n, 6 n) covariance of all residuals: those of one unit share the flange's error."""
    found, (of, _) = block_diag(*problem.covariance(noise)), problem.units
    for unit, errors in enumerate(problem.error_covariance(noise)):
        rows = np.flatnonzero(of == unit)
        places = (6 * rows[:, None] + np.arange(6)).ravel()
        jacobian = linear.by_errors[rows].reshape(-1, errors.shape[0])
        found[np.ix_(places, places)] += jacobian @ errors @ jacobian.T
    return np.asarray(found)


def undone(problem: Problem, cause: Cause, values: FloatArray) -> Problem:
    """The stops as they would be without a change of some size, and how they go on moving with it.

    A change may be large: a board that was put elsewhere has turned by any angle.

    Args:
        problem: The stops of one robot.
        cause: What has changed.
        values: (p,) its unknowns, by how much.

    Returns:
        The stops, with the p unknowns as their last effect.
    """
    by_sensor, flange_jacobian = (
        _stepped(jacobian, values) for jacobian in (cause.by_sensor, cause.flange_jacobian)
    )
    carried, seen = adjoint(invert(by_sensor.moved)), problem.observations
    nothing = Knowledge(np.zeros((len(values), len(values))), np.zeros(len(values)))
    ((robot, poses),) = problem.poses.items()
    changed = Effect.free("change", nothing, by_sensor.jacobian, {robot: flange_jacobian.jacobian})
    return replace(
        problem,
        poses={robot: poses @ flange_jacobian.moved},
        observations=replace(
            seen,
            measured=seen.measured @ by_sensor.moved,
            covariance=carried @ seen.covariance @ np.swapaxes(carried, 1, 2),
        ),
    ).with_effects([*(effect.carried(carried) for effect in problem.effects), changed])


def with_change(state: State, cause: Cause) -> State:
    """The unknowns with those of a cause behind them, from which a change has been undone."""
    return State(state.edges, np.concatenate([state.values, np.zeros(len(cause.units))]))


@dataclass(frozen=True, eq=False)
class _LinearisedMotions:
    """Motions (m, 4, 4) by some values, and how they go on with them: (m, 6, p), on the right."""

    moved: FloatArray
    jacobian: FloatArray


def _stepped(jacobian: FloatArray, values: FloatArray) -> _LinearisedMotions:
    twists = jacobian @ values
    # Beyond, the series does not converge; no cause that leads there explains anything.
    near = np.linalg.norm(twists[:, :3], axis=1) < np.pi
    onward = inverse_right_jacobian(np.where(near[:, None], twists, 0.0))
    return _LinearisedMotions(
        exp(twists), np.asarray(np.linalg.solve(onward, jacobian), dtype=float)
    )


def _score(stops: _StopResiduals, sigmas: FloatArray, freedom: float) -> float:
    """Logarithm of the marginal likelihood, up to what all causes have in common."""
    squares, log_det = _misfit(stops, sigmas)
    if np.isinf(freedom):
        return -0.5 * (log_det + squares)
    count = len(stops.residuals)
    return -0.5 * (log_det + (freedom + count) * float(np.log1p(squares / freedom)))


def _misfit(stops: _StopResiduals, sigmas: FloatArray) -> tuple[float, float]:
    """Squared length of the residuals in units of their covariance, and its log-determinant."""
    root, lower = _root(stops, sigmas)
    squares = float(stops.residuals @ cho_solve((root, lower), stops.residuals))
    return squares, 2.0 * float(np.log(np.diag(root)).sum())


def _posterior(stops: _StopResiduals, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (p,) and covariance (p, p) of a cause's values, given the residuals."""
    carried = stops.jacobian * sigmas**2
    taken = cho_solve(_root(stops, sigmas), carried)
    return -taken.T @ stops.residuals, np.diag(sigmas**2) - carried.T @ taken


def _root(stops: _StopResiduals, sigmas: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky's root of the residuals' covariance, for a cause of some size."""
    total = stops.covariance + (stops.jacobian * sigmas**2) @ stops.jacobian.T
    root, lower = cho_factor(total, lower=True)
    return np.asarray(root), bool(lower)
