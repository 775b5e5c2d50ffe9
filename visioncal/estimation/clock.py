"""Clock offset between camera and robot, from a motion that both recorded.

Starting where both rotate alike, the offset is one more unknown of the chain of frames: it moves
the flange along its trajectory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.chain import chain
from visioncal.estimation.clock_correlation import NEAR_S, WIDEST_OFFSET_S, WINDOW_S, ImageTimes
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.effects import EFFECTS
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.effects.delays import Delay, compress_delayed, shares_of, target_twists
from visioncal.estimation.linalg import covariance_from, gram
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.outliers import closed_form
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.solve import (
    Solution,
    fit_problem,
)
from visioncal.estimation.trajectory import Trajectory

# Frames for a start; most and fewest frames of a fit.
_START_FRAMES, _MOST_FRAMES, _FEWEST_FRAMES = 60, 1200, 4
# Frames for delays within images: each has dozens of corners.
_MOST_DELAYED = 400
# False alarms, per sweep, of delays and of changes of the offset.
_FALSE_ALARM = 1e-4
_ROUNDS, _CONVERGED_S = 12, 1e-7
# Frames beyond this multiple of the typical residual are outliers.
_OUTLYING = 4.0
# Length of a stretch of time within which errors may be correlated [s]; fewest stretches for a
# test.
_STRETCH_S, _FEWEST_STRETCHES = 1.0, 6
# Most frames whose own offset is estimated, the farthest from the common one, and the search step
# [s].
_MOST_OWN, _FARTHEST_S, _SEARCH_STEP_S = 600, 0.5, 0.02
# Ratio of residual noise, rotations times positions, up to which fits are equally good.
_ALIKE = 1.2


@dataclass(frozen=True, eq=False)
class DelayEstimate:
    """Estimated delay within images, such as that of a rolling shutter."""

    of: Delay
    time_s: float  # The delay [s].
    sigma_s: float  # Its standard deviation [s].
    is_clear: bool  # Whether it is significant, and was corrected.
    resolution: tuple[int, int]  # Resolution of the images [px].
    # (6,) Jacobian of each view's `cam_from_target` by the delay, by view.
    jacobian: Mapping[int, FloatArray] = field(default_factory=dict)

    def effect(self, views: Sequence[int], name: str = "") -> Effect:
        """Error of the delay as an unknown of some views; see `stages.clocks.clock_effects`."""
        unaffected = np.zeros(6)
        jacobian = np.array([self.jacobian.get(view, unaffected) for view in views])
        prior = PriorInformation(np.array([[self.sigma_s**-2.0]]), np.zeros(1))
        return Effect.free(name or self.of.name, prior, jacobian.reshape(-1, 6, 1))

    def result(self) -> dict[str, Any]:
        """Fields of `results.ClockResult`."""
        return self.of.result(self.time_s, self.sigma_s, self.is_clear, self.resolution)

    @property
    def words(self) -> str:
        """The delay in words."""
        return self.of.words(self.time_s, self.sigma_s)


@dataclass(frozen=True, eq=False)
class ClockFit:
    """A clock offset with both edges."""

    offset_s: float  # Camera clock minus robot clock [s].
    sigma_s: float  # Its standard deviation [s]; very large where the motion does not determine it.
    fit: Solution  # Both edges, by the moving frames, and the noise.
    frames: int  # Number of frames used.
    delays: tuple[DelayEstimate, ...] = ()  # Delays within the images, where they were fitted.

    @property
    def residual(self) -> float:
        """Residual noise of rotations times positions, as the likelihood has it."""
        return float(self.fit.noise.robots.prod())


@dataclass(frozen=True)
class ClockChange:
    """Step or drift of a clock offset."""

    from_s: float  # Camera time of the step, or of the start of the drift [s].
    step_s: float  # Increase of the offset [s]; of a drift, per second.
    sigma_s: float  # Its standard deviation.
    is_drift: bool  # Whether the offset grows steadily.

    def shares(self, stamps_s: FloatArray) -> FloatArray:
        """(m,) change of the offset at some times [s], in units of `step_s`."""
        later_s = stamps_s - self.from_s
        return later_s if self.is_drift else (later_s >= 0.0).astype(float)

    def corrected(self, stamps_s: FloatArray) -> FloatArray:
        """(m,) times by a clock without the change [s]."""
        return np.asarray(stamps_s - self.step_s * self.shares(stamps_s))


@dataclass(frozen=True, eq=False)
class _Delays:
    """Delays within images, with their current times [s]; none without a camera."""

    camera: Camera | None = None
    delays: tuple[Delay, ...] = ()
    times_s: FloatArray = field(default_factory=lambda: np.zeros(0))

    def problem(
        self, robot: Trajectory, frames: ImageTimes, offset_s: float, state: State
    ) -> tuple[Problem, FloatArray]:
        """The problem of some frames, with changes of the offset and of the times [s].

        Second, half the gradient (m, k) of each frame's corners by the times, its pose eliminated.
        """
        stack = frames.stack
        if self.camera is None or stack is None:
            return clock_problem(robot, frames, offset_s), np.zeros((len(frames), 0))
        at_s, poses = frames.stamps_s - offset_s, frames.cam_from_target
        flange, speeds = robot.at(at_s), robot.speeds(at_s)
        twists = target_twists(frames.mount, flange, state.edges[0], poses, speeds)
        shares = shares_of(self.delays, stack, self.camera)
        compressed = compress_delayed(stack, self.camera, shares, twists, self.times_s, poses)
        unknowns = 6 * len(frames) + len(self.times_s)
        weight = floored_sigma_px(stack.sigma_px(compressed.residuals, unknowns)) ** -2.0
        prior = np.array([delay.sigma_s for delay in self.delays]) ** -2.0
        knowledge = PriorInformation(
            weight * compressed.shared_information + np.diag(prior),
            weight * compressed.shared_gradient + prior * self.times_s,
        )
        problem = chain(
            frames.mount,
            flange,
            compressed.cam_from_target,
            covariance_from(weight * compressed.information),
            effects=[clock_effect(speeds), Effect.free("delays", knowledge, compressed.by_shared)],
        )
        return problem, weight * compressed.shared_pulls


def fit_offset(
    robot: Trajectory, frames: ImageTimes, starts: Sequence[float]
) -> tuple[ClockFit, ...]:
    """Fits the offset and both edges together, from several start offsets [s].

    Returns:
        The fits that stay near their starts, least residual noise first; none where the chain does
        not close, or too few frames are covered.
    """
    # Sparse frames taken at rest match over as long as the rests last.
    near_s = NEAR_S if frames.are_dense else WIDEST_OFFSET_S
    with one_blas_thread():
        selected = frames.only(_evenly(len(frames), _MOST_FRAMES))
        fits = [
            fit
            for start in starts
            if (fit := _fitted(robot, selected, start, None, _Delays())) is not None
            and abs(fit.offset_s - start) <= near_s
        ]
    # A fit of few frames agrees with anything.
    most = max((fit.frames for fit in fits), default=0)
    complete = (fit for fit in fits if 2 * fit.frames > most)
    return tuple(sorted(complete, key=lambda fit: fit.residual))


def fit_delays(
    robot: Trajectory, frames: ImageTimes, camera: Camera | None, start: ClockFit
) -> ClockFit | None:
    """Fits all delays within images, the offset and both edges together.

    `start` is the fit without delays. None where too few frames are covered, or their corners or
    the camera's intrinsics are not known.
    """
    if frames.stack is None or camera is None:
        return None
    with one_blas_thread():
        selected = frames.only(_evenly(len(frames), _MOST_DELAYED))
        free = _Delays(camera, EFFECTS, np.zeros(len(EFFECTS)))
        return _fitted(robot, selected, start.offset_s, start.fit.state, free)


def clock_change(robot: Trajectory, frames: ImageTimes, fit: ClockFit) -> ClockChange | None:
    """Tests for a step of the offset at any frame, and for a steady drift.

    For each frame the offset is estimated at which it agrees with the fit. Means of these over
    stretches of time are taken as independent; their residual scatter is the noise of the test (of
    a change point; Page 1955). None where noise explains it, or there are too few stretches.
    """
    selected = frames.only(_evenly(len(frames), _MOST_OWN))
    selected = selected.only(robot.covers(selected.stamps_s - fit.offset_s, _FARTHEST_S))
    own_s, weights = _own_offsets(robot, selected, fit)
    times_s, stretch_of = selected.stamps_s, np.zeros(len(selected), dtype=np.int64)
    if len(selected):
        stretch_of = np.unique((times_s - times_s[0]) // _STRETCH_S, return_inverse=True)[1]
    information = np.bincount(stretch_of, weights).astype(float)
    valid = information > 0.0
    if np.sum(valid) < _FEWEST_STRETCHES:
        return None
    means = (np.bincount(stretch_of, weights * own_s)[valid]) / information[valid]
    times = (np.bincount(stretch_of, weights * times_s)[valid]) / information[valid]
    columns = [(times >= middle).astype(float) for middle in times[2:-1]]
    columns.insert(0, times - times[0])
    scored = [_fit_slope(column, means, information[valid]) for column in columns]
    freedom = len(means) - 2
    best = int(np.argmax([pair[2] for pair in scored]))
    step_s, sigma_s, square = scored[best]
    if square < f_limit(_FALSE_ALARM / len(scored), 1, freedom):
        return None
    if best == 0:
        return ClockChange(float(times_s[0]), step_s, sigma_s, is_drift=True)
    # The most significant frame within the neighbouring stretches.
    nearby = np.flatnonzero((times_s >= times[best]) & (times_s <= times[best + 2]))
    scores = [
        _fit_slope((times_s >= times_s[index]).astype(float), own_s, weights)[2] for index in nearby
    ]
    from_s = float(times_s[nearby[int(np.argmax(scores))]])
    return ClockChange(from_s, step_s, sigma_s, is_drift=False)


def refined_change(
    robot: Trajectory, frames: ImageTimes, fit: ClockFit, stamped: ImageTimes, change: ClockChange
) -> ClockChange:
    """Re-estimates the size of a change from frames at times corrected by it, and their fit.

    `stamped` are the same frames at their stamped times.
    """
    selected = _evenly(len(frames), _MOST_OWN)
    inside = robot.covers(frames.stamps_s[selected] - fit.offset_s, _FARTHEST_S)
    selected = selected[inside]
    own_s, weights = _own_offsets(robot, frames.only(selected), fit)
    more_s, sigma_s, _ = _fit_slope(change.shares(stamped.stamps_s[selected]), own_s, weights)
    return replace(change, step_s=change.step_s + more_s, sigma_s=sigma_s)


def _own_offsets(
    robot: Trajectory, frames: ImageTimes, fit: ClockFit
) -> tuple[FloatArray, FloatArray]:
    """(m,) change of the offset that each frame alone would have [s], and its information."""
    # Frames that no offset explains have no information.
    best = np.full(len(frames), np.inf)
    own_s, weights = np.zeros(len(frames)), np.zeros(len(frames))
    for change_s in np.arange(-_FARTHEST_S, _FARTHEST_S + 0.5 * _SEARCH_STEP_S, _SEARCH_STEP_S):
        problem = clock_problem(robot, frames, fit.offset_s + change_s)
        linear = problem.linear(State(fit.fit.state.edges, problem.start_values))
        offset_jacobian = linear.jacobian[:, :, -1:]
        columns = np.concatenate([offset_jacobian, linear.residuals[:, :, None]], axis=2)
        blocks = problem.total_covariance(linear, fit.fit.noise)
        products = np.swapaxes(columns, 1, 2) @ np.linalg.solve(blocks, columns)
        information, gradient = np.maximum(products[:, 0, 0], 1e-12), products[:, 0, 1]
        step_s = -gradient / information
        remaining = products[:, 1, 1] - gradient**2 / information
        better = (remaining < best) & (np.abs(step_s) <= _SEARCH_STEP_S)
        best = np.where(better, remaining, best)
        own_s = np.where(better, change_s + step_s, own_s)
        weights = np.where(better, information, weights)
    inlier = best <= _OUTLYING**2 * float(np.median(best))
    return own_s, np.where(inlier, weights, 0.0)


def _fit_slope(column: FloatArray, values: FloatArray, weights: FloatArray) -> tuple[float, ...]:
    """A slope beside a constant by weighted least squares, its sigma, and its F statistic."""
    count, total = len(values), weights.sum()
    centred = column - weights @ column / total
    centred_values = values - weights @ values / total
    square = float(weights @ centred**2)
    if square <= 0.0:
        return 0.0, np.inf, 0.0
    slope = float(weights @ (centred * centred_values)) / square
    residual_variance = float(weights @ (centred_values - slope * centred) ** 2) / (count - 2)
    sigma = float(np.sqrt(residual_variance / square))
    return slope, sigma, (slope / sigma) ** 2 if sigma > 0.0 else 0.0


def clear_fit(fits: Sequence[ClockFit], stated_s: float | None) -> ClockFit | None:
    """The best fit, unless repetitive motion makes distinct offsets equally good.

    Then it is the one near the stated offset; None where none is, or there are no fits.
    """
    rivals = [fit for fit in fits if fit.residual <= _ALIKE * fits[0].residual]
    if all(abs(fit.offset_s - fits[0].offset_s) <= NEAR_S for fit in rivals):
        return next(iter(fits), None)
    near = (
        fit for fit in rivals if stated_s is not None and abs(fit.offset_s - stated_s) <= NEAR_S
    )
    return next(near, None)


def _evenly(count: int, most: int) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _fitted(
    robot: Trajectory, frames: ImageTimes, offset_s: float, start: State | None, delays: _Delays
) -> ClockFit | None:
    """Fits from one start, and once more without outlier frames."""
    clock = _iterated(robot, frames, offset_s, start, delays)
    if clock is None:
        return None
    delays = replace(delays, times_s=np.array([delay.time_s for delay in clock.delays]))
    near = _covered(robot, frames, clock.offset_s)
    inliers = _inliers(delays.problem(robot, near, clock.offset_s, clock.fit.state)[0], clock.fit)
    if inliers.all():
        return clock
    return _iterated(robot, near.only(inliers), clock.offset_s, clock.fit.state, delays)


def _iterated(
    robot: Trajectory, frames: ImageTimes, offset_s: float, start: State | None, delays: _Delays
) -> ClockFit | None:
    """Iterates delays, offset and edges to convergence; None where too few frames are covered."""
    for _ in range(_ROUNDS):
        covered = _covered(robot, frames, offset_s)
        if len(covered) < _FEWEST_FRAMES:
            return None
        if start is None:
            first = _evenly(len(covered), _START_FRAMES)
            start = closed_form(clock_problem(robot, covered, offset_s), first)
        if start is None:
            raise RuntimeError("no closed form gives a start")
        problem, pulls = delays.problem(robot, covered, offset_s, start)
        solution = fit_problem(problem, State(start.edges, problem.start_values))
        # Limited to the correlation window: a longer step is beyond the linearisation.
        step_s = np.clip(solution.state.values, -WINDOW_S, WINDOW_S)
        start, offset_s = solution.state, offset_s + float(step_s[0])
        delays = replace(delays, times_s=delays.times_s + step_s[1:])
        if np.abs(step_s).max() < _CONVERGED_S:
            break
    fit = replace(solution, state=State(solution.state.edges, problem.start_values))
    sigmas_s, freedom = _sigmas_s(problem, fit, covered.stamps_s, pulls)
    limit = f_limit(_FALSE_ALARM, 1, freedom)
    size = (0, 0) if delays.camera is None else delays.camera.resolution
    estimates = tuple(
        DelayEstimate(of, time_s, sigma_s, bool((time_s / sigma_s) ** 2 > limit), size)
        for of, time_s, sigma_s in zip(
            delays.delays, delays.times_s.tolist(), sigmas_s[1:].tolist(), strict=True
        )
    )
    return ClockFit(offset_s, float(sigmas_s[0]), fit, len(covered), estimates)


def _covered(robot: Trajectory, frames: ImageTimes, offset_s: float) -> ImageTimes:
    margin_s = 0.5 * robot.speed_window_s
    return frames.only(robot.covers(frames.stamps_s - offset_s, margin_s))


def clock_problem(robot: Trajectory, frames: ImageTimes, offset_s: float) -> Problem:
    """The problem of some frames at an offset, with the offset's change [s] as an effect."""
    at_s = frames.stamps_s - offset_s
    return chain(
        frames.mount,
        robot.at(at_s),
        frames.cam_from_target,
        frames.covariance,
        effects=[clock_effect(robot.speeds(at_s))],
    )


def _inliers(problem: Problem, fit: Solution) -> Mask:
    """Mask of the frames whose residuals are within the outlier limit."""
    linear = problem.linear(fit.state)
    residuals, covariance = linear.residuals, problem.total_covariance(linear, fit.noise)
    squares = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(covariance), residuals)
    return np.asarray(squares <= _OUTLYING**2 * float(np.median(squares)))


def _sigmas_s(
    problem: Problem, fit: Solution, stamps_s: FloatArray, pulls: FloatArray
) -> tuple[FloatArray, float]:
    """Standard deviations of the offset and of the delays, and their degrees of freedom.

    The larger of two each. One takes the errors of all frames for independent. The other takes
    those of a stretch of time together (the jackknife over clusters; Bell and McCaffrey 2002),
    which holds where the errors of a lens or an arm are correlated in time.
    """
    # A direction without information has a very large variance here.
    covariance = covariance_from(fisher_information(problem, fit.state, fit.noise))
    independent = np.diag(covariance)[12:]
    stretches = np.unique((stamps_s - stamps_s[0]) // _STRETCH_S, return_inverse=True)[1]
    count = int(stretches.max()) + 1
    if count < _FEWEST_STRETCHES:
        return np.sqrt(independent), 6.0 * len(stamps_s)
    linear = problem.linear(fit.state)
    residuals, jacobian = linear.residuals, linear.jacobian
    blocks = problem.total_covariance(linear, fit.noise)
    weighted = np.linalg.solve(blocks, np.concatenate([jacobian, residuals[:, :, None]], axis=2))
    information, changes = covariance_from(covariance), np.zeros((count, jacobian.shape[2]))
    for stretch in range(count):
        rows = stretches == stretch
        products = gram(jacobian[rows], weighted[rows])
        products[len(products) - pulls.shape[1] :, -1] += pulls[rows].sum(axis=0)
        # Leave-one-out: the stretch's own leverage would hide its error.
        changes[stretch] = covariance_from(information - products[:, :-1]) @ products[:, -1]
    clustered = changes.T @ changes * (count - 1) / count
    return np.sqrt(np.maximum(independent, np.diag(clustered)[12:])), count - 1.0
