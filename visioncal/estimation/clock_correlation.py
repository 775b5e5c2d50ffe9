"""Coarse clock offset, by correlating the rotation of camera and robot.

Between two frames the camera and the robot rotate by equal angles, whatever frames their poses are
of and however these are read. The clocks agree where the angles correlate best.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Mount, chosen_rows, evenly
from visioncal.robot.trajectory import Trajectory
from visioncal.vision.corners import CornerStack

# Widest offset searched; clocks farther apart are not on one network [s].
WIDEST_OFFSET_S = 5.0
# Least time over which angles are compared, and the search's step [s].
WINDOW_S, _STEP_S = 0.2, 0.01
# Least distance of distinct peaks [s].
NEAR_S = 0.1
# Time over which angles are compared where the offset may be of any size, the step of that search
# [s], and the least correlation of a match: chance reaches less of so many offsets.
_FAR_WINDOW_S, _FAR_STEP_S, _FAR_CORRELATION = 1.0, 0.05, 0.8
# Most offsets of that search, by the memory that it takes.
_MOST_OFFSETS = 40_000
# Fewest and most frames, or pairs of them.
FEWEST_FRAMES, MOST_FRAMES = 4, 600


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

    def only(self, chosen: Mask | IntArray) -> "ImageTimes":
        """Selects views, in ascending order."""
        stack, rows = self.stack, np.arange(len(self))[chosen]
        kept = None if stack is None else stack.keep(np.isin(stack.view_of, rows))
        return replace(chosen_rows(self, chosen), stack=kept)


@dataclass(frozen=True)
class Match:
    """An offset at which camera and robot rotate alike."""

    offset_s: float  # Camera clock minus robot clock [s].
    correlation: float  # Correlation of the angles there.
    at_end: bool = False  # Whether it lies at an end of the search range.


def turning_matches(
    robot: Trajectory, frames: ImageTimes, about_s: float = 0.0
) -> tuple[Match, ...]:
    """Finds the offsets at which camera and robot rotate alike, best first.

    The angles between frames and the first ones some time later are correlated.

    Args:
        robot: `base_from_flange` over the robot's time.
        frames: Views of the camera.
        about_s: Centre of the search [s].

    Returns:
        The matches; none where neither rotates, where the streams have too little time in common,
        or where the robot's samples are too far apart to show a motion.
    """
    stamps_s = frames.stamps_s - about_s
    later = np.searchsorted(stamps_s, stamps_s + WINDOW_S)
    first = np.flatnonzero(later < len(frames))
    if len(first) < FEWEST_FRAMES:
        return ()
    first = first[evenly(len(first), MOST_FRAMES)]
    later = later[first]
    poses = frames.cam_from_target
    by_camera = rotation_angle(invert(poses[first]) @ poses[later])
    common_s = min(robot.stamps_s[-1], stamps_s[-1]) - max(robot.stamps_s[0], stamps_s[0])
    count = int(min(WIDEST_OFFSET_S, 0.25 * max(float(common_s), 0.0)) / _STEP_S)
    lags_s = _STEP_S * np.arange(-count, count + 1)
    from_s, to_s = (stamps_s[rows] - lags_s[:, None] for rows in (first, later))
    by_robot, inside = _turned(robot, from_s, to_s)
    scores = _correlations(by_robot, by_camera, inside)
    # Chance alone correlates a short overlap.
    scores[inside.sum(axis=1) <= max(0.5 * len(first), 2)] = 0.0
    matches = []
    for peak in _peaks(scores):
        offset_s, at_end = lags_s[peak], peak in (0, len(lags_s) - 1)
        if not at_end:
            left, middle, right = scores[peak - 1 : peak + 2]
            curvature = left - 2.0 * middle + right
            # The vertex of the parabola through the maximum and its neighbours.
            offset_s += _STEP_S * (0.5 * (left - right) / curvature if curvature < 0.0 else 0.0)
        matches.append(Match(float(offset_s) + about_s, float(scores[peak]), at_end))
    return tuple(matches)


def far_offset(robot: Trajectory, frames: ImageTimes) -> float | None:
    """The offset [s] of clocks of any epochs at which camera and robot turn alike; None of several.

    At least half of the views lie within the robot's time there.
    """
    stamps_s, poses = frames.stamps_s, frames.cam_from_target
    # A stamp of another epoch among the others spans more.
    if np.ptp(robot.stamps_s) + np.ptp(stamps_s) > _FAR_STEP_S * _MOST_OFFSETS:
        return None
    later = np.searchsorted(stamps_s, stamps_s + _FAR_WINDOW_S)
    first = np.flatnonzero(later < len(frames))
    first = first[evenly(len(first), MOST_FRAMES // 3)]
    later, steps = later[first], np.rint((stamps_s[first] - stamps_s[0]) / _FAR_STEP_S).astype(int)
    grid_s = np.arange(robot.stamps_s[0], robot.stamps_s[-1] - _FAR_WINDOW_S, _FAR_STEP_S)
    shifts = np.arange(-steps.max(initial=0), len(grid_s))
    if len(first) < FEWEST_FRAMES or not 0 < len(grid_s) <= len(shifts):
        return None
    by_camera = rotation_angle(invert(poses[first]) @ poses[later])
    by_camera *= _FAR_WINDOW_S / (stamps_s[later] - stamps_s[first])
    by_robot, is_known = _turned(robot, grid_s, grid_s + _FAR_WINDOW_S)
    at = shifts[:, None] + steps
    within = np.clip(at, 0, len(grid_s) - 1)
    inside = (at == within) & is_known[within]
    scores = _correlations(by_robot[within], by_camera, inside)
    scores[2 * inside.sum(axis=1) < len(first)] = 0.0
    best = int(scores.argmax())
    others = scores[np.abs(shifts - shifts[best]) * _FAR_STEP_S > WIDEST_OFFSET_S]
    if scores[best] < max(_FAR_CORRELATION, others.max(initial=0.0) / 0.9):
        return None
    return float(stamps_s[0] - robot.stamps_s[0] - _FAR_STEP_S * shifts[best])


def _turned(robot: Trajectory, from_s: FloatArray, to_s: FloatArray) -> tuple[FloatArray, Mask]:
    """Angles by which the robot turns between times [rad], and where both are covered."""
    (begins, known), (ends, also_known) = robot.rotations(from_s), robot.rotations(to_s)
    products = np.abs(np.einsum("...i,...i->...", begins, ends))
    return 2.0 * np.arccos(np.minimum(products, 1.0)), known & also_known


def _correlations(rows: FloatArray, values: FloatArray, inside: Mask) -> FloatArray:
    """Correlation (l,) of each of (l, p) rows with (p,) values, over a mask of both."""
    count = np.maximum(inside.sum(axis=1, keepdims=True), 1)
    centred = [
        np.where(inside, array - (array * inside).sum(axis=1, keepdims=True) / count, 0.0)
        for array in (rows, np.broadcast_to(values, rows.shape))
    ]
    lengths = np.linalg.norm(centred, axis=2).prod(axis=0)
    products = np.einsum("lp,lp->l", *centred)
    return np.asarray(products / np.maximum(lengths, np.finfo(float).tiny))


def _peaks(scores: FloatArray) -> list[int]:
    """The best offset and its rivals, each a local maximum, best first."""
    # Imported late: few sessions need it.
    from scipy.signal import find_peaks

    best = float(scores.max(initial=0.0))
    if best <= 0.0:
        return []
    padded, apart = np.pad(scores, 1, constant_values=-1.0), int(NEAR_S / _STEP_S)
    # Peaks within this share of the best are rivals.
    peaks = find_peaks(padded, height=0.9 * best, distance=apart)[0] - 1
    order: list[int] = peaks[np.argsort(-scores[peaks])].tolist()
    # Most rivals.
    return order[:12]
