"""Poses of the robot in one file and of the camera in another: paired by time, or row by row."""

from collections.abc import Sequence

import numpy as np

from visioncal.conventions import PoseNumbers, Reading
from visioncal.errors import DataError
from visioncal.formats.fields import Fields, stamp_name, unnamed_columns
from visioncal.formats.foreign import Foreign, numbers_of
from visioncal.formats.poses import CAMERA_KEYS, ROBOT_KEYS, known_names, poses_from
from visioncal.formats.streams import pair_streams, seconds
from visioncal.formats.wishes import PoseWishes, Wishes
from visioncal.types import FloatArray


def with_camera_file(robot_fields: Fields, camera_fields: Fields, wishes: Wishes) -> Foreign:
    """Joins a file of the robot's poses with one of the camera's.

    By time where both have times, else row by row.

    Raises:
        DataError: Either holds no poses, they are not as many, or their motions do not agree.
    """
    robot, first = _poses(robot_fields, wishes.robot, "robot", ROBOT_KEYS)
    # A file of the camera's poses alone calls them what a robot's file calls its own.
    keys = (*CAMERA_KEYS, *ROBOT_KEYS)
    camera, second = _poses(camera_fields, wishes.camera, "camera", keys)
    notes = (*first, *second)
    stamps = [stamp_name(it) for it in (robot_fields, camera_fields)]
    if not all(stamps):
        return _row_by_row(robot_fields, robot, camera, notes)
    robot_s, camera_s = (
        seconds(fields.column(name)[:, 0], fields.places)
        for fields, name in zip((robot_fields, camera_fields), stamps, strict=True)
    )
    return _by_time(robot_fields.name, (robot_s, robot), (camera_s, camera), notes)


def _poses(
    fields: Fields, wishes: PoseWishes, whose: str, keys: Sequence[tuple[str, ...]]
) -> tuple[PoseNumbers, tuple[str, ...]]:
    names = wishes.names or unnamed_columns(fields)["robot"] or known_names(fields, keys)
    if not names:
        raise DataError(
            f"{fields.name}: which of its fields are the {whose}'s poses is not known; it has "
            f"{fields.listing()}.",
            culprits=[fields.name],
            next_step=f"Name them with --{whose}-columns.",
        )
    return poses_from(fields, names, wishes, whose)


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
    robot_s, robot_numbers = _whole(*robot)
    camera_s, camera_numbers = _whole(*camera)
    paired = pair_streams(robot_s, robot_numbers.poses(), camera_s, camera_numbers.poses())
    rows = paired.rows
    places = tuple(camera_numbers.places[it] for it in rows)
    poses = paired.base_from_flange
    count = len(rows)
    return Foreign(
        name=name,
        robot=PoseNumbers(
            poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9), Reading("matrix"), places
        ),
        camera=numbers_of(camera_numbers, rows),
        stamps_s=camera_s[rows],
        camera_minus_robot_s=paired.camera_minus_robot_s,
        notes=(
            *notes,
            f"The camera's clock is {paired.camera_minus_robot_s:+.4f} s ahead of the robot's, as "
            f"both angular speeds agree there with a correlation of {paired.correlation:.2f}.",
            f"{count} of {len(camera_s)} samples are taken, at moments when the robot turns by "
            f"less than {np.rad2deg(paired.slow):.1f} deg/s; its poses are interpolated.",
        ),
    )


def _whole(stamps_s: FloatArray, numbers: PoseNumbers) -> tuple[FloatArray, PoseNumbers]:
    """Leaves out the samples without a pose."""
    there = np.isfinite(numbers.positions).all(axis=1) & np.isfinite(numbers.rotations).all(axis=1)
    if there.sum() < 3:
        raise DataError(f"{numbers.places[0]}: {int(there.sum())} poses; 3 or more are needed.")
    return stamps_s[there], numbers_of(numbers, np.flatnonzero(there))
