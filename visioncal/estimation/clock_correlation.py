"""Coarse clock offset, by correlating the rotation of camera and robot.

Between two frames the camera and the robot rotate by equal angles, whatever frames their poses are
of and however these are read. The clocks agree where the angles correlate best.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Mount
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.trajectory import LONGEST_GAP_S, Trajectory

# Widest offset searched; clocks farther apart are not on one network [s].
WIDEST_OFFSET_S = 5.0
# Least time over which angles are compared, and the grid's step [s]; least sigma of an interpolated
# offset [s].
WINDOW_S, _STEP_S, _LEAST_SIGMA_S = 0.2, 0.005, 1e-3
# Peaks within this share of the best are rivals, and their greatest number; least distance of
# distinct peaks [s].
_RIVAL_SHARE, _MOST_RIVALS, NEAR_S = 0.9, 12, 0.1
_FEWEST_PAIRS = 4


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """Views of a camera, by its own clock."""

    mount: Mount
    stamps_s: FloatArray  # (m,) times [s], ascending.
    cam_from_target: FloatArray  # (m, 4, 4) [m].
    # (m, 6, 6) of their right perturbations; None where unknown.
    covariance: FloatArray | None = None
    # The corners that the poses were made from, frame by frame; None without any.
    stack: CornerStack | None = None

    def __len__(self) -> int:
        return len(self.stamps_s)

    @property
    def are_dense(self) -> bool:
        """Whether they sample the motion itself, and not only the rests between motions."""
        return len(self) > 2 and float(np.median(np.diff(self.stamps_s))) <= WINDOW_S

    def only(self, chosen: Mask | IntArray) -> "ImageTimes":
        """Returns some of the views, in ascending order."""
        covariance, stack = self.covariance, self.stack
        rows = np.arange(len(self))[chosen]
        return replace(
            self,
            stamps_s=self.stamps_s[chosen],
            cam_from_target=self.cam_from_target[chosen],
            covariance=None if covariance is None else covariance[chosen],
            stack=None if stack is None else stack.keep(np.isin(stack.view_of, rows)),
        )


@dataclass(frozen=True)
class Match:
    """An offset at which camera and robot rotate alike."""

    offset_s: float  # Camera clock minus robot clock [s].
    # Its standard deviation by the angles [s]; infinite where they do not depend on it.
    sigma_s: float
    correlation: float  # Correlation of the angles there.
    at_end: bool = False  # Whether it lies at an end of the search range.


def turning_matches(
    robot: Trajectory, frames: ImageTimes, about_s: float = 0.0
) -> tuple[Match, ...]:
    """Finds the offsets at which camera and robot rotate alike, best first.

    The angles between each frame and the first one some time later are correlated.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: Views of the camera.
        about_s: Centre of the search [s].

    Returns:
        The matches; none where neither rotates, where the streams have too little time in common,
        or where the robot's samples are too far apart to show a motion.
    """
    frames = replace(frames, stamps_s=frames.stamps_s - about_s)
    later = np.searchsorted(frames.stamps_s, frames.stamps_s + WINDOW_S)
    first = np.flatnonzero(later < len(frames))
    if len(first) < _FEWEST_PAIRS:
        return ()
    rotation = _Rotation.of(robot, frames, first, later[first])
    if not len(rotation.steps):
        return ()
    start_s = max(robot.stamps_s[0], frames.stamps_s[0])
    common_s = max(float(min(robot.stamps_s[-1], frames.stamps_s[-1]) - start_s), 0.0)
    reach_s = min(WIDEST_OFFSET_S, 0.25 * common_s)
    lags = np.arange(-int(reach_s / _STEP_S), int(reach_s / _STEP_S) + 1)
    scores = np.zeros(len(lags))
    for index, lag in enumerate(lags.tolist()):
        inside, angles = rotation.by_robot(lag)
        # Chance alone correlates a short overlap.
        if inside.sum() > max(0.5 * len(first), 2):
            scores[index] = _correlation(angles, rotation.by_camera[inside])
    matches = _peaks(rotation, lags, scores)
    return tuple(replace(match, offset_s=match.offset_s + about_s) for match in matches)


@dataclass(frozen=True, eq=False)
class _Rotation:
    """Rotation angles of camera and robot between pairs of frames."""

    by_camera: FloatArray  # (k,) angles from the camera [rad].
    first: IntArray  # (k,) grid step of each pair's first frame at zero offset.
    second: IntArray  # (k,) grid step of its second frame.
    steps: IntArray  # (g,) the grid's steps within the robot's samples, ascending.
    quaternions: FloatArray  # (g, 4) of the robot there.
    per_window: float  # Number of pairs that share a stretch of time.

    @classmethod
    def of(
        cls, robot: Trajectory, frames: ImageTimes, first: IntArray, second: IntArray
    ) -> "_Rotation":
        """Pairs frames with later ones."""
        poses = frames.cam_from_target
        begin_s, end_s = robot.stamps_s[[0, -1]]
        steps = _steps(robot.stamps_s)
        # Stamps since 1970 are rounded to 0.2 us: a step may end behind the last of them.
        grid_s = np.minimum(begin_s + _STEP_S * steps, end_s)
        covered = robot.covers(grid_s)
        interpolate = Slerp(robot.stamps_s, Rotation.from_matrix(robot.poses[:, :3, :3]))
        grid_steps = np.rint((frames.stamps_s - begin_s) / _STEP_S).astype(np.int64)
        return cls(
            rotation_angle(invert(poses[first]) @ poses[second]),
            grid_steps[first],
            grid_steps[second],
            steps[covered],
            interpolate(grid_s[covered]).as_quat(),
            float(np.median(second - first)),
        )

    def by_robot(self, lag: int) -> tuple[Mask, FloatArray]:
        """Mask (k,) of the pairs covered by the robot at a lag, and (j,) its angles there [rad]."""
        first, first_known = self._at(self.first - lag)
        second, second_known = self._at(self.second - lag)
        inside = first_known & second_known
        products = self.quaternions[first[inside]] * self.quaternions[second[inside]]
        return inside, 2.0 * np.arccos(np.minimum(np.abs(products.sum(axis=1)), 1.0))

    def _at(self, steps: IntArray) -> tuple[IntArray, Mask]:
        """Rows of grid steps (k,), and a mask of those that exist."""
        rows = np.minimum(np.searchsorted(self.steps, steps), len(self.steps) - 1)
        return rows, self.steps[rows] == steps

    def sigma_s(self, lag: int) -> float:
        """Standard deviation of an offset [s], by the scatter of the angles and their rates."""
        inside, angles_here = self.by_robot(lag)
        sides = [self.by_robot(lag + side) for side in (-1, 1)]
        both = sides[0][0] & sides[1][0] & inside
        angles_before, angles_after = (angles[both[mask]] for mask, angles in sides)
        rate = (angles_after - angles_before) / (2.0 * _STEP_S)
        error = self.by_camera[both] - angles_here[both[inside]]
        information = float(np.sum((rate - rate.mean()) ** 2)) if len(rate) else 0.0
        if not information > 0.0:
            return np.inf
        # Errors of pairs that share a stretch of time are correlated.
        variance = np.mean((error - error.mean()) ** 2) * max(self.per_window, 1.0) / information
        return float(np.hypot(np.sqrt(variance), _LEAST_SIGMA_S))


def _steps(stamps_s: FloatArray) -> IntArray:
    """Grid steps (g,) between neighbouring samples.

    A clock that was set during a recording leaves samples that are years apart.
    """
    places, near = (stamps_s - stamps_s[0]) / _STEP_S, np.diff(stamps_s) < LONGEST_GAP_S
    low, high = (np.floor(value[near]).astype(np.int64) for value in (places[:-1], places[1:]))
    counts = high - low + 1
    starts = np.cumsum(counts) - counts
    steps = np.unique(np.repeat(low - starts, counts) + np.arange(counts.sum()))
    return np.asarray(steps[steps < places[-1]])


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


def _peaks(rotation: _Rotation, lags: IntArray, scores: FloatArray) -> tuple[Match, ...]:
    """The best offset and its rivals, each a local maximum."""
    around = int(NEAR_S / _STEP_S)
    remaining, matches = scores.copy(), list[Match]()
    best = float(scores.max(initial=0.0))
    while len(matches) < _MOST_RIVALS and best > 0.0 and remaining.max() >= _RIVAL_SHARE * best:
        peak = int(remaining.argmax())
        offset_s = _summit(lags, scores, peak) * _STEP_S
        sigma_s, ends = rotation.sigma_s(int(lags[peak])), peak in (0, len(lags) - 1)
        matches.append(Match(offset_s, sigma_s, float(scores[peak]), ends))
        low, high = peak, peak
        # Masks both flanks of the peak, at least as far as the distance of distinct peaks.
        while low > 0 and (peak - low < around or scores[low - 1] < scores[low]):
            low -= 1
        while high < len(lags) - 1 and (high - peak < around or scores[high + 1] < scores[high]):
            high += 1
        remaining[low : high + 1] = -1.0
    return tuple(matches)


def _summit(lags: IntArray, scores: FloatArray, peak: int) -> float:
    """Vertex of the parabola through a maximum and its neighbours."""
    if peak in (0, len(lags) - 1):
        return float(lags[peak])
    left, middle, right = scores[peak - 1 : peak + 2]
    curvature = left - 2 * middle + right
    return float(lags[peak] + (0.5 * (left - right) / curvature if curvature < 0 else 0.0))
