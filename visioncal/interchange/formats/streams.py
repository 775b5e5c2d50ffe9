"""Pairs two pose streams with separate clocks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.clock_offset import LEAST_CORRELATION
from visioncal.calibration.stages.motion import slow_and_new
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.clock_correlation import (
    WIDEST_OFFSET_S,
    ImageTimes,
    Match,
    turning_matches,
)
from visioncal.estimation.trajectory import LONGEST_GAP_S, Trajectory

# Limits of the overlap [s]: a shorter one determines no offset, a longer one is no calibration
# motion.
_SHORTEST_S, _LONGEST_S = 2.0, 3600.0
# Present epochs are about 1e9 s: (larger than, seconds a unit).
_EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


@dataclass(frozen=True, eq=False)
class PairedSamples:
    """A sample of slow, distinct poses from the overlap of two streams."""

    rows: IntArray  # (m,) the chosen samples of the camera.
    base_from_flange: FloatArray  # (m, 4, 4) the robot's poses at these times [m].
    match: Match  # Coarse clock offset, to a fraction of a frame.


def seconds(stamps: FloatArray, places: Sequence[str]) -> FloatArray:
    """Converts stamps to seconds; those of an epoch may be in milli-, micro- or nanoseconds.

    Raises:
        DataError: A stamp is missing, or they do not increase.
    """
    if not np.isfinite(stamps).all():
        place = places[int(np.argmin(np.isfinite(stamps)))]
        raise DataError(f"{place}: the time is missing.", culprits=[place])
    not_increasing = np.diff(stamps) <= 0
    if not_increasing.any():
        place = places[int(np.argmax(not_increasing)) + 1]
        raise DataError(
            f"{place}: the time does not increase from the row before.",
            culprits=[place],
            next_step="Sort the rows by time and remove doubled ones.",
        )
    return in_seconds(stamps)


def in_seconds(stamps: FloatArray) -> FloatArray:
    """Converts stamps to seconds; the size of an epoch shows milli-, micro- or nanoseconds."""
    sizes = np.abs(stamps[np.isfinite(stamps)])
    largest = float(sizes.max()) if len(sizes) else 0.0
    return stamps * next((unit_s for limit, unit_s in _EPOCHS if largest > limit), 1.0)


def pair_streams(
    robot_s: FloatArray, robot: FloatArray, camera_s: FloatArray, camera: FloatArray
) -> PairedSamples:
    """Estimates a coarse clock offset, and selects times at which the robot is slow.

    Args:
        robot_s: (n,) times [s], increasing.
        robot: (n, 4, 4) `base_from_flange`, or the inverse [m].
        camera_s: (k,) times [s], increasing.
        camera: (k, 4, 4) `cam_from_target`, or the inverse [m].

    Raises:
        DataError: The streams overlap too little, or their motions do not agree.
    """
    _check_common(robot_s, camera_s)
    flange = Trajectory(robot_s, robot)
    match = _match(flange, ImageTimes("eye-in-hand", camera_s, camera))
    robot_clock_s = camera_s - match.offset_s
    rows = np.flatnonzero(flange.covers(robot_clock_s))
    if len(rows) < 3:
        raise DataError(
            f"The robot's poses cover {len(rows)} samples of the camera's; 3 or more are "
            f"needed. They are {flange.step_s:.2f} s apart; where the gap is {LONGEST_GAP_S} s or "
            "more, nothing is interpolated.",
            culprits=["robot", "camera"],
            next_step="Log the robot's pose ten times a second or more.",
        )
    poses = flange.at(robot_clock_s[rows])
    chosen = slow_and_new(poses, flange.speeds(robot_clock_s[rows]))
    return PairedSamples(rows[chosen], poses[chosen], match)


def _check_common(robot_s: FloatArray, camera_s: FloatArray) -> None:
    common_s = min(robot_s[-1], camera_s[-1]) - max(robot_s[0], camera_s[0])
    if common_s < _SHORTEST_S:
        raise DataError(
            f"The streams have {max(common_s, 0.0):.1f} s in common (robot {robot_s[0]:.2f} to "
            f"{robot_s[-1]:.2f}, camera {camera_s[0]:.2f} to {camera_s[-1]:.2f}); "
            f"{_SHORTEST_S:g} s or more are needed.",
            culprits=["robot", "camera"],
            next_step="Stamp both with the same clock, to within a few seconds.",
        )
    if common_s > _LONGEST_S:
        raise DataError(
            f"The streams have {common_s:.0f} s in common; up to {_LONGEST_S:.0f} are read.",
            culprits=["robot", "camera"],
            next_step="Cut the recording into parts.",
        )


def _match(flange: Trajectory, frames: ImageTimes) -> Match:
    best = next(iter(turning_matches(flange, frames)), Match(0.0, np.inf, 0.0))
    if flange.step_s >= LONGEST_GAP_S:
        # Too sparse to compare; the caller reports the uncovered samples.
        return best
    if best.correlation < LEAST_CORRELATION:
        raise DataError(
            f"The turning of robot and camera agrees with a correlation of {best.correlation:.2f} "
            f"at best, {best.offset_s:+.2f} s apart; {LEAST_CORRELATION} is needed.",
            culprits=["robot", "camera"],
            next_step="Check that both streams are of the same motion.",
        )
    if best.at_end:
        raise DataError(
            f"The turning of robot and camera agrees best {best.offset_s:+.2f} s apart, "
            f"where the search ends: offsets within {WIDEST_OFFSET_S:g} s and a quarter of the "
            "time in common are tried.",
            culprits=["robot", "camera"],
            next_step="Stamp both with clocks that differ by less, or record for longer.",
        )
    return best
