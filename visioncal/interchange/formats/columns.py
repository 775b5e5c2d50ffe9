"""Tables, JSON and .npz with a row a view; lines of a pendant; a second file of camera poses."""

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray
from visioncal.estimation.trajectory import LONGEST_GAP_S, Samples
from visioncal.interchange.formats.file_search import (
    files_in,
    images_beside,
    images_named,
    is_image_name,
)
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ForeignStream,
    ImportOptions,
    PoseImportOptions,
)
from visioncal.interchange.formats.poses import joint_names, joints_from, pose_names, poses_from
from visioncal.interchange.formats.reading import (
    ENDINGS,
    Fields,
    named_by,
    read_fields,
    stamp_name,
    unnamed_columns,
)

_IMAGE_NAMES = ("image", "img", "filename", "file", "image_file", "image_path")
# Present epochs are about 1e9 s: (larger than, seconds a unit).
_EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


def _read_file(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads one file with a row a view, or the only one in a folder of images."""
    fields = read_fields(_pose_file(path) or path, requested.robot.form)
    if requested.camera_file is None:
        return foreign_from(fields, requested, images=path if path.is_dir() else None)
    return with_camera_file(fields, read_fields(requested.camera_file), requested)


def _pose_file(path: Path) -> Path | None:
    if path.is_file():
        return path if path.suffix.lower() in ENDINGS else None
    files = [file for file in files_in(path) if file.suffix.lower() in ENDINGS]
    # Beside a file of intrinsics or notes, the file's name decides.
    named = [file for file in files if re.search("pose|robot", file.stem.lower())]
    return next((group[0] for group in (files, named) if len(group) == 1), None)


def foreign_from(
    fields: Fields, requested: ImportOptions, *, images: Path | None = None
) -> ForeignRecording:
    """Builds a recording from rows of named values, by their names or the user's options.

    `images` is the folder of the images, where the source is one. Raises DataError.
    """
    unnamed = unnamed_columns(fields)
    given = (*requested.robot.names, *requested.camera.names, *requested.joints)
    used = {fields.find(name) for name in given}
    robot_names = pose_names(fields, requested.robot.names, unnamed["robot"], "robot", used)
    used.update(robot_names)
    camera_names = pose_names(fields, requested.camera.names, unnamed["camera"], "camera", used)
    used.update(camera_names)
    joint_fields = requested.joints or joint_names(fields, used)
    used.update(joint_fields)
    if not robot_names and not joint_fields:
        word = named_by(fields.places[0])
        raise DataError(
            f"{fields.name}: which of its fields are the robot's poses is not known; it has "
            f"{fields.listing()}.",
            culprits=[fields.name],
            next_step=f"Name them with --robot-{word}, or the joint angles with --joint-{word}.",
        )
    notes: tuple[str, ...] = ()
    robot, camera = PoseNumbers.empty(fields.places), None
    if robot_names:
        robot, notes = poses_from(fields, robot_names, requested.robot, "robot")
    if camera_names:
        camera, more = poses_from(fields, camera_names, requested.camera, "camera")
        notes = (*notes, *more)
    joints = None
    if joint_fields:
        joints, more = joints_from(fields, joint_fields, degrees=requested.joints_deg)
        notes = (*notes, *more)
    # Components of a field that is used.
    used |= {text for text in fields.texts if text.rpartition(".")[0] in used}
    stamps = stamp_name(fields, used)
    if stamps and stamps in unnamed["time"]:
        notes = (*notes, f"Column {stamps} is taken for times, as the source does not say.")
    used |= {stamps, "view"} if view_numbers(fields) else {stamps}
    paths, image_name, more = _images(fields, requested, images, used)
    return ForeignRecording(
        name=fields.name,
        robot=robot,
        camera=camera,
        images=paths,
        joints_rad=joints,
        stamps_s=_in_seconds(fields.column(stamps)[:, 0]) if stamps else None,
        form=fields.form,
        views=fields.views or view_numbers(fields),
        columns={
            name: cells for name, cells in fields.texts.items() if name not in used | {image_name}
        },
        notes=(*notes, *more),
    )


def view_numbers(fields: Fields) -> tuple[int, ...]:
    """Numbers in a column `view`, where they are whole and unique; else empty."""
    cells = fields.texts.get("view", ())
    whole = all(cell.isascii() and cell.isdecimal() and len(cell) < 10 for cell in cells)
    return tuple(int(cell) for cell in cells) if whole and len(set(cells)) == len(cells) else ()


def _images(
    fields: Fields, requested: ImportOptions, folder: Path | None, taken: Collection[str]
) -> tuple[tuple[Path | None, ...], str, tuple[str, ...]]:
    """Pairs the rows with images: (paths, the field that names them, notes on assumptions)."""
    beside = requested.images or folder
    name = fields.find(requested.image) if requested.image else _image_name(fields, beside, taken)
    if name in fields.texts:
        return images_named(fields.texts[name], fields.folder, requested.images), name, ()
    has_images = beside is not None and any(is_image_name(file.name) for file in files_in(beside))
    if beside is None or not (requested.images or has_images):
        return (), "", ()
    paths, notes = images_beside(beside, fields.views, fields.places)
    return paths, "", notes


def _image_name(fields: Fields, folder: Path | None, taken: Collection[str]) -> str:
    """Finds the field that names images, by its name or its cells; empty where none does."""
    free = {name: cells for name, cells in fields.texts.items() if name not in taken}
    usual = (name for name in _IMAGE_NAMES if any(map(is_image_name, free.get(name, ()))))
    if name := next(usual, ""):
        return name
    files = [] if folder is None else files_in(folder)
    image_names = {
        name for file in files if is_image_name(file.name) for name in (file.name, file.stem)
    }
    naming = [
        name
        for name, cells in free.items()
        if any(cells)
        and all(not cell or is_image_name(cell) or cell in image_names for cell in cells)
    ]
    if len(naming) > 1:
        raise DataError(
            f"{fields.name}: {some_of(naming)} name images; one of them is needed.",
            culprits=naming,
            next_step=f"Say which with --image-{named_by(fields.places[0]).rstrip('s')}.",
        )
    return next(iter(naming), "")


TABLE = ForeignFormat(
    "table",
    "a table, JSON, YAML or .npz with a row a view, alone or in the folder of its images",
    lambda path: _pose_file(path) is not None,
    _read_file,
)


def with_camera_file(
    robot_fields: Fields, camera_fields: Fields, requested: ImportOptions
) -> ForeignRecording:
    """Joins robot and camera poses of two files: where both have times as a stream, else by row.

    Raises:
        DataError: Either holds no poses, or their numbers differ.
    """
    robot, robot_names, first = _poses(robot_fields, requested.robot, "robot")
    camera, camera_names, second = _poses(camera_fields, requested.camera, "camera")
    notes, name = (*first, *second), robot_fields.name
    robot_stamp = stamp_name(robot_fields, robot_names)
    camera_stamp = stamp_name(camera_fields, camera_names)
    if robot_stamp and camera_stamp:
        robot_s, robot = _timed(robot_fields, robot_stamp, robot)
        camera_s, camera = _timed(camera_fields, camera_stamp, camera)
        is_of_stops = Samples(robot_s).step_s > LONGEST_GAP_S
        # Of stops that one program wrote the times do not determine the offset of two clocks.
        if not (is_of_stops and np.array_equal(robot_s, camera_s)):
            return ForeignRecording(
                name=name,
                robot=PoseNumbers.empty(camera.places),
                camera=camera,
                stamps_s=camera_s,
                stream=ForeignStream(robot_s, robot),
                notes=(
                    *notes,
                    f"All {len(camera)} samples of the camera are views, and the robot's are a "
                    "stream beside them: calibrate finds how far their clocks differ.",
                ),
            )
        notes = (*notes, "Both files have the same times: their rows belong together.")
    if len(robot) != len(camera):
        raise DataError(
            f"There are {len(robot)} poses of the robot and {len(camera)} of the camera, without "
            "times; as many of both are needed.",
            culprits=[robot.places[-1], camera.places[-1]],
        )
    return ForeignRecording(name=name, robot=robot, camera=camera, notes=notes)


def _poses(
    fields: Fields, requested: PoseImportOptions, whose: str
) -> tuple[PoseNumbers, tuple[str, ...], tuple[str, ...]]:
    """Reads the poses of one file: (poses, the fields that hold them, notes on assumptions)."""
    unnamed = unnamed_columns(fields)["robot"]
    # A file of camera poses alone may use the names of a robot's file.
    candidates = (
        pose_names(fields, requested.names, unnamed, name, ()) for name in (whose, "robot")
    )
    names = next(filter(None, candidates), ())
    if not names:
        raise DataError(
            f"{fields.name}: which of its fields are the {whose}'s poses is not known; it has "
            f"{fields.listing()}.",
            culprits=[fields.name],
            next_step=f"Name them with --{whose}-{named_by(fields.places[0])}.",
        )
    poses, notes = poses_from(fields, names, requested, whose)
    return poses, names, notes


def _timed(fields: Fields, stamp: str, numbers: PoseNumbers) -> tuple[FloatArray, PoseNumbers]:
    """Times [s] and poses of the samples that have a pose."""
    stamps, rows = fields.column(stamp)[:, 0], np.flatnonzero(numbers.present)
    bad = ~np.isfinite(stamps)
    bad[1:] |= np.diff(stamps) <= 0
    if bad.any() or len(rows) < 3:
        place = fields.places[int(np.argmax(bad))]
        fault = "the time is missing, or does not increase" if bad.any() else "under three poses"
        raise DataError(
            f"{place}: {fault}.",
            culprits=[place],
            next_step="Sort the rows by time and remove doubled ones.",
        )
    return _in_seconds(stamps)[rows], numbers.rows(rows)


def _in_seconds(stamps: FloatArray) -> FloatArray:
    """Converts stamps to seconds; the size of an epoch shows milli-, micro- or nanoseconds."""
    sizes = np.abs(stamps[np.isfinite(stamps)])
    largest = float(sizes.max()) if len(sizes) else 0.0
    return stamps * next((unit_s for limit, unit_s in _EPOCHS if largest > limit), 1.0)
