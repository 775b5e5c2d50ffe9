"""Solver: Levenberg-Marquardt on all unknowns, with noise levels estimated by REML."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.levenberg_marquardt import (
    ITERATIONS,
    NEAR_DAMPING,
    SETTLED,
    START_DAMPING,
    Linearised,
    levenberg_marquardt,
)
from visioncal.core.linalg import (
    covariance_among,
    covariance_from,
    damped_step,
    gram,
    squared_lengths,
)
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.mixed import LEAST_SIGMA
from visioncal.estimation.normal_equations import Whitening, fisher_information, normal_equations
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import START_SIGMA, robot_likelihood

# Relative decrease of the cost at convergence while the noise levels still change.
_NEARLY = 1e-5
# A well-posed fit converges within a few steps. One that creeps, such as along the flat valley of
# arm errors that mimic another cause, gets new noise levels after this many.
_STEPS = 30
# Relative change of noise levels at convergence, far below their uncertainty.
_LEVELS_SETTLED = 1e-3

# Largest share of a change of the levels that the next change repeats: it bounds extrapolation.
_MOST_SHARE = 0.9
# Bounds of a sensor's noise relative to its stated noise.
_SENSOR_RANGE = (1e-3, 1e4)


@dataclass(frozen=True, eq=False)
class Solution:
    """Estimated unknowns and noise levels, and whether the fit converged."""

    state: State
    noise: Noise
    settled: bool = True


def starting_noise(problem: Problem) -> Noise:
    """Initial noise: robots from above, sensors as stated."""
    # Some sensors may have no observations among these.
    seen = int(problem.observations.sensors.max(initial=-1)) + 1
    sensors = max(seen, len(problem.least_levels))
    return Noise(np.full((len(problem.robots), 2), START_SIGMA), np.ones(sensors))


def fit_problem(
    problem: Problem, state: State, noise: Noise | None = None, *, turns: int = 20
) -> Solution:
    """Minimises the whitened residuals and estimates the noise levels, from given ones on.

    Both in turn, until the levels change no more, or for a number of turns.
    """
    is_near, given = noise is not None, noise or starting_noise(problem)
    # REML includes one linear step of the unknowns, so levels are close before the first solve.
    noise = estimate_noise(problem, state, given, from_above=not is_near)
    is_unchanged = is_near and _are_close(given, noise)
    if is_unchanged:
        noise = given
    last = np.zeros_like(noise.sensors)
    for turn in range(0 if is_unchanged else turns):
        start, previous = state, noise
        state, _ = solve_problem(
            problem, start, noise, is_near=is_near or turn > 0, most=_STEPS, settled=_NEARLY
        )
        if state is start:
            break
        noise = estimate_noise(problem, state, noise)
        if _are_close(previous, noise):
            break
        # Levels of sensors and robots follow each other slowly: extrapolated.
        change = np.log(noise.sensors / previous.sensors)
        share, last = repeated_share(change, last, _MOST_SHARE)
        noise = replace(noise, sensors=noise.sensors * np.exp(change * share / (1.0 - share)))
    # A solve keeps the weights of its start: solve once more from the solution.
    state, settled = solve_problem(problem, state, noise, is_near=True)
    return Solution(state, noise, settled)


def repeated_share(step: FloatArray, last: FloatArray, most: float) -> tuple[float, FloatArray]:
    """The share s of a (k,) step that the next one repeats: all sum to 1 / (1 - s) steps.

    By the step before (Aitken 1926), and at most a share. The second is the one for the next step;
    zero after one that is extrapolated.
    """
    square = max(float(last @ last), np.finfo(float).tiny)
    share = float(np.clip(step @ last / square, 0.0, most))
    return share, np.zeros_like(step) if share > 0.0 else step


def _are_close(before: Noise, after: Noise) -> bool:
    pairs = (before.robots, after.robots), (before.sensors, after.sensors)
    return all(np.allclose(*pair, rtol=_LEVELS_SETTLED, atol=10.0 * LEAST_SIGMA) for pair in pairs)


def solve_problem(
    problem: Problem,
    state: State,
    noise: Noise,
    *,
    is_near: bool = False,
    most: int = ITERATIONS,
    settled: float = SETTLED,
) -> tuple[State, bool]:
    """Minimises the residuals whitened by a given noise.

    `is_near` is whether the start is a solution under other weights; `most` and `settled` are those
    of `levenberg_marquardt`.

    Returns:
        The unknowns, and whether the iteration converged.
    """
    moving = problem.moving
    # Weights are held: if they followed the unknowns, states with large noise would be favoured.
    whitening = Whitening.of(problem, noise, problem.ideal_errors(state))

    def linearise(at: State) -> Linearised[State]:
        information, gradient, cost, _ = whitening.equations(problem, at, problem.linear(at))
        free, free_gradient = information[np.ix_(moving, moving)], gradient[moving]

        @cache
        def step_of(damping: float) -> FloatArray:
            step = np.zeros(len(moving))
            step[moving] = damped_step(free, free_gradient, damping)
            return step

        return Linearised(
            at,
            cost,
            lambda damping: at.moved(step_of(damping)),
            lambda damping: -float(gradient @ step_of(damping)),
        )

    damping = NEAR_DAMPING if is_near else START_DAMPING
    return levenberg_marquardt(state, linearise, settled, damping, most)


def solve_without(problem: Problem, fit: Solution, kept: Mask) -> State:
    """The unknowns without some observations, by one step from the converged fit of all.

    The (n,) mask `kept` is of those that remain.
    """
    whitening = Whitening.of(problem, fit.noise, problem.ideal_errors(fit.state), kept)
    information, gradient, *_ = whitening.equations(problem, fit.state, problem.linear(fit.state))
    moving, step = problem.moving, np.zeros(problem.size)
    step[moving] = damped_step(information[np.ix_(moving, moving)], gradient[moving], NEAR_DAMPING)
    return fit.state.moved(step)


def fitted_covariance(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Covariance (p, p) that the fit absorbed of the residuals', zero for held unknowns."""
    return covariance_among(normal_equations(problem, state, noise)[0], problem.moving)


def covariance_of(problem: Problem, solution: Solution) -> FloatArray:
    """Covariance (p, p) of the unknowns, held ones by their prior, where all chains close."""
    information = fisher_information(problem, solution.state, solution.noise)
    return covariance_among(information, problem.counted)


def estimate_noise(
    problem: Problem, state: State, noise: Noise, *, from_above: bool = False
) -> Noise:
    """Estimates the noise levels from the residuals at a state.

    Robots' levels by restricted likelihood (REML); then each sensor's by its squared residuals over
    their redundancy (Foerstner and Wrobel 2016, section 4.2.4), with the others held.

    The search for robots' levels starts at the given ones, or above the residuals: from too low a
    start, it may stay there.
    """
    robots = robot_likelihood(problem, state, noise).levels(from_above=from_above)
    noise = replace(noise, robots=robots)
    if not len(noise.sensors):
        return noise
    squares, redundancies = posterior(problem, state, noise)
    # Repeats scatter by the noise of one, not by that of their weight.
    squares *= problem.repeat_counts
    sensors = noise.sensors.copy()
    for sensor in range(len(sensors)):
        observed = problem.observations.sensors == sensor
        redundancy = float(redundancies[observed].sum())
        if redundancy > 1.0:
            factor = np.sqrt(float(squares[observed].sum()) / redundancy)
            sensors[sensor] = np.clip(sensors[sensor] * factor, *_SENSOR_RANGE)
    if len(problem.least_levels):
        sensors = np.maximum(sensors, problem.least_levels)
    return replace(noise, sensors=sensors)


def posterior(problem: Problem, state: State, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Squared posterior residuals (n,) of the observations, and their expected values (n,).

    Residuals are in units of the observations' noise, after a Gauss-Newton step and less the flange
    errors.
    """
    covariance, linear = problem.covariance(noise), problem.linear(state)
    whitening = Whitening.of(problem, noise, linear.by_errors)
    information, gradient, _, shared = whitening.equations(problem, state, linear)
    fitted = covariance_among(information, problem.moving)
    # The part that unknowns absorb, of each observation alone and through its unit's shared errors.
    carried, step = shared @ fitted, fitted @ gradient
    of_unit = np.eye(shared.shape[1]) + carried @ np.swapaxes(shared, 1, 2)
    weights, taken, units = whitening.weights, whitening.taken, whitening.units
    left, crossed = linear.residuals[:, :, None].copy(), np.zeros_like(linear.by_errors)
    for block in linear.blocks:
        left[block.rows, :, 0] -= block.jacobian @ step[block.columns]
        through = carried[units[block.rows]][:, :, block.columns]
        crossed[block.rows] = block.jacobian @ np.swapaxes(through, 1, 2)
    absorbed = linear.covariance(fitted) @ weights - 2.0 * crossed @ taken
    remaining = weights - weights @ absorbed
    remaining -= np.swapaxes(taken, 1, 2) @ of_unit[units] @ taken
    pulled = whitening.inverse(left)
    squares = np.sum(pulled * (covariance @ pulled), axis=(1, 2))
    unmeasured = np.where(problem.observations.has_rotation, 0.0, 3.0)
    return squares, np.einsum("nij,nji->n", covariance, remaining) - unmeasured


def mahalanobis_sq(
    problem: Problem, used: Mask, solution: Solution
) -> tuple[FloatArray, FloatArray]:
    """Mahalanobis distances of observations from their prediction, flange error included as noise.

    For an observation in the fit, by the (n,) mask `used`, it is that of the deletion residual, by
    the identity of Cook and Weisberg (1982, section 2.2).

    Returns:
        (n,) squared Mahalanobis distances, and (n,) their degrees of freedom.
    """
    linear = problem.linear(solution.state)
    information = normal_equations(problem, solution.state, solution.noise, among=used)[0]
    fitted = covariance_among(information, problem.moving)
    noise = problem.total_covariance(linear, solution.noise)
    covariance = noise + np.where(used, -1.0, 1.0)[:, None, None] * linear.covariance(fitted)
    squares, directions = squared_lengths(linear.residuals, covariance, noise)
    unmeasured = 6 - problem.observations.directions
    return squares, np.asarray(directions - unmeasured, dtype=float)


def left_out_residuals(
    problem: Problem, state: State, noise: Noise, among: Mask | None = None
) -> FloatArray:
    """Deletion residuals (n, 6): of each observation from a fit without it, to first order.

    All observations that share its flange's error are left out with it. By the identity of Cook and
    Weisberg (1982, section 2.2), with the noise levels held. NaN where no robot is observed, and
    for units without observations in the (n,) mask `among`.
    """
    linear, fitted = problem.linear(state), fitted_covariance(problem, state, noise)
    all_jacobians = linear.jacobian
    errors, covariances, (unit_of, _) = (
        problem.error_covariance(noise),
        problem.covariance(noise),
        problem.units,
    )
    deletion = np.full((len(problem), 6), np.nan)
    for unit in np.unique(unit_of if among is None else unit_of[among]).tolist():
        rows = np.flatnonzero(unit_of == unit)
        if unit < 0:
            continue
        by_errors, jacobian = (
            array.reshape(6 * len(rows), -1)
            for array in (linear.by_errors[rows], all_jacobians[rows])
        )
        total = block_diag(*covariances[rows]) + by_errors @ errors[unit] @ by_errors.T
        inverse = covariance_from(total - jacobian @ fitted @ jacobian.T)
        deletion[rows] = (total @ inverse @ linear.residuals[rows].ravel()).reshape(-1, 6)
    return deletion


def by_noise_alone(problem: Problem, solution: Solution) -> FloatArray:
    """Squared Mahalanobis distances (n,) of the residuals by the noise alone, unknowns held."""
    linear = problem.linear(solution.state)
    total = problem.total_covariance(linear, solution.noise)
    white = np.linalg.solve(total, linear.residuals[:, :, None])[:, :, 0]
    return np.asarray(np.sum(linear.residuals * white, axis=1))


def equations_from(
    problem: Problem, solution: Solution, unknowns: IntArray
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Accumulates information and gradient of the observations from each stop on, last stop first.

    Yields:
        Each stop with the rows of the information (a, p) and gradient (a,) of it and all later
        stops, without priors, for (a,) of the unknowns.
    """
    stops, linear = problem.observations.stops, problem.linear(solution.state)
    augmented = np.concatenate([linear.jacobian, linear.residuals[:, :, None]], axis=2)
    # Errors are shared within a stop alone: the weights may be on either side.
    whitening = Whitening.of(problem, solution.noise, linear.by_errors)
    weighted = whitening.inverse(augmented[:, :, unknowns])
    total = np.zeros((len(unknowns), augmented.shape[2]))
    for stop in np.unique(stops)[::-1].tolist():
        at_stop = stops == stop
        total = total + gram(weighted[at_stop], augmented[at_stop])
        yield stop, total[:, :-1], total[:, -1]
