"""What one clock is ahead of another, from one motion that was seen by both.

From where both turn alike, the offset is one more unknown of the chain of frames: it moves the
flange along its way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimation.chain import chain
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.linalg import covariance
from visioncal.estimation.outliers import closed_form
from visioncal.estimation.problem import Problem, State
from visioncal.estimation.solve import Solution, fisher_information, fit_problem
from visioncal.estimation.trajectory import Trajectory
from visioncal.estimation.turned import NEAR_S, WIDEST_OFFSET_S, WINDOW_S, Frames
from visioncal.threads import one_blas_thread
from visioncal.types import FloatArray, IntArray, Mask

# A start from more frames is no better; a fit of more takes long.
_START_FRAMES, _MOST_FRAMES, _FEWEST_FRAMES = 60, 1200, 4
_ROUNDS, _SETTLED_S = 12, 1e-7
# Frames that are off by so many times what is typical are wrong ones.
_OUTLYING = 4.0
# Errors of frames within this time of each other may be alike [s]; fewer stretches tell nothing.
_STRETCH_S, _FEWEST_STRETCHES = 1.0, 6
# Fits that leave so many times the least, of rotations times positions, are no worse.
_ALIKE = 1.2


@dataclass(frozen=True, eq=False)
class ClockFit:
    """An offset with both edges.

    Attributes:
        offset_s: What the camera's clock is ahead of the robot's [s].
        sigma_s: Its standard deviation [s]; very large where the motion does not tell it.
        fit: Both edges, as the moving frames have them, and the noise.
        frames: How many frames it rests on.
    """

    offset_s: float
    sigma_s: float
    fit: Solution
    frames: int


def fit_offset(robot: Trajectory, frames: Frames, starts: Sequence[float]) -> tuple[ClockFit, ...]:
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
        fits = [
            fit
            for it in starts
            if (fit := _fitted(robot, some, it)) is not None and abs(fit.offset_s - it) <= near_s
        ]
    # Few frames agree with anything.
    most = max((it.frames for it in fits), default=0)
    whole = (it for it in fits if 2 * it.frames > most)
    return tuple(sorted(whole, key=_left))


def clear_fit(fits: Sequence[ClockFit], stated_s: float | None) -> ClockFit | None:
    """The fit that stands out: motion that repeats itself has several that leave as little.

    Of these it is the one that is stated. None where none is, or there are no fits.
    """
    if not fits:
        return None
    alike = [it for it in fits if _left(it) <= _ALIKE * _left(fits[0])]
    if all(abs(it.offset_s - fits[0].offset_s) <= NEAR_S for it in alike):
        return fits[0]
    near = [it for it in alike if stated_s is not None and abs(it.offset_s - stated_s) <= NEAR_S]
    return near[0] if near else None


def _left(fit: ClockFit) -> float:
    """What a fit leaves of rotations and positions, as its likelihood has it."""
    return float(fit.fit.noise.robots.prod())


def _evenly(count: int, most: int) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _fitted(robot: Trajectory, frames: Frames, offset_s: float) -> ClockFit | None:
    """Fits from one start, and once more without the frames that contradict the others."""
    fit = _settled(robot, frames, offset_s, None)
    if fit is None:
        return None
    near = _covered(robot, frames, fit.offset_s)
    sound = _sound(clock_problem(robot, near, fit.offset_s), fit.fit)
    return fit if sound.all() else _settled(robot, near.only(sound), fit.offset_s, fit.fit.state)


def _settled(
    robot: Trajectory, frames: Frames, offset_s: float, start: State | None
) -> ClockFit | None:
    """Moves the offset and both edges until they rest; None where too few frames are covered."""
    for _ in range(_ROUNDS):
        near = _covered(robot, frames, offset_s)
        if len(near) < _FEWEST_FRAMES:
            return None
        problem = clock_problem(robot, near, offset_s)
        at = closed_form(problem, _evenly(len(near), _START_FRAMES)) if start is None else start
        if at is None:
            raise RuntimeError("no closed form gives a start")
        found = fit_problem(problem, State(at.edges, problem.start_values))
        # A step farther than angles are compared over is a slope that misleads.
        step_s = float(np.clip(found.state.values[0], -WINDOW_S, WINDOW_S))
        start, offset_s = found.state, offset_s + step_s
        if abs(step_s) < _SETTLED_S:
            break
    fit = replace(found, state=State(found.state.edges, problem.start_values))
    return ClockFit(offset_s, _sigma_s(problem, fit, near.stamps_s), fit, len(near))


def _covered(robot: Trajectory, frames: Frames, offset_s: float) -> Frames:
    margin_s = 0.5 * robot.speed_window_s
    return frames.only(robot.covers(frames.stamps_s - offset_s, margin_s))


def clock_problem(robot: Trajectory, frames: Frames, offset_s: float) -> Problem:
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
    residuals, spread = linear.residuals, problem.total_covariance(linear, fit.noise)
    squares = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(spread), residuals)
    return np.asarray(squares <= _OUTLYING**2 * float(np.median(squares)))


def _sigma_s(problem: Problem, fit: Solution, stamps_s: FloatArray) -> float:
    """The offset's standard deviation: the larger of two.

    One takes the errors of all frames for independent. The other takes those of a stretch of time
    together, as they are: where a lens or an arm errs the same for a while, it is the honest one
    (Liang and Zeger 1986, the sandwich over clusters).
    """
    # A direction without information has a very large variance here.
    spread = covariance(fisher_information(problem, fit.state, fit.noise))
    independent = float(spread[12, 12])
    stretches = np.unique((stamps_s - stamps_s[0]) // _STRETCH_S, return_inverse=True)[1]
    count = int(stretches.max()) + 1
    if count < _FEWEST_STRETCHES:
        return float(np.sqrt(independent))
    linear = problem.linear(fit.state)
    residuals, jacobian = linear.residuals, linear.jacobian
    blocks = problem.total_covariance(linear, fit.noise)
    weighted = np.linalg.solve(blocks, residuals[:, :, None])[:, :, 0]
    scores = np.zeros((count, jacobian.shape[2]))
    np.add.at(scores, stretches, np.einsum("mij,mi->mj", jacobian, weighted))
    together = spread @ (scores.T @ scores) @ spread * count / max(count - 1, 1)
    return float(np.sqrt(max(independent, float(together[12, 12]))))
