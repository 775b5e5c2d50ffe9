"""Poses of the robot in one file and of the camera in another: paired by time, or row by row."""

import numpy as np

from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.interchange.formats.fields import Fields, stamp_name, unnamed_columns
from visioncal.interchange.formats.foreign import Foreign, ForeignSweep
from visioncal.interchange.formats.import_options import ImportOptions, PoseImportOptions
from visioncal.interchange.formats.poses import pose_names, poses_from
from visioncal.interchange.formats.streams import pair_streams, seconds


def with_camera_file(
    robot_fields: Fields, camera_fields: Fields, requested: ImportOptions
) -> Foreign:
    """Joins a file of the robot's poses with one of the camera's.

    By time where both have times, else row by row.

    Raises:
        DataError: Either holds no poses, they are not as many, or their motions do not agree.
    """
    robot, robot_names, first = _poses(robot_fields, requested.robot, "robot")
    camera, camera_names, second = _poses(camera_fields, requested.camera, "camera")
    notes = (*first, *second)
    robot_stamp = stamp_name(robot_fields, robot_names)
    camera_stamp = stamp_name(camera_fields, camera_names)
    if not robot_stamp or not camera_stamp:
        return _row_by_row(robot_fields, robot, camera, notes)
    robot_s, camera_s = (
        seconds(fields.column(name)[:, 0], fields.places)
        for fields, name in ((robot_fields, robot_stamp), (camera_fields, camera_stamp))
    )
    return _by_time(robot_fields.name, (robot_s, robot), (camera_s, camera), notes)


def _poses(
    fields: Fields, requested: PoseImportOptions, whose: str
) -> tuple[PoseNumbers, tuple[str, ...], tuple[str, ...]]:
    """Takes the poses of one file: (poses, the fields that hold them, what was assumed)."""
    unnamed = unnamed_columns(fields)["robot"]
    # A file of the camera's poses alone calls them what a robot's file calls its own.
    ways = (pose_names(fields, requested.names, unnamed, name, ()) for name in (whose, "robot"))
    names = next(filter(None, ways), ())
    if not names:
        raise DataError(
            f"{fields.name}: which of its fields are the {whose}'s poses is not known; it has "
            f"{fields.listing()}.",
            culprits=[fields.name],
            next_step=f"Name them with --{whose}-columns.",
        )
    poses, notes = poses_from(fields, names, requested, whose)
    return poses, names, notes


def _row_by_row(
    fields: Fields, robot: PoseNumbers, camera: PoseNumbers, notes: tuple[str, ...]
) -> Foreign:
    if len(robot) != len(camera):
        raise DataError(
            f"There are {len(robot)} poses of the robot and {len(camera)} of the camera, without "
            "times; as many of both are needed.",
            culprits=[robot.places[-1], camera.places[-1]],
        )
    return Foreign(name=fields.name, robot=robot, camera=camera, notes=notes)


def _by_time(
    name: str,
    robot: tuple[FloatArray, PoseNumbers],
    camera: tuple[FloatArray, PoseNumbers],
    notes: tuple[str, ...],
) -> Foreign:
    robot_s, robot_poses, robot_rows = _known(*robot)
    camera_s, camera_poses, camera_rows = _known(*camera)
    paired = pair_streams(robot_s, robot_poses, camera_s, camera_poses)
    seen = camera[1].rows(camera_rows)
    sampled = seen.rows(paired.rows)
    return Foreign(
        name=name,
        robot=PoseNumbers.written(paired.base_from_flange, robot[1].reading, sampled.places),
        camera=sampled,
        stamps_s=camera_s[paired.rows],
        sweep=ForeignSweep(robot_s, robot[1].rows(robot_rows), camera_s, seen),
        notes=(
            *notes,
            f"The camera's clock is about {1e3 * paired.match.offset_s:+.0f} ms ahead of the "
            "robot's, as both turn alike there with a correlation of "
            f"{paired.match.correlation:.2f}; calibrate estimates it finer.",
            f"All {len(seen)} samples of the camera are kept as views, and the robot's as a stream "
            "beside them: calibrate takes the robot's poses from there.",
        ),
    )


def _known(stamps_s: FloatArray, numbers: PoseNumbers) -> tuple[FloatArray, FloatArray, IntArray]:
    """Leaves out the samples without a pose: (times, (m, 4, 4) poses, their rows)."""
    rows = np.flatnonzero(numbers.there)
    if len(rows) < 3:
        place = numbers.places[0]
        raise DataError(f"{place}: {len(rows)} poses; 3 or more are needed.", culprits=[place])
    return stamps_s[rows], numbers.poses()[rows], rows
