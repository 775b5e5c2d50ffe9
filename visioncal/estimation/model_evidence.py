"""Bayesian model comparison of single changes of a cell, by a few new stops.

A calibration predicts where the chain of frames closes, with a covariance. New stops that
contradict it are explained by one of several causes, each with a few unknowns of unknown size.
Marginal likelihoods compare causes with any number of unknowns fairly (Kass and Raftery 1995,
section 3): flexible causes are penalised. Everything is Gaussian except for the noise's common
scale, which the calibration estimated with some degrees of freedom: integrated out, it gives
Student's distribution (Box and Tiao 1973, section 2.7).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from visioncal.core.transforms import adjoint, exp, inverse_right_jacobian, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem import Linear, Problem
from visioncal.estimation.problem_parts import Effect, Noise, State

# Sizes of changes: from a tenth of a millimetre to a tenth of a metre, by half decades.
SIZES_M = tuple(float(value) for value in 10.0 ** np.arange(-4.0, -0.9, 0.5))
# A change of a millimetre rotates by 4 mrad.
TURN_PER_M = 4.0
# Steps of a cause converge after two or three, to far below any arm's repeatability.
_ROUNDS, _CONVERGED = 6, 1e-7
# Least sigma [rad and m]: exact data would otherwise be compared with rounding.
_LEAST_SIGMA = 1e-9


@dataclass(frozen=True, eq=False)
class CalibrationPosterior:
    """Posterior of the calibration, the prior of a verification."""

    state: State
    covariance: FloatArray  # (p, p) of their steps.
    noise: Noise
    freedom: float  # Degrees of freedom of its scale; infinite where it is known.


@dataclass(frozen=True, eq=False)
class ChangeHypothesis:
    """A change that may have happened since the calibration, of p unknowns."""

    name: str
    by_sensor: FloatArray  # (n, 6, p) right perturbations of the measured poses that undo it.
    # (s, 6, p) right perturbations of the flange at each stop that undo it.
    flange_jacobian: FloatArray
    units: FloatArray  # (p,) the size of each unknown, for a change of one metre.
    start: FloatArray  # (p,) start of the search.
    # Factors on the noise of the stops, where larger noise is the change.
    noise_factors: tuple[float, ...] = ()

    @property
    def trials(self) -> tuple[tuple[float, float], ...]:
        """Sizes [m] and noise factors to try, with equal prior probability."""
        if self.noise_factors:
            return tuple((0.0, factor) for factor in self.noise_factors)
        return tuple((size, 1.0) for size in SIZES_M)


@dataclass(frozen=True, eq=False)
class HypothesisEvidence:
    """Evidence of the stops for one cause."""

    likelihood: float  # Logarithm of its marginal likelihood.
    values: FloatArray  # (p,) its unknowns, by the stops alone.
    covariance: FloatArray  # (p, p) of these.
    noise_factor: float  # Most likely factor on the noise.
    misfit: float  # Squared Mahalanobis distance that the cause leaves unexplained.
    freedom: int  # Degrees of freedom of the misfit.


def evidence_of(
    problem: Problem, belief: CalibrationPosterior, cause: ChangeHypothesis | None = None
) -> HypothesisEvidence:
    """Computes the evidence for a cause from the stops of one robot; with None, for no change.

    The problem has all unknowns of `belief`.
    """
    cause = cause or _nothing(problem)
    units, (widest_m, factor) = cause.units, cause.trials[-1]
    stops = _converged(problem, belief, cause, widest_m * units, factor)
    scores = []
    for size_m, factor_tried in cause.trials:
        if factor_tried != factor:
            stops = _linearised(problem, belief, cause, stops.values, factor_tried)
        scores.append(_score(stops, size_m * units, belief.freedom))
    factor_tried = cause.trials[int(np.argmax(scores))][1]
    stops = _linearised(problem, belief, cause, stops.values, factor_tried)
    # With the widest prior on the change's size, which hardly shrinks it.
    mean, covariance = _posterior(stops, widest_m * units)
    prior_misfit = float(np.sum((mean / (widest_m * units)) ** 2))
    return HypothesisEvidence(
        float(np.logaddexp.reduce(scores) - np.log(len(scores))),
        mean,
        covariance,
        factor_tried,
        _misfit(stops, widest_m * units)[0] - prior_misfit,
        len(stops.residuals) - len(units),
    )


@dataclass(frozen=True, eq=False)
class _StopResiduals:
    """Residuals (n,) of all stops, linearised in a cause's unknowns around some values.

    `residuals` are those at zero, by that linearisation; `jacobian` is (n, p), and `covariance` (n,
    n) that of the noise and of the calibration's unknowns together, which stay at the calibration.
    """

    values: FloatArray
    residuals: FloatArray
    jacobian: FloatArray
    covariance: FloatArray


def _nothing(problem: Problem) -> ChangeHypothesis:
    """The cause of no change, without unknowns."""
    (poses,) = problem.poses.values()
    sensor, flange, values = (
        np.zeros((len(problem), 6, 0)),
        np.zeros((len(poses), 6, 0)),
        np.zeros(0),
    )
    return ChangeHypothesis("nothing", sensor, flange, values, values, (1.0,))


def _converged(
    problem: Problem,
    belief: CalibrationPosterior,
    cause: ChangeHypothesis,
    sigmas: FloatArray,
    factor: float,
) -> _StopResiduals:
    """Linearises at a cause's most likely values, by iteration."""
    stops = _linearised(problem, belief, cause, cause.start, factor)
    for _ in range(_ROUNDS if len(sigmas) else 0):
        values = _posterior(stops, sigmas)[0]
        step = np.abs(values - stops.values).max()
        stops = _linearised(problem, belief, cause, values, factor)
        if step < _CONVERGED:
            break
    return stops


def _linearised(
    problem: Problem,
    belief: CalibrationPosterior,
    cause: ChangeHypothesis,
    values: FloatArray,
    factor: float,
) -> _StopResiduals:
    """Linearises at some values (p,) of a cause."""
    without, calibrated = undone(problem, cause, values), len(belief.covariance)
    linear = without.linear(with_change(belief.state, cause))
    noise = replace(belief.noise, robots=factor * belief.noise.robots)
    jacobian = linear.jacobian.reshape(-1, without.size)
    known, own = jacobian[:, :calibrated], jacobian[:, calibrated:]
    covariance = _total_covariance(without, linear, noise) + known @ belief.covariance @ known.T
    covariance += _LEAST_SIGMA**2 * np.eye(len(covariance))
    return _StopResiduals(values, linear.residuals.reshape(-1) - own @ values, own, covariance)


def _total_covariance(problem: Problem, linear: Linear, noise: Noise) -> FloatArray:
    """(6 n, 6 n) covariance of all residuals: those of one unit share the flange's error."""
    covariance, (unit_of, _) = block_diag(*problem.covariance(noise)), problem.units
    for unit, errors in enumerate(problem.error_covariance(noise)):
        rows = np.flatnonzero(unit_of == unit)
        columns = (6 * rows[:, None] + np.arange(6)).ravel()
        jacobian = linear.by_errors[rows].reshape(-1, errors.shape[0])
        covariance[np.ix_(columns, columns)] += jacobian @ errors @ jacobian.T
    return np.asarray(covariance)


def undone(problem: Problem, cause: ChangeHypothesis, values: FloatArray) -> Problem:
    """The stops with a change of (p,) values undone, and these as their last effect.

    Changes may be large: a board may have turned by any angle.
    """
    by_sensor, flange_jacobian = (
        _stepped(jacobian, values) for jacobian in (cause.by_sensor, cause.flange_jacobian)
    )
    adjoints, observations = adjoint(invert(by_sensor.moved)), problem.observations
    no_prior = PriorInformation.flat(len(values))
    ((robot, poses),) = problem.poses.items()
    changed = Effect.free("change", no_prior, by_sensor.jacobian, {robot: flange_jacobian.jacobian})
    return replace(
        problem,
        poses={robot: poses @ flange_jacobian.moved},
        observations=replace(
            observations,
            measured=observations.measured @ by_sensor.moved,
            covariance=adjoints @ observations.covariance @ np.swapaxes(adjoints, 1, 2),
        ),
    ).with_effects([*(effect.carried(adjoints) for effect in problem.effects), changed])


def with_change(state: State, cause: ChangeHypothesis) -> State:
    """The unknowns followed by those of a cause, which are zero."""
    return State(state.edges, np.concatenate([state.values, np.zeros(len(cause.units))]))


@dataclass(frozen=True, eq=False)
class _LinearisedMotions:
    """Motions (m, 4, 4) for some values, and their right Jacobian (m, 6, p)."""

    moved: FloatArray
    jacobian: FloatArray


def _stepped(jacobian: FloatArray, values: FloatArray) -> _LinearisedMotions:
    twists = jacobian @ values
    # The series does not converge beyond; no cause that leads there explains anything.
    near = np.linalg.norm(twists[:, :3], axis=1) < np.pi
    right_jacobian_inverse = inverse_right_jacobian(np.where(near[:, None], twists, 0.0))
    return _LinearisedMotions(
        exp(twists), np.asarray(np.linalg.solve(right_jacobian_inverse, jacobian), dtype=float)
    )


def _score(stops: _StopResiduals, sigmas: FloatArray, freedom: float) -> float:
    """Logarithm of the marginal likelihood, up to a constant common to all causes."""
    squares, log_det = _misfit(stops, sigmas)
    if np.isinf(freedom):
        return -0.5 * (log_det + squares)
    count = len(stops.residuals)
    return -0.5 * (log_det + (freedom + count) * float(np.log1p(squares / freedom)))


def _misfit(stops: _StopResiduals, sigmas: FloatArray) -> tuple[float, float]:
    """Squared Mahalanobis length of the residuals, and their covariance's log-determinant."""
    root, lower = _root(stops, sigmas)
    squares = float(stops.residuals @ cho_solve((root, lower), stops.residuals))
    return squares, 2.0 * float(np.log(np.diag(root)).sum())


def _posterior(stops: _StopResiduals, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (p,) and covariance (p, p) of a cause's values, given the residuals."""
    cross = stops.jacobian * sigmas**2
    gain = cho_solve(_root(stops, sigmas), cross)
    return -gain.T @ stops.residuals, np.diag(sigmas**2) - cross.T @ gain


def _root(stops: _StopResiduals, sigmas: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky factor of the residuals' covariance, for a cause of some size."""
    total = stops.covariance + (stops.jacobian * sigmas**2) @ stops.jacobian.T
    root, lower = cho_factor(total, lower=True)
    return np.asarray(root), bool(lower)
