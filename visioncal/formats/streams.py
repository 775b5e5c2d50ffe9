"""Two streams of poses with clocks of their own, paired at moments when the robot is slow."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from visioncal.errors import DataError
from visioncal.transforms import compose, invert, rotation_angle
from visioncal.types import FloatArray, IntArray, Mask

# Fine enough for a clock's offset of a millisecond, after interpolation.
_STEP_S = 0.01
_WIDEST_OFFSET_S = 5.0
# Longer streams are recordings of work, not of a calibration.
_LONGEST_S = 3600.0
# Speeds are taken from this long before a moment to as long after: several samples of a camera, so
# that their noise does not hide the motion.
_WINDOW_S = 0.2
# Epochs of our days count 1e9 seconds: (larger than, seconds).
_EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
# A gap in the robot's stream over which nothing is interpolated.
_GAP_S = 0.25
# A view is a new one where the robot has turned or gone this far since the others.
_NEW_RAD, _NEW_M = np.deg2rad(2.0), 0.01
# What a rotation of 1 rad/s weighs against a speed of 1 m/s.
_ARM_M = 0.3
# The slowest fifth of the samples is taken, and more where that gives too few views.
_SLOW_SHARE, _ENOUGH_VIEWS, _MOST_VIEWS = 0.2, 20, 200
_LEAST_CORRELATION = 0.5


@dataclass(frozen=True, eq=False)
class Paired:
    """What two streams have in common.

    Attributes:
        rows: (m,) the camera's samples that were chosen.
        base_from_flange: (m, 4, 4) the robot's poses at those moments [m].
        camera_minus_robot_s: What the camera's stamps are ahead of the robot's [s].
        correlation: Of both angular speeds at this offset.
        slow: The fastest chosen moment [rad/s].
    """

    rows: IntArray
    base_from_flange: FloatArray
    camera_minus_robot_s: float
    correlation: float
    slow: float


def seconds(stamps: FloatArray, places: Sequence[str]) -> FloatArray:
    """Reads stamps as seconds; those of an epoch may be in milli-, micro- or nanoseconds.

    Raises:
        DataError: A stamp is missing, or they do not increase.
    """
    if not np.isfinite(stamps).all():
        place = places[int(np.argmin(np.isfinite(stamps)))]
        raise DataError(f"{place}: the time is missing.", culprits=[place])
    falls = np.diff(stamps) <= 0
    if falls.any():
        place = places[int(np.argmax(falls)) + 1]
        raise DataError(
            f"{place}: the time does not increase from the row before.",
            culprits=[place],
            next_step="Sort the rows by time and remove doubled ones.",
        )
    return in_seconds(stamps)


def in_seconds(stamps: FloatArray) -> FloatArray:
    """Reads stamps as seconds; an epoch in milli-, micro- or nanoseconds tells by its size."""
    known = np.abs(stamps[np.isfinite(stamps)])
    largest = float(known.max()) if len(known) else 0.0
    return stamps * next((it for limit, it in _EPOCHS if largest > limit), 1.0)


def pair_streams(
    robot_s: FloatArray, robot: FloatArray, camera_s: FloatArray, camera: FloatArray
) -> Paired:
    """Finds the offset of the clocks and views to calibrate with.

    The offset is where both angular speeds, which no choice of frames changes, agree best.

    Args:
        robot_s: (n,) times [s], increasing.
        robot: (n, 4, 4) `base_from_flange` [m].
        camera_s: (k,) times [s], increasing.
        camera: (k, 4, 4) `cam_from_target` [m].

    Raises:
        DataError: The streams have too little time in common, or their motions do not agree.
    """
    offset_s, correlation = _clock_offset(robot_s, robot, camera_s, camera)
    at_s = camera_s - offset_s
    there = _covered(robot_s, at_s)
    if there.sum() < 3:
        raise DataError(
            f"The robot's poses cover {int(there.sum())} samples of the camera's; 3 or more are "
            f"needed. They are {np.median(np.diff(robot_s)):.2f} s apart; where the gap is "
            f"{_GAP_S} s or more, nothing is interpolated.",
            culprits=["robot", "camera"],
            next_step="Log the robot's pose ten times a second or more.",
        )
    poses = _interpolated(robot_s, robot, at_s[there])
    angular, linear = _speeds(robot_s, robot, at_s[there])
    chosen = _slow_and_new(poses, angular + linear / _ARM_M)
    rows = np.flatnonzero(there)[chosen]
    return Paired(
        rows.astype(np.int64), poses[chosen], offset_s, correlation, float(angular[chosen].max())
    )


def _clock_offset(
    robot_s: FloatArray, robot: FloatArray, camera_s: FloatArray, camera: FloatArray
) -> tuple[float, float]:
    """Correlates angular speeds: (camera minus robot [s], correlation)."""
    start = max(robot_s[0], camera_s[0])
    end = min(robot_s[-1], camera_s[-1])
    if end - start < 2.0:
        raise DataError(
            f"The streams have {max(end - start, 0.0):.1f} s in common (robot {robot_s[0]:.2f} to "
            f"{robot_s[-1]:.2f}, camera {camera_s[0]:.2f} to {camera_s[-1]:.2f}); 2 s or more are "
            "needed.",
            culprits=["robot", "camera"],
            next_step="Stamp both with the same clock, to within a few seconds.",
        )
    if end - start > _LONGEST_S:
        raise DataError(
            f"The streams have {end - start:.0f} s in common; up to {_LONGEST_S:.0f} are read.",
            culprits=["robot", "camera"],
            next_step="Cut the recording into parts.",
        )
    widest_s = min(_WIDEST_OFFSET_S, 0.25 * (end - start))
    widest = int(widest_s / _STEP_S)
    lags = np.arange(-widest, widest + 1)
    at_s = start + _STEP_S * np.arange(int((end - start) / _STEP_S))
    speed = _speeds(robot_s, robot, at_s)[0]
    wider_s = at_s[0] + _STEP_S * np.arange(-widest, len(at_s) + widest)
    other = _speeds(camera_s, camera, wider_s)[0]
    known, other_known = _inside(robot_s, at_s), _inside(camera_s, wider_s)
    scores = np.zeros(len(lags))
    for it in range(len(lags)):
        both = known & other_known[it : it + len(at_s)]
        # Chance alone correlates a short overlap.
        if both.sum() > 0.5 * len(at_s):
            scores[it] = _correlation(speed[both], other[it : it + len(at_s)][both])
    best = int(scores.argmax())
    if scores[best] < _LEAST_CORRELATION:
        raise DataError(
            f"The turning of robot and camera agrees with a correlation of {scores[best]:.2f} at "
            f"best, {lags[best] * _STEP_S:+.2f} s apart; {_LEAST_CORRELATION} is needed.",
            culprits=["robot", "camera"],
            next_step="Check that both streams are of the same motion.",
        )
    if not 0 < best < len(lags) - 1:
        raise DataError(
            f"The turning of robot and camera agrees best {lags[best] * _STEP_S:+.2f} s apart, "
            f"where the search ends: offsets within {widest_s:.2f} s are tried.",
            culprits=["robot", "camera"],
            next_step="Stamp both with clocks that differ by less, or record for longer.",
        )
    left, middle, right = scores[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    fine = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
    return float((lags[best] + fine) * _STEP_S), float(scores[best])


def _inside(stamps_s: FloatArray, at_s: FloatArray) -> Mask:
    """Tells around which moments a stream is known."""
    return np.asarray((at_s >= stamps_s[0] + _WINDOW_S) & (at_s <= stamps_s[-1] - _WINDOW_S))


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


def _covered(robot_s: FloatArray, at_s: FloatArray) -> Mask:
    """Tells which moments lie between two samples of the robot that are close to each other."""
    right = np.clip(np.searchsorted(robot_s, at_s), 1, len(robot_s) - 1)
    inside = (at_s >= robot_s[0]) & (at_s <= robot_s[-1])
    return np.asarray(inside & (robot_s[right] - robot_s[right - 1] < _GAP_S))


def _interpolated(stamps_s: FloatArray, poses: FloatArray, at_s: FloatArray) -> FloatArray:
    rotations = Slerp(stamps_s, Rotation.from_matrix(poses[:, :3, :3]))(at_s).as_matrix()
    positions = [np.interp(at_s, stamps_s, poses[:, axis, 3]) for axis in range(3)]
    return compose(rotations, np.stack(positions, axis=-1))


def _speeds(
    stamps_s: FloatArray, poses: FloatArray, at_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angular [rad/s] and linear [m/s] speeds around some moments."""
    ends = [
        _interpolated(stamps_s, poses, np.clip(at_s + it, stamps_s[0], stamps_s[-1]))
        for it in (-_WINDOW_S, _WINDOW_S)
    ]
    angle = rotation_angle(invert(ends[0]) @ ends[1])
    way = np.linalg.norm(ends[1][:, :3, 3] - ends[0][:, :3, 3], axis=1)
    return np.asarray(angle / (2 * _WINDOW_S)), np.asarray(way / (2 * _WINDOW_S))


def _slow_and_new(poses: FloatArray, speed: FloatArray) -> IntArray:
    """Chooses the slowest moments, each in a pose of its own."""
    chosen: list[int] = []
    limit = float(np.quantile(speed, _SLOW_SHARE))
    for at in np.argsort(speed, kind="stable"):
        enough = len(chosen) >= _ENOUGH_VIEWS and speed[at] > limit
        if enough or len(chosen) == _MOST_VIEWS:
            break
        between = invert(poses[chosen]) @ poses[at]
        near = (rotation_angle(between) < _NEW_RAD) & (
            np.linalg.norm(between[:, :3, 3], axis=-1) < _NEW_M
        )
        if not near.any():
            chosen.append(int(at))
    return np.array(sorted(chosen), dtype=np.int64)
