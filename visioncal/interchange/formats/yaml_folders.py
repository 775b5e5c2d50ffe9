"""Folders with one YAML a pose: ViSP's with a camera XML, and Zivid's with 4 x 4 matrices [mm]."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.documents import as_numbers, mapping
from visioncal.core.documents.structured import read_yaml
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.types import MOUNTS
from visioncal.interchange.formats.file_search import files_in, head, images_beside, number_in
from visioncal.interchange.formats.foreign import ForeignFormat, ForeignRecording, ImportOptions
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.interchange.formats.poses import as_matrix, matrix_numbers

# `franka_pose_rPe_3.yaml`: the end effector in the robot's reference frame; `pose_cPo_3.yaml`: the
# object in the camera.
_POSE_NAME = re.compile(r".*pose_[a-z]Pe_[0-9]+\.ya?ml", re.IGNORECASE)
_CAMERA_POSE_NAME = re.compile(r".*pose_cPo_[0-9]+\.ya?ml", re.IGNORECASE)
_ZIVID_NAME = re.compile(r"(pos|pose|robot_pose)_?[0-9]+\.ya?ml", re.IGNORECASE)


def _zivid_files(path: Path) -> tuple[Path, ...]:
    if not path.is_dir():
        return ()
    named = tuple(file for file in files_in(path) if _ZIVID_NAME.fullmatch(file.name))
    return named if named and re.search("FloatMatrix|PoseState", head(named[0])) else ()


def _read_zivid(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads pos01.yaml ... (Zivid SDK, Matrix4x4; older samples, OpenCV's `PoseState`)."""
    files = _zivid_files(path)
    if not files:
        raise DataError(f"{path} has no files like pos01.yaml.", culprits=[str(path)])
    matrices = []
    for file in files:
        content = mapping(read_yaml(file), str(file))
        value = content.get("PoseState")
        if value is None:
            value = mapping(content.get("FloatMatrix"), f"{file}: FloatMatrix").get("Data")
        matrices.append(as_matrix(value, f"{file}: Data"))
    numbers = [number_in(file.name) for file in files]
    views = tuple(number for number in numbers if number is not None)
    places = tuple(file.name for file in files)
    images, notes = images_beside(path, requested.images, views, places, numbered=True)
    return ForeignRecording(
        name=path.resolve().name,
        robot=requested.robot.applied_to(matrix_numbers(np.array(matrices), places, unit="mm")),
        images=images,
        views=views,
        notes=notes,
    )


ZIVID = ForeignFormat(
    "zivid",
    "Zivid's pos01.yaml ... in millimetres",
    lambda path: bool(_zivid_files(path)),
    _read_zivid,
)


def _pose_files(path: Path, name: re.Pattern[str] = _POSE_NAME) -> tuple[Path, ...]:
    if not path.is_dir():
        return ()
    return tuple(file for file in files_in(path) if name.fullmatch(file.name))


def _read(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads the folder; a pose is tx, ty, tz [m] and theta-u [rad] (ViSP, vpPoseVector)."""
    # Poses of the object in the camera are used only where there are no images.
    files = _pose_files(path)
    if not files:
        raise DataError(f"{path} has no files like franka_pose_rPe_1.yaml.", culprits=[str(path)])
    views = tuple(number_in(file.name) or 0 for file in files)
    places = tuple(file.name for file in files)
    notes: list[str] = []
    images, image_notes = images_beside(path, requested.images, views, places, numbered=True)
    camera_files = (
        {}
        if any(images)
        else {number_in(file.name): file for file in _pose_files(path, _CAMERA_POSE_NAME)}
    )
    camera = requested.camera.applied_to(_poses([camera_files.get(view) for view in views], places))
    cameras = [file for file in files_in(path) if file.suffix.lower() == ".xml"]
    lens, lens_notes = read_intrinsics(cameras[0]) if cameras else (None, ())
    stated = next((mount for mount in MOUNTS if mount in path.resolve().name), None)
    if stated is not None:
        notes.append(f"The mount is taken from the folder's name: {stated}.")
    return ForeignRecording(
        name=path.resolve().name,
        robot=requested.robot.applied_to(_poses(files, places)),
        camera=camera if camera_files else None,
        images=images,
        mount=stated,
        target=None if requested.target else _target(path, notes),
        lens=lens,
        views=views,
        notes=(*notes, *lens_notes, *image_notes),
    )


def _poses(files: Sequence[Path | None], places: tuple[str, ...]) -> PoseNumbers:
    numbers = np.full((len(files), 6), np.nan)
    for at, file in enumerate(files):
        if file is None:
            continue
        content = mapping(read_yaml(file), str(file))
        flat = as_numbers(content.get("data"), f"{file}: data").reshape(-1)
        if len(flat) != 6 or not np.isfinite(flat).all():
            raise DataError(
                f"{file}: data holds {len(flat)} numbers; tx, ty, tz and theta-u are needed.",
                culprits=[str(file)],
            )
        numbers[at] = flat
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading("rotation-vector"), places)


def _target(path: Path, notes: list[str]) -> dict[str, Any] | None:
    """Reads the target from a note beside the images, where that is complete."""
    for file in files_in(path):
        if not file.name.endswith("-data.txt"):
            continue
        text = read_plain_text(file)
        size = re.search(r"size:\s*([0-9]{1,6}(?:\.[0-9]{1,9})?)\s*m\b", text)
        board = re.search(r"([0-9]{1,3})\s*x\s*([0-9]{1,3})", text)
        family = re.search(r"(16h5|25h9|36h10|36h11)", text)
        if size and board and "chess" in text.lower():
            return {
                "kind": "checkerboard",
                "columns": int(board[1]),
                "rows": int(board[2]),
                "square_m": float(size[1]),
            }
        if size and family:
            notes.append(
                f"{file.name} names no id of the tag: give "
                f"--target marker_DICT_APRILTAG_{family[1]}_ID_{1e3 * float(size[1]):g}mm."
            )
    return None


VISP = ForeignFormat(
    "visp",
    "ViSP's poses (*_pose_rPe_1.yaml) with images and a camera XML, or with pose_cPo_1.yaml",
    lambda path: bool(_pose_files(path)),
    _read,
)
