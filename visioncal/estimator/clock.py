"""What one clock is ahead of another, from one motion that was seen by both.

A camera's turning between two frames and the robot's are equally large, whatever frames their poses
are of: where these angles go along best, the clocks agree to a fraction of a frame. From there the
offset is one more unknown of the chain of frames: it moves the flange along its way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from visioncal.estimator.closure import (
    Closure,
    Edges,
    Noise,
    closure_information,
    fit_closure,
    residual_blocks,
)
from visioncal.estimator.linalg import covariance, one_blas_thread, spectrum
from visioncal.estimator.shared import Shared
from visioncal.estimator.trajectory import Trajectory
from visioncal.solvers import SOLVERS
from visioncal.transforms import invert, rotation_angle
from visioncal.types import FloatArray, IntArray, Mask, Mount

# Clocks that are farther apart are not on one network [s].
WIDEST_OFFSET_S = 5.0
# The grid on which angles are compared, and over how long at least [s].
_STEP_S, _WINDOW_S = 0.005, 0.2
# Peaks of the comparison that stay within so much of the best are tried too, so many of them.
_RIVAL_SHARE, _MOST_RIVALS, _APART_S = 0.9, 3, 0.1
# A start from more frames is no better.
_START_FRAMES, _MOST_FRAMES = 60, 1200
_ROUNDS, _SETTLED_S = 12, 1e-7
_FEWEST_FRAMES = 4
# Frames that are off by so many times what is typical are wrong ones.
_OUTLYING = 4.0
# Errors of frames within this time of each other may be alike [s]; fewer stretches tell nothing.
_STRETCH_S, _FEWEST_STRETCHES = 1.0, 6
# A ratio of eigenvalues below this is no information, only rounding.
_NULL = 1e-10


@dataclass(frozen=True, eq=False)
class Frames:
    """What a camera saw, by its own clock.

    Attributes:
        mount: Which of the two trees it is.
        stamps_s: (m,) times [s], ascending.
        cam_from_target: (m, 4, 4) [m].
        covariance: (m, 6, 6) of their right perturbations; None where unknown.
    """

    mount: Mount
    stamps_s: FloatArray
    cam_from_target: FloatArray
    covariance: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.stamps_s)

    def only(self, chosen: Mask | IntArray) -> "Frames":
        """Returns some of them."""
        known = self.covariance
        return replace(
            self,
            stamps_s=self.stamps_s[chosen],
            cam_from_target=self.cam_from_target[chosen],
            covariance=None if known is None else known[chosen],
        )


@dataclass(frozen=True)
class Match:
    """An offset at which camera and robot turn alike.

    Attributes:
        offset_s: What the camera's clock is ahead of the robot's [s].
        correlation: Of their angles there.
        at_end: Whether the search ends there.
    """

    offset_s: float
    correlation: float
    at_end: bool = False


@dataclass(frozen=True, eq=False)
class ClockFit:
    """An offset with both edges.

    Attributes:
        offset_s: What the camera's clock is ahead of the robot's [s].
        sigma_s: Its standard deviation [s]; infinite where the motion does not tell it.
        edges: Both edges, as the moving frames have them.
        noise: What is left between them.
        frames: How many frames it rests on.
    """

    offset_s: float
    sigma_s: float
    edges: Edges
    noise: Noise
    frames: int


def turning_matches(robot: Trajectory, frames: Frames) -> tuple[Match, ...]:
    """Finds the offsets at which camera and robot turn alike, the best first.

    Angles are compared between each frame and the first one some time behind it, by their
    correlation.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw.

    Returns:
        The matches; none where neither turns, or the streams have too little time in common.
    """
    later = np.searchsorted(frames.stamps_s, frames.stamps_s + _WINDOW_S)
    first = np.flatnonzero(later < len(frames))
    if len(first) < 3:
        return ()
    second = later[first]
    there = frames.cam_from_target
    seen = rotation_angle(invert(there[first]) @ there[second])
    reach_s = min(WIDEST_OFFSET_S, 0.25 * _common_s(robot, frames))
    lags = np.arange(-int(reach_s / _STEP_S), int(reach_s / _STEP_S) + 1)
    # With a margin, so that frames before the robot's first sample have a place on the grid.
    begin_s = robot.stamps_s[0] - _STEP_S
    grid_s = np.arange(begin_s + _STEP_S, robot.stamps_s[-1], _STEP_S)
    turned = Rotation.from_matrix(robot.poses[:, :3, :3])
    quaternions = Slerp(robot.stamps_s, turned)(grid_s).as_quat()
    known = robot.covers(grid_s)
    places = np.rint((frames.stamps_s - grid_s[0]) / _STEP_S).astype(np.int64)
    scores = np.zeros(len(lags))
    for at, lag in enumerate(lags):
        one, other = places[first] - lag, places[second] - lag
        inside = (one >= 0) & (other < len(grid_s))
        inside[inside] &= known[one[inside]] & known[other[inside]]
        # Chance alone correlates a short overlap.
        if inside.sum() > max(0.5 * len(first), 2):
            dots = np.abs(np.sum(quaternions[one[inside]] * quaternions[other[inside]], axis=1))
            scores[at] = _correlation(2.0 * np.arccos(np.minimum(dots, 1.0)), seen[inside])
    return _peaks(lags, scores)


def _common_s(robot: Trajectory, frames: Frames) -> float:
    """How much time the streams have in common, as stamped [s]."""
    start = max(robot.stamps_s[0], frames.stamps_s[0])
    return max(float(min(robot.stamps_s[-1], frames.stamps_s[-1]) - start), 0.0)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


def _peaks(lags: IntArray, scores: FloatArray) -> tuple[Match, ...]:
    """The best offset and its rivals, each a maximum of its surroundings."""
    around = int(_APART_S / _STEP_S)
    left, found = scores.copy(), list[Match]()
    best = float(scores.max(initial=0.0))
    while len(found) < _MOST_RIVALS and best > 0.0 and left.max() >= _RIVAL_SHARE * best:
        at = int(left.argmax())
        ends = at in (0, len(lags) - 1)
        found.append(Match(_summit(lags, scores, at) * _STEP_S, float(scores[at]), ends))
        low, high = at, at
        # Down both sides of the hill, and at least as far as what is no rival.
        while low > 0 and (at - low < around or scores[low - 1] < scores[low]):
            low -= 1
        while high < len(lags) - 1 and (high - at < around or scores[high + 1] < scores[high]):
            high += 1
        left[low : high + 1] = -1.0
    return tuple(found)


def _summit(lags: IntArray, scores: FloatArray, at: int) -> float:
    """Where the parabola through a maximum and its neighbours is highest."""
    if at in (0, len(lags) - 1):
        return float(lags[at])
    left, middle, right = scores[at - 1 : at + 2]
    curvature = left - 2 * middle + right
    return float(lags[at] + (0.5 * (left - right) / curvature if curvature < 0 else 0.0))


def fit_offset(robot: Trajectory, frames: Frames, starts: Sequence[float]) -> ClockFit | None:
    """Fits the offset and both edges together, from several starts.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw.
        starts: Offsets to start from [s].

    Returns:
        The fit that leaves the least; None where too few frames are covered, or no edges are found.
    """
    with one_blas_thread():
        some = frames.only(_evenly(len(frames), _MOST_FRAMES))
        fits = [fit for it in starts if (fit := _fitted(robot, some, it)) is not None]
    # Few frames agree with anything.
    most = max((it.frames for it in fits), default=0)
    whole = [it for it in fits if 2 * it.frames > most]
    return min(whole, key=lambda it: it.noise.sigma_rad, default=None)


def _evenly(count: int, most: int) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _fitted(robot: Trajectory, frames: Frames, offset_s: float) -> ClockFit | None:
    """Fits from one start, and once more without the frames that contradict the others."""
    fit = _settled(robot, frames, offset_s, None)
    if fit is None:
        return None
    near = _covered(robot, frames, fit.offset_s)
    data = clock_closure(robot, near, fit.offset_s)
    sound = _sound(data, fit.edges, fit.noise)
    return fit if sound.all() else _settled(robot, near.only(sound), fit.offset_s, fit.edges)


def _settled(
    robot: Trajectory, frames: Frames, offset_s: float, start: Edges | None
) -> ClockFit | None:
    """Moves the offset and both edges until they rest; None where too few frames are covered."""
    for _ in range(_ROUNDS):
        near = _covered(robot, frames, offset_s)
        if len(near) < _FEWEST_FRAMES:
            return None
        data = clock_closure(robot, near, offset_s)
        at = _start(data) if start is None else start
        fit = fit_closure(data, replace(at, shared=data.unchanged))
        # A step farther than angles are compared over is a slope that misleads.
        step_s = float(np.clip(fit.edges.shared[0], -_WINDOW_S, _WINDOW_S))
        start, offset_s = fit.edges, offset_s + step_s
        if abs(step_s) < _SETTLED_S:
            break
    edges = replace(fit.edges, shared=data.unchanged)
    sigma_s = _sigma_s(data, edges, fit.noise, near.stamps_s)
    return ClockFit(offset_s, sigma_s, edges, fit.noise, len(near))


def _start(data: Closure) -> Edges:
    part = _evenly(len(data), _START_FRAMES)
    closed = SOLVERS["park"](data.robot[part], data.camera[part])
    return Edges(closed.x, closed.z, data.unchanged)


def _covered(robot: Trajectory, frames: Frames, offset_s: float) -> Frames:
    margin_s = 0.5 * robot.speed_window_s
    return frames.only(robot.covers(frames.stamps_s - offset_s, margin_s))


def clock_closure(robot: Trajectory, frames: Frames, offset_s: float) -> Closure:
    """The chain of some frames at an offset, with the offset's change [s] as what they share."""
    at_s = frames.stamps_s - offset_s
    poses = robot.at(at_s)
    return Closure(
        frames.mount,
        poses if frames.mount == "eye-in-hand" else invert(poses),
        frames.cam_from_target,
        frames.covariance,
        clock_shared(robot.speeds(at_s)),
    )


def clock_shared(speeds: FloatArray, sigma_s: float = np.inf) -> Shared:
    """The offset's change [s] as an unknown of the chain.

    Args:
        speeds: (m, 6) twists a second of the flange, in its own frame; zero where a view's pose
            does not depend on the clock.
        sigma_s: How well the offset is known beforehand [s].
    """
    nothing = np.zeros(1)
    # The farther the camera's clock is ahead, the earlier the robot's own time.
    by_flange = -speeds[:, :, None]
    known = np.array([[sigma_s**-2.0]])
    return Shared(known, nothing, nothing, np.zeros_like(by_flange), by_flange)


def _sound(data: Closure, edges: Edges, noise: Noise) -> Mask:
    """Which frames agree with the others."""
    residuals, _, spread = residual_blocks(data, edges, noise)
    squares = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(spread), residuals)
    return np.asarray(squares <= _OUTLYING**2 * float(np.median(squares)))


def _sigma_s(data: Closure, edges: Edges, noise: Noise, stamps_s: FloatArray) -> float:
    """The offset's standard deviation: the larger of two.

    One takes the errors of all frames for independent. The other takes those of a stretch of time
    together, as they are: where a lens or an arm errs the same for a while, it is the honest one
    (Liang and Zeger 1986, the sandwich over clusters).
    """
    information = closure_information(data, edges, noise)
    if spectrum(information).ratio < _NULL:
        return np.inf
    spread = covariance(information)
    independent = float(spread[12, 12])
    stretches = np.unique((stamps_s - stamps_s[0]) // _STRETCH_S, return_inverse=True)[1]
    count = int(stretches.max()) + 1
    if count < _FEWEST_STRETCHES:
        return float(np.sqrt(independent))
    residuals, jacobian, blocks = residual_blocks(data, edges, noise)
    weighted = np.linalg.solve(blocks, residuals[:, :, None])[:, :, 0]
    scores = np.zeros((count, jacobian.shape[2]))
    np.add.at(scores, stretches, np.einsum("mij,mi->mj", jacobian, weighted))
    together = spread @ (scores.T @ scores) @ spread * count / max(count - 1, 1)
    return float(np.sqrt(max(independent, float(together[12, 12]))))
