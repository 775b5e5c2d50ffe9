"""Findings on misread readings of an instrument: another reading of its numbers fits the robot."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.guess.fit import STARTS, mounting_fits
from visioncal.calibration.guess.recording import thinned
from visioncal.calibration.pipeline.guess_inputs import guess_from_camera_poses, numbers_in
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.readings import places_of_one_point
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CLEAR_RATIO, FEWEST_STOPS
from visioncal.core.verdict import Finding, calibrating
from visioncal.session.columns import INSTRUMENT_POSITION, INSTRUMENT_QUATERNION

# Mirroring another axis is equivalent, up to half turns of the instrument's frame.
_MIRROR = np.array([1.0, 1.0, -1.0])


def misread_readings(run: RunState) -> Iterator[Finding]:
    """Another reading of an instrument's numbers, which alone fits the robot's poses.

    Places in a left-handed frame fit no right-handed one. Poses of a probe are tried as a fixed
    camera's of a target.
    """
    if run.readings is None:
        return
    read = places_of_one_point(run.readings)
    views = [view for view in read if view in run.base_from_flange and view not in run.held_back]
    if len(views) < FEWEST_STOPS:
        return
    rows = thinned(np.arange(len(views)))
    flanges, places = (
        np.array([by_view[views[at]] for at in rows]) for by_view in (run.base_from_flange, read)
    )
    as_read, mirrored = (
        mounting_fits(flanges[None], sign * places, STARTS)[0] for sign in (1.0, _MIRROR)
    )
    if not as_read.closes and mirrored.closes and CLEAR_RATIO * mirrored.score < as_read.score:
        yield Finding(
            "misread_readings",
            "The instrument's readings are in a left-handed frame: with one axis mirrored (two "
            f"exchanged, or one of the other sign), they fit the robot's poses to "
            f"{mirrored.figures}; as read, to {as_read.figures}.",
            calibrating(
                "Look which columns the instrument's program wrote: exchange two of meas_x_m, "
                "meas_y_m and meas_z_m in views.csv, or negate one, and",
                "again. Either gives the same arm; the instrument's frame is the one that it then "
                "is.",
            ),
        )
    elif run.readings.are_poses:
        yield from _misread_probe(run)


def _misread_probe(run: RunState) -> Iterator[Finding]:
    """The finding on another reading of a probe's poses."""
    probe = numbers_in(run.timed, (*INSTRUMENT_POSITION, *INSTRUMENT_QUATERNION))
    try:
        guess = guess_from_camera_poses(run, camera=probe)
    except VisioncalError:
        # Too little to guess from; the calibration's own error says so.
        return
    if guess.stands_out:
        words = guess.sentence.replace("camera", "instrument")
        step = "Write meas_x_m to meas_qw (the probe's poses in the instrument's frame, in metres, "
        step += "quaternion x, y, z, w), or the robot's, so in views.csv, and"
        yield Finding("misread_readings", words, calibrating(step))
