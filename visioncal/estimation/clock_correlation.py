"""About what one clock is ahead of another: where camera and robot turn alike.

A camera's turning between two frames and the robot's are equally large, whatever frames their poses
are of and however these are read. Where the angles go along best, the clocks agree.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Mount
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.trajectory import LONGEST_GAP_S, Trajectory

# Clocks that are farther apart are not on one network [s].
WIDEST_OFFSET_S = 5.0
# Angles are compared over at least this time, on a grid of such a step [s]; the resolution
# of an offset on it, after interpolation [s].
WINDOW_S, _STEP_S, _LEAST_SIGMA_S = 0.2, 0.005, 1e-3
# Peaks of the comparison that stay within so much of the best are rivals, so many at most; nearer
# than this to each other [s] they are one.
_RIVAL_SHARE, _MOST_RIVALS, NEAR_S = 0.9, 12, 0.1
_FEWEST_PAIRS = 4


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """What a camera saw, by its own clock.

    Attributes:
        mount: Which of the two trees it is.
        stamps_s: (m,) times [s], ascending.
        cam_from_target: (m, 4, 4) [m].
        covariance: (m, 6, 6) of their right perturbations; None where unknown.
        stack: The corners that the poses were made from, frame by frame; None without any.
    """

    mount: Mount
    stamps_s: FloatArray
    cam_from_target: FloatArray
    covariance: FloatArray | None = None
    stack: CornerStack | None = None

    def __len__(self) -> int:
        return len(self.stamps_s)

    @property
    def are_dense(self) -> bool:
        """Whether they show the turning itself, and not only where it led from rest to rest."""
        return len(self) > 2 and float(np.median(np.diff(self.stamps_s))) <= WINDOW_S

    def only(self, chosen: Mask | IntArray) -> "ImageTimes":
        """Returns some of them, in ascending order."""
        known, stack = self.covariance, self.stack
        rows = np.arange(len(self))[chosen]
        return replace(
            self,
            stamps_s=self.stamps_s[chosen],
            cam_from_target=self.cam_from_target[chosen],
            covariance=None if known is None else known[chosen],
            stack=None if stack is None else stack.keep(np.isin(stack.view_of, rows)),
        )


@dataclass(frozen=True)
class Match:
    """An offset at which camera and robot turn alike.

    Attributes:
        offset_s: What the camera's clock is ahead of the robot's [s].
        sigma_s: How well the angles determine it [s]; infinite where they do not change with it.
        correlation: Of their angles there.
        at_end: Whether the search ends there.
    """

    offset_s: float
    sigma_s: float
    correlation: float
    at_end: bool = False


def turning_matches(
    robot: Trajectory, frames: ImageTimes, about_s: float = 0.0
) -> tuple[Match, ...]:
    """Finds the offsets at which camera and robot turn alike, the best first.

    Angles are compared between each frame and the first one some time behind it, by their
    correlation.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: What the camera saw.
        about_s: Around which offset to look [s].

    Returns:
        The matches; none where neither turns, where the streams have too little time in common, or
            where the robot's samples are too far apart to show a motion.
    """
    frames = replace(frames, stamps_s=frames.stamps_s - about_s)
    later = np.searchsorted(frames.stamps_s, frames.stamps_s + WINDOW_S)
    first = np.flatnonzero(later < len(frames))
    if len(first) < _FEWEST_PAIRS:
        return ()
    turning = _Turning.of(robot, frames, first, later[first])
    if not len(turning.steps):
        return ()
    reach_s = min(WIDEST_OFFSET_S, 0.25 * _common_s(robot, frames))
    lags = np.arange(-int(reach_s / _STEP_S), int(reach_s / _STEP_S) + 1)
    scores = np.zeros(len(lags))
    for at, lag in enumerate(lags.tolist()):
        inside, turned = turning.by_robot(lag)
        # Chance alone correlates a short overlap.
        if inside.sum() > max(0.5 * len(first), 2):
            scores[at] = _correlation(turned, turning.by_camera[inside])
    found = _peaks(turning, lags, scores)
    return tuple(replace(match, offset_s=match.offset_s + about_s) for match in found)


@dataclass(frozen=True, eq=False)
class _Turning:
    """By how much camera and robot turned between pairs of frames.

    Attributes:
        by_camera: (k,) as the camera saw it [rad].
        first: (k,) where each pair's first frame lies on the grid, with clocks that agree.
        second: (k,) where its second one lies.
        steps: (g,) the grid's points that lie within the robot's samples, ascending.
        quaternions: (g, 4) of the robot there.
        per_window: How many pairs share a stretch of time.
    """

    by_camera: FloatArray
    first: IntArray
    second: IntArray
    steps: IntArray
    quaternions: FloatArray
    per_window: float

    @classmethod
    def of(
        cls, robot: Trajectory, frames: ImageTimes, first: IntArray, second: IntArray
    ) -> "_Turning":
        """Compares some frames with others behind them."""
        seen = frames.cam_from_target
        begin_s, end_s = robot.stamps_s[[0, -1]]
        steps = _steps(robot.stamps_s)
        # Stamps since 1970 are rounded to 0.2 us: a step may end behind the last of them.
        grid_s = np.minimum(begin_s + _STEP_S * steps, end_s)
        known = robot.covers(grid_s)
        turned = Slerp(robot.stamps_s, Rotation.from_matrix(robot.poses[:, :3, :3]))
        places = np.rint((frames.stamps_s - begin_s) / _STEP_S).astype(np.int64)
        return cls(
            rotation_angle(invert(seen[first]) @ seen[second]),
            places[first],
            places[second],
            steps[known],
            turned(grid_s[known]).as_quat(),
            float(np.median(second - first)),
        )

    def by_robot(self, lag: int) -> tuple[Mask, FloatArray]:
        """Which pairs (k,) the robot knows at a lag, and (j,) by how much it turned there [rad]."""
        one, one_known = self._at(self.first - lag)
        other, other_known = self._at(self.second - lag)
        inside = one_known & other_known
        products = self.quaternions[one[inside]] * self.quaternions[other[inside]]
        return inside, 2.0 * np.arccos(np.minimum(np.abs(products.sum(axis=1)), 1.0))

    def _at(self, steps: IntArray) -> tuple[IntArray, Mask]:
        """Rows of steps (k,) of the grid, and which of them are there."""
        rows = np.minimum(np.searchsorted(self.steps, steps), len(self.steps) - 1)
        return rows, self.steps[rows] == steps

    def sigma_s(self, lag: int) -> float:
        """Standard deviation of an offset [s]: angles are off by noise, and change with it."""
        inside, turned = self.by_robot(lag)
        sides = [self.by_robot(lag + side) for side in (-1, 1)]
        both = sides[0][0] & sides[1][0] & inside
        early, late = (angles[both[known]] for known, angles in sides)
        slope = (late - early) / (2.0 * _STEP_S)
        off = self.by_camera[both] - turned[both[inside]]
        information = float(np.sum((slope - slope.mean()) ** 2)) if len(slope) else 0.0
        if not information > 0.0:
            return np.inf
        # Pairs that share a stretch of time err alike.
        variance = np.mean((off - off.mean()) ** 2) * max(self.per_window, 1.0) / information
        return float(np.hypot(np.sqrt(variance), _LEAST_SIGMA_S))


def _steps(stamps_s: FloatArray) -> IntArray:
    """The grid's steps (g,) between samples that are near each other.

    A clock that was set during a recording leaves samples that are years apart.
    """
    places, near = (stamps_s - stamps_s[0]) / _STEP_S, np.diff(stamps_s) < LONGEST_GAP_S
    low, high = (np.floor(value[near]).astype(np.int64) for value in (places[:-1], places[1:]))
    counts = high - low + 1
    starts = np.cumsum(counts) - counts
    steps = np.unique(np.repeat(low - starts, counts) + np.arange(counts.sum()))
    return np.asarray(steps[steps < places[-1]])


def _common_s(robot: Trajectory, frames: ImageTimes) -> float:
    """How much time the streams have in common, as stamped [s]."""
    start = max(robot.stamps_s[0], frames.stamps_s[0])
    return max(float(min(robot.stamps_s[-1], frames.stamps_s[-1]) - start), 0.0)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


def _peaks(turning: _Turning, lags: IntArray, scores: FloatArray) -> tuple[Match, ...]:
    """The best offset and its rivals, each a maximum of its surroundings."""
    around = int(NEAR_S / _STEP_S)
    left, found = scores.copy(), list[Match]()
    best = float(scores.max(initial=0.0))
    while len(found) < _MOST_RIVALS and best > 0.0 and left.max() >= _RIVAL_SHARE * best:
        at = int(left.argmax())
        offset_s = _summit(lags, scores, at) * _STEP_S
        sigma_s, ends = turning.sigma_s(int(lags[at])), at in (0, len(lags) - 1)
        found.append(Match(offset_s, sigma_s, float(scores[at]), ends))
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
