"""Folders of several recordings, and of the robot's poses and the camera's in a file each."""

import re
import shlex
from itertools import combinations
from pathlib import Path

import numpy as np

from visioncal.calibration.guess import FEWEST_ROWS
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, some_of
from visioncal.interchange.formats.fields import Fields
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.joints import joint_names
from visioncal.interchange.formats.pose_words import PoseFields, words_of
from visioncal.interchange.formats.poses import columns_named, possible_poses
from visioncal.interchange.formats.sources import Source, is_whole

_OF_ROBOT = re.compile("robot|arm|gripper|flange|tcp|hand", re.IGNORECASE)


def several_recordings(source: Source, requested: ImportOptions) -> DataError | None:
    """The error of a folder with several files that are each a whole recording; None of others.

    Each has the same fields, with poses of both sides, or their names differ in numbers alone:
    rows of one are none of another's.
    """
    alike: dict[tuple[str, ...], list[tuple[Path, int]]] = {}
    for part in source.parts:
        for fields in part.rows if len(part.group.files) == 1 else ():
            poses = [item for item in possible_poses(fields) if item.is_named]
            # An instrument's poses or points beside joint angles.
            is_of_joints = not source.images and bool(joint_names(fields, ()))
            is_of_joints &= bool(poses or columns_named(fields, ("x", "y", "z")))
            has_two_sides = len(poses) > 1 or is_of_joints
            if is_whole(fields) if part.kin else has_two_sides:
                same_fields = alike.setdefault(
                    (part.kin,) if part.kin else tuple(sorted(fields.numbers)), []
                )
                same_fields.append((part.group.files[0], len(fields)))
    found = max(alike.values(), key=len, default=[])
    if len(found) < 2:
        return None
    first = max(found, key=lambda each: each[1])[0]
    command = [str(first) if word == str(source.path) else word for word in requested.command]
    files = [f"{file.name} ({counted(count, 'row')})" for file, count in found]
    return DataError(
        f"{source.path} has {len(found)} files that are each a recording: {some_of(files)}.",
        culprits=[str(file) for file, _ in found],
        next_step="Convert one of them"
        + (f":\n{shlex.join(command)}" if requested.command else "."),
    )


def tables_apart(source: Source, requested: ImportOptions) -> tuple[Path, Path] | None:
    """The robot's file and the camera's where two files of poses are as long; None of others.

    The names of the files say which side each is of. Raises DataError where they do not.
    """
    files = [
        (part.group.files[0], fields)
        for part in source.parts
        for fields in part.rows
        if len(part.group.files) == 1 and possible_poses(fields) and "joint" not in part.group.name
    ]
    sides = {file: _sides(file) for file, _ in files}
    files.sort(key=lambda of: (sides[of[0]] == ["camera"], not _OF_ROBOT.search(of[0].stem)))
    # Two files of one side, as of a camera's poses before and after a filter, are no pair.
    pairs = [
        (a, b, fields, others)
        for (a, fields), (b, others) in combinations(files, 2)
        if len(fields) == len(others) and sides[a] != ["camera"] and sides[b] != ["robot"]
    ]
    if len(pairs) != 1 or (len(files) > 2 and len(pairs[0][2]) < FEWEST_ROWS):
        return None
    robot, camera, fields, others = pairs[0]
    if sides[robot] == ["robot"] and sides[camera] == ["camera"]:
        return robot, camera
    command = [str(robot) if word == str(source.path) else word for word in requested.command]
    two_files = shlex.join([*command, "--camera-file", str(camera)])
    if _is_run_again(fields, others):
        # Of the very same rows both sides would be one.
        is_copy = all(
            name in others.numbers and np.array_equal(numbers, others.numbers[name], equal_nan=True)
            for name, numbers in fields.numbers.items()
        )
        again = "." if is_copy else f"; or both, where their frames are alike:\n{two_files}"
        raise DataError(
            f"{source.path}: {camera.name} has nearly the same {len(fields)} rows as {robot.name}, "
            "as of two runs of one side: then nothing says what a camera saw.",
            culprits=[str(camera)],
            next_step=f"Name one, with --images{again}",
        )
    raise DataError(
        f"{source.path} has {len(fields)} poses in {robot.name} and as many in {camera.name}: "
        "which are the robot's is not stated.",
        culprits=[str(robot), str(camera)],
        next_step="Name the file of the robot, and that of the camera with "
        f"--camera-file:\n{two_files}",
    )


# Most that two runs of one motion differ by, as a share of what a column spans: a joint repeats to
# less than a degree, and a hand to a centimetre of some hundreds of millimetres.
_SAME_RUN = 0.05


def _is_run_again(fields: Fields, others: Fields) -> bool:
    """Whether rows are of another run of one motion: most columns differ by little of their span.

    Lengths and rotations have sizes of their own: where positions span hundreds of millimetres, any
    two rotations are near each other beside these.
    """
    one, other = (np.hstack([*map(each.column, each.numbers)]) for each in (fields, others))
    if one.shape != other.shape:
        return False
    spans = np.nanstd(one, axis=0)
    varied = spans > 1e-9 * np.nanmax(np.abs(one), initial=0.0)
    if not varied.any():
        return True
    shares = np.nanmedian(np.abs(one - other), axis=0)[varied] / spans[varied]
    return bool(np.median(shares) < _SAME_RUN)


def _sides(file: Path) -> list[str]:
    """The sides whose frames the words of a file's name are: `robotData`, `cam_poses_2`."""
    return PoseFields((), tuple(words_of(re.sub(r"[0-9]+", "_", file.stem)))).sides
