"""Clock offset between camera and robot, from a motion that both recorded.

Starting where both rotate alike, the offset is one more unknown of the chain of frames: it moves
the flange along its trajectory. Where frames have corners, so is the readout time of the images. A
change of the offset is found by what each frame alone would have.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from visioncal.core.linalg import covariance_from, gram
from visioncal.core.quantiles import FALSE_ALARM, f_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import robot_part
from visioncal.core.types import Camera, FloatArray, IntArray, Mask, evenly
from visioncal.estimation.chain import chain
from visioncal.estimation.clock_correlation import (
    FEWEST_FRAMES,
    MOST_FRAMES,
    NEAR_S,
    WIDEST_OFFSET_S,
    WINDOW_S,
    ImageTimes,
)
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.effects.rolling_shutter import (
    READOUT_SIGMA_S,
    Shutter,
    compress_delayed,
    target_twists,
)
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT, Effect, State
from visioncal.estimation.solve import Solution, fit_problem
from visioncal.robot.trajectory import Trajectory
from visioncal.vision.corners import floored_sigma_px

# Frames beyond this multiple of the typical residual are outliers.
_OUTLYING = 4.0
# Fewest stretches for a test.
_FEWEST_STRETCHES = 6


@dataclass(frozen=True, eq=False)
class ClockFit:
    """A clock offset with both edges."""

    offset_s: float  # Camera clock minus robot clock [s].
    sigma_s: float  # Its standard deviation [s]; very large where the motion does not determine it.
    fit: Solution  # Both edges, by the moving frames, and the noise.
    frames: int  # Number of frames used.
    shutter: Shutter | None = None  # Readout of the images, where it was fitted.

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
class _Recorded:
    """A motion by both, with the camera's intrinsics where its readout time is an unknown."""

    robot: Trajectory
    frames: ImageTimes
    camera: Camera | None = None

    def only(self, chosen: Mask) -> "_Recorded":
        return replace(self, frames=self.frames.only(chosen))

    def covered(self, offset_s: float) -> "_Recorded":
        margin_s = 0.5 * self.robot.speed_window_s
        return self.only(self.robot.covers(self.frames.stamps_s - offset_s, margin_s))

    def problem(
        self, offset_s: float, readout_s: float, x: FloatArray
    ) -> tuple[Problem, FloatArray]:
        """The problem at an offset, with changes [s] of the offset and of the readout as effects.

        Second, half the gradient (m, k) of each frame's corners by the readout, its pose
        eliminated.
        """
        frames, stack, camera = self.frames, self.frames.stack, self.camera
        if camera is None or stack is None:
            return clock_problem(self.robot, frames, offset_s), np.zeros((len(frames), 0))
        at_s, poses = frames.stamps_s - offset_s, frames.cam_from_target
        flange, speeds = self.robot.at(at_s), self.robot.speeds(at_s)
        twists = target_twists(frames.mount, flange, x, poses, speeds)
        found = compress_delayed(stack, camera, twists, readout_s, poses)
        unknowns = 6 * len(frames) + 1
        weight = floored_sigma_px(stack.sigma_px(found.residuals, unknowns)) ** -2.0
        prior = PriorInformation(
            weight * found.shared_information + READOUT_SIGMA_S**-2.0,
            weight * found.shared_gradient + READOUT_SIGMA_S**-2.0 * readout_s,
        )
        problem = chain(
            frames.mount,
            flange,
            found.cam_from_target,
            covariance_from(weight * found.information),
            effects=[clock_effect(speeds), Effect.free("readout", prior, found.by_shared)],
        )
        return problem, weight * found.shared_pulls


def clock_problem(robot: Trajectory, frames: ImageTimes, offset_s: float) -> Problem:
    """The problem of some frames at an offset, with the offset's change [s] as an effect."""
    at_s = frames.stamps_s - offset_s
    effects = [clock_effect(robot.speeds(at_s))]
    return chain(
        frames.mount, robot.at(at_s), frames.cam_from_target, frames.covariance, effects=effects
    )


def fit_offset(
    robot: Trajectory, frames: ImageTimes, starts: Sequence[float]
) -> tuple[ClockFit, ...]:
    """Fits the offset and both edges together, from several start offsets [s].

    Returns:
        The fits that stay near their starts, least residual noise first; none where the chain does
        not close, or too few frames are covered.
    """
    # Sparse frames taken at rest match over as long as the rests last.
    is_dense = len(frames) > 2 and float(np.median(np.diff(frames.stamps_s))) <= WINDOW_S
    near_s = NEAR_S if is_dense else WIDEST_OFFSET_S
    recorded = _Recorded(robot, frames.only(evenly(len(frames), MOST_FRAMES)))
    with one_blas_thread():
        fits = [
            fit
            for start in starts
            if (fit := _fitted(recorded, start)) is not None and abs(fit.offset_s - start) <= near_s
        ]
    # A fit of few frames agrees with anything.
    most = max((fit.frames for fit in fits), default=0)
    complete = (fit for fit in fits if 2 * fit.frames > most)
    return tuple(sorted(complete, key=lambda fit: fit.residual))


def fit_readout(
    robot: Trajectory, frames: ImageTimes, camera: Camera | None, start: ClockFit
) -> ClockFit | None:
    """Fits the readout time of the images, the offset and both edges together.

    `start` is the fit without it. None where too few frames are covered, or their corners or the
    camera's intrinsics are not known.
    """
    if frames.stack is None or camera is None:
        return None
    recorded = _Recorded(robot, frames.only(evenly(len(frames), MOST_FRAMES)), camera)
    with one_blas_thread():
        return _fitted(recorded, start.offset_s, start.fit.state)


def clear_fit(fits: Sequence[ClockFit], stated_s: float | None) -> ClockFit | None:
    """The best fit, unless repetitive motion makes distinct offsets equally good.

    Then it is the one near the stated offset; None where none is, or there are no fits.
    """
    # Ratio of residual noise, rotations times positions, up to which fits are equally good.
    rivals = [fit for fit in fits if fit.residual <= 1.2 * fits[0].residual]
    if any(abs(fit.offset_s - fits[0].offset_s) > NEAR_S for fit in rivals):
        about_s = np.inf if stated_s is None else stated_s
        rivals = [fit for fit in rivals if abs(fit.offset_s - about_s) <= NEAR_S]
    return next(iter(rivals), None)


def clock_change(robot: Trajectory, frames: ImageTimes, fit: ClockFit) -> ClockChange | None:
    """Finds a step of the offset at any frame, or a steady drift; None where noise explains it.

    Means of the frames' own offsets over stretches of time are taken as independent; their residual
    scatter is the noise of the test (of a change point; Page 1955). A fit to both sides of a step
    is biased, so that the step is refined in a few rounds.
    """
    chosen, offsets_s, weights = _own_offsets(robot, frames, fit)
    change = _tested_change(frames.stamps_s[chosen], offsets_s, weights)
    if change is None:
        return None
    for _ in range(3):
        corrected = replace(frames, stamps_s=change.corrected(frames.stamps_s))
        fits = fit_offset(robot, corrected, [fit.offset_s])
        # Share to which a change of the offset must reduce the residual noise.
        if not fits or fits[0].residual > 0.9 * fit.residual:
            return None
        if frames.stack is not None:
            # A rolling shutter follows the motion, and would be taken for the clock's change.
            break
        chosen, offsets_s, weights = _own_offsets(robot, corrected, fits[0])
        more_s, sigma_s, _ = _fit_slope(change.shares(frames.stamps_s[chosen]), offsets_s, weights)
        change = replace(change, step_s=change.step_s + more_s, sigma_s=sigma_s)
    return change


def _tested_change(
    times_s: FloatArray, offsets_s: FloatArray, weights: FloatArray
) -> ClockChange | None:
    """The most significant step or drift of frames' own offsets (m,) [s]."""
    stretch_of = _stretches(times_s)
    information = np.bincount(stretch_of, weights).astype(float)
    valid = information > 0.0
    if np.sum(valid) < _FEWEST_STRETCHES:
        return None
    information = information[valid]
    means, times = (
        np.bincount(stretch_of, weights * values)[valid] / information
        for values in (offsets_s, times_s)
    )
    columns = [times - times[0], *((times >= middle).astype(float) for middle in times[2:-1])]
    scored = [_fit_slope(column, means, information) for column in columns]
    best = int(np.argmax([square for _, _, square in scored]))
    step_s, sigma_s, square = scored[best]
    if square < f_limit(FALSE_ALARM / len(scored), 1, len(means) - 2):
        return None
    if best == 0:
        return ClockChange(float(times_s[0]), step_s, sigma_s, is_drift=True)
    # The most significant frame within the neighbouring stretches.
    nearby = times_s[(times_s >= times[best]) & (times_s <= times[best + 2])]
    scores = [_fit_slope((times_s >= at).astype(float), offsets_s, weights)[2] for at in nearby]
    return ClockChange(float(nearby[int(np.argmax(scores))]), step_s, sigma_s, is_drift=False)


def _own_offsets(
    robot: Trajectory, frames: ImageTimes, fit: ClockFit
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Frames (m,), the change of the offset that each alone would have [s], and its information.

    Frames that no offset explains have no information.
    """
    chosen = evenly(len(frames), MOST_FRAMES)
    margin_s = 0.5 * robot.speed_window_s
    chosen = chosen[robot.covers(frames.stamps_s[chosen] - fit.offset_s, margin_s)]
    problem = clock_problem(robot, frames.only(chosen), fit.offset_s)
    linear = problem.linear(State(fit.fit.state.edges, problem.start_values))
    columns = np.concatenate([linear.jacobian[:, :, -1:], linear.residuals[:, :, None]], axis=2)
    blocks = problem.total_covariance(linear, fit.fit.noise)
    products = np.swapaxes(columns, 1, 2) @ np.linalg.solve(blocks, columns)
    information, gradient = np.maximum(products[:, 0, 0], 1e-12), products[:, 0, 1]
    remaining = products[:, 1, 1] - gradient**2 / information
    outlier = remaining > _OUTLYING**2 * float(np.median(remaining))
    return chosen, -gradient / information, np.where(outlier, 0.0, information)


def _stretches(times_s: FloatArray) -> IntArray:
    """(m,) number of the stretch of time that each belongs to, from 0."""
    first_s = times_s.min(initial=np.inf)
    # Length of a stretch of time within which errors may be correlated [s].
    return np.unique((times_s - first_s) // 1.0, return_inverse=True)[1]


def _fit_slope(
    column: FloatArray, values: FloatArray, weights: FloatArray
) -> tuple[float, float, float]:
    """A slope beside a constant by weighted least squares, its sigma, and its F statistic."""
    total = weights.sum()
    centred = column - weights @ column / total
    centred_values = values - weights @ values / total
    square = float(weights @ centred**2)
    if square <= 0.0:
        return 0.0, np.inf, 0.0
    slope = float(weights @ (centred * centred_values)) / square
    variance = float(weights @ (centred_values - slope * centred) ** 2) / (len(values) - 2)
    sigma = float(np.sqrt(variance / square))
    return slope, sigma, (slope / sigma) ** 2 if sigma > 0.0 else 0.0


def _fitted(recorded: _Recorded, offset_s: float, start: State | None = None) -> ClockFit | None:
    """Fits from one start, and once more without outlier frames."""
    clock = _iterated(recorded, offset_s, 0.0, start)
    if clock is None:
        return None
    near, state = recorded.covered(clock.offset_s), clock.fit.state
    readout_s = 0.0 if clock.shutter is None else clock.shutter.readout_s
    problem, _ = near.problem(clock.offset_s, readout_s, state.edges[0])
    linear = problem.linear(state)
    covariance = problem.total_covariance(linear, clock.fit.noise)
    squares = np.einsum(
        "mi,mij,mj->m", linear.residuals, np.linalg.inv(covariance), linear.residuals
    )
    inliers = squares <= _OUTLYING**2 * float(np.median(squares))
    if inliers.all():
        return clock
    return _iterated(near.only(inliers), clock.offset_s, readout_s, state)


def _iterated(
    recorded: _Recorded, offset_s: float, readout_s: float, start: State | None
) -> ClockFit | None:
    """Iterates readout, offset and edges to convergence; None where too few frames are covered."""
    for _ in range(12):
        covered = recorded.covered(offset_s)
        count = len(covered.frames)
        if count < FEWEST_FRAMES:
            return None
        if start is None:
            problem = clock_problem(covered.robot, covered.frames, offset_s)
            frames = covered.frames
            robot = robot_part(problem.poses[ROBOT], frames.mount)
            edges = SOLVERS["park"](robot, frames.cam_from_target)
            start = State(np.array([edges.x, edges.z]), problem.start_values)
        problem, pulls = covered.problem(offset_s, readout_s, start.edges[0])
        solution = fit_problem(problem, State(start.edges, problem.start_values))
        # Limited to the correlation window: a longer step is beyond the linearisation.
        steps_s = np.clip(solution.state.values, -WINDOW_S, WINDOW_S)
        start, offset_s = solution.state, offset_s + float(steps_s[0])
        readout_s += float(steps_s[1:].sum())
        if np.abs(steps_s).max() < 1e-7:
            break
    fit = replace(solution, state=State(solution.state.edges, problem.start_values))
    sigmas_s, freedom = _sigmas_s(problem, fit, covered.frames.stamps_s, pulls)
    shutter = None
    if covered.camera is not None and len(sigmas_s) > 1:
        is_clear = (readout_s / sigmas_s[1]) ** 2 > f_limit(FALSE_ALARM, 1, freedom)
        line_s = readout_s / (covered.camera.resolution[1] - 1)
        kind: Literal["rolling", "global"] = "rolling" if is_clear else "global"
        shutter = Shutter(kind, readout_s, float(sigmas_s[1]), line_s)
    return ClockFit(offset_s, float(sigmas_s[0]), fit, count, shutter)


def _sigmas_s(
    problem: Problem, fit: Solution, stamps_s: FloatArray, pulls: FloatArray
) -> tuple[FloatArray, float]:
    """Standard deviations of the offset and of the readout, and their degrees of freedom.

    The larger of two each. One takes the errors of all frames for independent. The other takes
    those of a stretch of time together (the jackknife over clusters; Bell and McCaffrey 2002),
    which holds where the errors of a lens or an arm are correlated in time.
    """
    # A direction without information has a very large variance here.
    covariance = covariance_from(fisher_information(problem, fit.state, fit.noise))
    independent = np.diag(covariance)[12:]
    stretches = _stretches(stamps_s)
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
