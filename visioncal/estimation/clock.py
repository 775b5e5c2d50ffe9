"""What one clock is ahead of another, from one motion that was seen by both.

From where both turn alike, the offset is one more unknown of the chain of frames: it moves the
flange along its way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.chain import chain
from visioncal.estimation.clock_correlation import NEAR_S, WIDEST_OFFSET_S, WINDOW_S, ImageTimes
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.effects.delays import Delay, compress_delayed, shares_of, target_twists
from visioncal.estimation.linalg import covariance_from, gram
from visioncal.estimation.outliers import closed_form
from visioncal.estimation.parts import Effect, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, fisher_information, fit_problem
from visioncal.estimation.trajectory import Trajectory
from visioncal.estimation.variance import Knowledge

# A start from more frames is no better; a fit of more takes long.
_START_FRAMES, _MOST_FRAMES, _FEWEST_FRAMES = 60, 1200, 4
# So many determine times within images well enough: each has dozens of corners.
_MOST_DELAYED = 400
# Times within images are there by chance in one sweep of ten thousand.
_FALSE_ALARM = 1e-4
_ROUNDS, _SETTLED_S = 12, 1e-7
# Frames that are off by so many times what is typical are wrong ones.
_OUTLYING = 4.0
# Errors of frames within this time of each other may be alike [s]; so many stretches suffice.
_STRETCH_S, _FEWEST_STRETCHES = 1.0, 6
# So many frames are asked for their own offset, so far from the common one at most, in such steps
# [s].
_MOST_ASKED, _FARTHEST_S, _ASKED_STEP_S = 600, 0.5, 0.02
# Fits that leave so many times the least, of rotations times positions, are no worse.
_ALIKE = 1.2


@dataclass(frozen=True, eq=False)
class ClockFit:
    """An offset with both edges.

    Attributes:
        offset_s: What the camera's clock is ahead of the robot's [s].
        sigma_s: Its standard deviation [s]; very large where the motion does not determine it.
        fit: Both edges, as the moving frames have them, and the noise.
        frames: How many frames it rests on.
    """

    offset_s: float
    sigma_s: float
    fit: Solution
    frames: int


@dataclass(frozen=True, eq=False)
class DelayedFit:
    """An offset with times by which corners are taken later than others.

    Attributes:
        clock: The offset and both edges.
        delays: The effects.
        times_s: (k,) their times [s].
        sigmas_s: (k,) the standard deviations of these [s].
        freedom: How many degrees of freedom these were estimated with.
    """

    clock: ClockFit
    delays: tuple[Delay, ...]
    times_s: FloatArray
    sigmas_s: FloatArray
    freedom: float

    @property
    def is_clear(self) -> Mask:
        """(k,) which of the times are beyond chance."""
        limit = f_limit(_FALSE_ALARM, 1, self.freedom)
        return np.asarray((self.times_s / self.sigmas_s) ** 2 > limit)


@dataclass(frozen=True)
class ClockChange:
    """How an offset changes over the frames.

    Attributes:
        from_s: From which of the camera's times on it is another [s]; of a drift, from which on it
            grows.
        step_s: By how much it is larger then [s]; of a drift, in a second.
        sigma_s: The standard deviation of that.
        is_drift: Whether it grows steadily.
    """

    from_s: float
    step_s: float
    sigma_s: float
    is_drift: bool

    def shares(self, stamps_s: FloatArray) -> FloatArray:
        """(m,) how many steps the offset has changed by at some times [s]."""
        later_s = stamps_s - self.from_s
        return later_s if self.is_drift else (later_s >= 0.0).astype(float)

    def corrected(self, stamps_s: FloatArray) -> FloatArray:
        """(m,) times as a clock would have them that did not change [s]."""
        return np.asarray(stamps_s - self.step_s * self.shares(stamps_s))


@dataclass(frozen=True, eq=False)
class _Late:
    """Effects of time within images, with where their times are [s]; none without a camera."""

    camera: Camera | None
    delays: tuple[Delay, ...]
    times_s: FloatArray

    def problem(
        self, robot: Trajectory, frames: ImageTimes, offset_s: float, state: State
    ) -> tuple[Problem, FloatArray]:
        """The problem of some frames, with changes of the offset and of the times [s]."""
        # With it, (m, k) half the gradient of each frame's corners by the times, its pose being
        # free.
        stack = frames.stack
        if self.camera is None or stack is None:
            return clock_problem(robot, frames, offset_s), np.zeros((len(frames), 0))
        at_s, poses = frames.stamps_s - offset_s, frames.cam_from_target
        flange, speeds = robot.at(at_s), robot.speeds(at_s)
        moved = target_twists(frames.mount, flange, state.edges[0], poses, speeds)
        shares = shares_of(self.delays, stack, self.camera)
        seen = compress_delayed(stack, self.camera, shares, moved, self.times_s, poses)
        unknowns = 6 * len(frames) + len(self.times_s)
        weight = floored_sigma_px(stack.sigma_px(seen.residuals, unknowns)) ** -2.0
        prior = np.array([delay.sigma_s for delay in self.delays]) ** -2.0
        known = Knowledge(
            weight * seen.shared_information + np.diag(prior),
            weight * seen.shared_gradient + prior * self.times_s,
        )
        problem = chain(
            frames.mount,
            flange,
            seen.cam_from_target,
            covariance_from(weight * seen.information),
            effects=[clock_effect(speeds), Effect.free("delays", known, seen.by_shared)],
        )
        return problem, weight * seen.shared_pulls


def fit_offset(
    robot: Trajectory, frames: ImageTimes, starts: Sequence[float]
) -> tuple[ClockFit, ...]:
    """Fits the offset and both edges together, from several starts.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw.
        starts: Offsets to start from [s].

    Returns:
        The fits that stay near their starts, the one that leaves the least first; none where the
        chain does not close, or too few frames are covered.
    """
    # Frames that are rare and taken at rest match over as long as the rests last.
    near_s = NEAR_S if frames.are_dense else WIDEST_OFFSET_S
    with one_blas_thread():
        some = frames.only(_evenly(len(frames), _MOST_FRAMES))
        on_time = _Late(None, (), np.zeros(0))
        fits = [
            fit.clock
            for start in starts
            if (fit := _fitted(robot, some, start, None, on_time)) is not None
            and abs(fit.clock.offset_s - start) <= near_s
        ]
    # Few frames agree with anything.
    most = max((fit.frames for fit in fits), default=0)
    whole = (fit for fit in fits if 2 * fit.frames > most)
    return tuple(sorted(whole, key=left_by))


def fit_delays(
    robot: Trajectory, frames: ImageTimes, camera: Camera, start: ClockFit, delays: Sequence[Delay]
) -> DelayedFit | None:
    """Fits times within images, the offset and both edges together.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw.
        camera: The intrinsics.
        start: The fit without them.
        delays: The effects.

    Returns:
        The fit; None where too few frames are covered, or their corners are not known.
    """
    if frames.stack is None or not delays:
        return None
    with one_blas_thread():
        some = frames.only(_evenly(len(frames), _MOST_DELAYED))
        late = _Late(camera, tuple(delays), np.zeros(len(delays)))
        return _fitted(robot, some, start.offset_s, start.fit.state, late)


def clock_change(robot: Trajectory, frames: ImageTimes, fit: ClockFit) -> ClockChange | None:
    """Looks for a step of the offset at any frame, and for a steady drift.

    Each frame is asked for the offset at which it is where the fit has it. Means of these over
    stretches of time are independent, as far as errors that last are: what they leave is the noise
    of the test (of a change point; Page 1955).

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw.
        fit: The fit with one offset.

    Returns:
        The change; None where noise explains it, or there are too few stretches.
    """
    some = frames.only(_evenly(len(frames), _MOST_ASKED))
    some = some.only(robot.covers(some.stamps_s - fit.offset_s, _FARTHEST_S))
    asked_s, weights = _asked_offsets(robot, some, fit)
    times_s, of = some.stamps_s, np.zeros(len(some), dtype=np.int64)
    if len(some):
        of = np.unique((times_s - times_s[0]) // _STRETCH_S, return_inverse=True)[1]
    sums = np.bincount(of, weights).astype(float)
    kept = sums > 0.0
    if np.sum(kept) < _FEWEST_STRETCHES:
        return None
    means = (np.bincount(of, weights * asked_s)[kept]) / sums[kept]
    middles = (np.bincount(of, weights * times_s)[kept]) / sums[kept]
    columns = [(middles >= middle).astype(float) for middle in middles[2:-1]]
    tried = [_slope(value, means, sums[kept]) for value in (middles - middles[0], *columns)]
    freedom = len(means) - 2
    best = int(np.argmax([pair[2] for pair in tried]))
    step_s, sigma_s, square = tried[best]
    if square < f_limit(_FALSE_ALARM / len(tried), 1, freedom):
        return None
    if best == 0:
        return ClockChange(float(times_s[0]), step_s, sigma_s, is_drift=True)
    # Within the stretches about it, the frame that parts best.
    near = np.flatnonzero((times_s >= middles[best]) & (times_s <= middles[best + 2]))
    parts = [
        _slope((times_s >= times_s[index]).astype(float), asked_s, weights)[2] for index in near
    ]
    from_s = float(times_s[near[int(np.argmax(parts))]])
    return ClockChange(from_s, step_s, sigma_s, is_drift=False)


def refined_change(
    robot: Trajectory, frames: ImageTimes, fit: ClockFit, stamped: ImageTimes, change: ClockChange
) -> ClockChange:
    """The change with what frames ask for that are corrected by it.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw, at corrected times.
        fit: The fit of these.
        stamped: The same at the times that were stamped.
        change: The change by which they are corrected.
    """
    some = _evenly(len(frames), _MOST_ASKED)
    inside = robot.covers(frames.stamps_s[some] - fit.offset_s, _FARTHEST_S)
    some = some[inside]
    asked_s, weights = _asked_offsets(robot, frames.only(some), fit)
    more_s, sigma_s, _ = _slope(change.shares(stamped.stamps_s[some]), asked_s, weights)
    return replace(change, step_s=change.step_s + more_s, sigma_s=sigma_s)


def _asked_offsets(
    robot: Trajectory, frames: ImageTimes, fit: ClockFit
) -> tuple[FloatArray, FloatArray]:
    """(m,) by how much the offset is to change for each frame [s], and the information on it."""
    # What no offset explains has none.
    best = np.full(len(frames), np.inf)
    asked_s, weights = np.zeros(len(frames)), np.zeros(len(frames))
    for change_s in np.arange(-_FARTHEST_S, _FARTHEST_S + 0.5 * _ASKED_STEP_S, _ASKED_STEP_S):
        problem = clock_problem(robot, frames, fit.offset_s + change_s)
        linear = problem.linear(State(fit.fit.state.edges, problem.start_values))
        late = linear.jacobian[:, :, -1:]
        both = np.concatenate([late, linear.residuals[:, :, None]], axis=2)
        blocks = problem.total_covariance(linear, fit.fit.noise)
        products = np.swapaxes(both, 1, 2) @ np.linalg.solve(blocks, both)
        own, pull = np.maximum(products[:, 0, 0], 1e-12), products[:, 0, 1]
        step_s = -pull / own
        left = products[:, 1, 1] - pull**2 / own
        better = (left < best) & (np.abs(step_s) <= _ASKED_STEP_S)
        best = np.where(better, left, best)
        asked_s = np.where(better, change_s + step_s, asked_s)
        weights = np.where(better, own, weights)
    sound = best <= _OUTLYING**2 * float(np.median(best))
    return asked_s, np.where(sound, weights, 0.0)


def _slope(column: FloatArray, values: FloatArray, weights: FloatArray) -> tuple[float, ...]:
    """A slope beside a constant by weighted least squares, its sigma, and F for it."""
    count, total = len(values), weights.sum()
    centred = column - weights @ column / total
    about = values - weights @ values / total
    square = float(weights @ centred**2)
    if square <= 0.0:
        return 0.0, np.inf, 0.0
    slope = float(weights @ (centred * about)) / square
    left = float(weights @ (about - slope * centred) ** 2) / (count - 2)
    sigma = float(np.sqrt(left / square))
    return slope, sigma, (slope / sigma) ** 2 if sigma > 0.0 else 0.0


def clear_fit(fits: Sequence[ClockFit], stated_s: float | None) -> ClockFit | None:
    """The fit that stands out: motion that repeats itself has several that leave as little.

    Of these it is the one that is stated. None where none is, or there are no fits.
    """
    if not fits:
        return None
    alike = [fit for fit in fits if left_by(fit) <= _ALIKE * left_by(fits[0])]
    if all(abs(clock_fit.offset_s - fits[0].offset_s) <= NEAR_S for clock_fit in alike):
        return fits[0]
    near = [
        clock_fit
        for clock_fit in alike
        if stated_s is not None and abs(clock_fit.offset_s - stated_s) <= NEAR_S
    ]
    return near[0] if near else None


def left_by(fit: ClockFit) -> float:
    """What a fit leaves of rotations and positions, as its likelihood has it."""
    return float(fit.fit.noise.robots.prod())


def _evenly(count: int, most: int) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _fitted(
    robot: Trajectory, frames: ImageTimes, offset_s: float, start: State | None, late: _Late
) -> DelayedFit | None:
    """Fits from one start, and once more without the frames that contradict the others."""
    found = _settled(robot, frames, offset_s, start, late)
    if found is None:
        return None
    late, clock = replace(late, times_s=found.times_s), found.clock
    near = _covered(robot, frames, clock.offset_s)
    sound = _sound(late.problem(robot, near, clock.offset_s, clock.fit.state)[0], clock.fit)
    if sound.all():
        return found
    return _settled(robot, near.only(sound), clock.offset_s, clock.fit.state, late)


def _settled(
    robot: Trajectory, frames: ImageTimes, offset_s: float, start: State | None, late: _Late
) -> DelayedFit | None:
    """Moves times, offset and both edges until they rest; None where too few frames are covered."""
    for _ in range(_ROUNDS):
        near = _covered(robot, frames, offset_s)
        if len(near) < _FEWEST_FRAMES:
            return None
        if start is None:
            first = _evenly(len(near), _START_FRAMES)
            start = closed_form(clock_problem(robot, near, offset_s), first)
        if start is None:
            raise RuntimeError("no closed form gives a start")
        problem, pulls = late.problem(robot, near, offset_s, start)
        found = fit_problem(problem, State(start.edges, problem.start_values))
        # A step farther than angles are compared over is a slope that misleads.
        step_s = np.clip(found.state.values, -WINDOW_S, WINDOW_S)
        start, offset_s = found.state, offset_s + float(step_s[0])
        late = replace(late, times_s=late.times_s + step_s[1:])
        if np.abs(step_s).max() < _SETTLED_S:
            break
    fit = replace(found, state=State(found.state.edges, problem.start_values))
    sigmas_s, freedom = _sigmas_s(problem, fit, near.stamps_s, pulls)
    clock = ClockFit(offset_s, float(sigmas_s[0]), fit, len(near))
    return DelayedFit(clock, late.delays, late.times_s, sigmas_s[1:], freedom)


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


def _sound(problem: Problem, fit: Solution) -> Mask:
    """Which frames agree with the others."""
    linear = problem.linear(fit.state)
    residuals, covariance = linear.residuals, problem.total_covariance(linear, fit.noise)
    squares = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(covariance), residuals)
    return np.asarray(squares <= _OUTLYING**2 * float(np.median(squares)))


def _sigmas_s(
    problem: Problem, fit: Solution, stamps_s: FloatArray, pulls: FloatArray
) -> tuple[FloatArray, float]:
    """Standard deviations of the offset and of times, the larger of two each, and their freedom."""
    # One takes the errors of all frames for independent. The other takes those of a stretch of time
    # together, as they are: where a lens or an arm errs the same for a while, it is the honest one
    # (the jackknife over clusters; Bell and McCaffrey 2002).
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
    information, moved = covariance_from(covariance), np.zeros((count, jacobian.shape[2]))
    for stretch in range(count):
        mine = stretches == stretch
        both = gram(jacobian[mine], weighted[mine])
        both[len(both) - pulls.shape[1] :, -1] += pulls[mine].sum(axis=0)
        # Without the stretch: its own leverage would hide how far it is off.
        moved[stretch] = covariance_from(information - both[:, :-1]) @ both[:, -1]
    together = moved.T @ moved * (count - 1) / count
    return np.sqrt(np.maximum(independent, np.diag(together)[12:])), count - 1.0
