"""Folders with one file a view: ViSP's YAML with a camera XML, Zivid's with matrices [mm]."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from visioncal.core.documents.structured import read_yaml
from visioncal.core.documents.values import as_numbers, mapping, read_plain_text
from visioncal.core.types import MOUNTS
from visioncal.interchange.formats.columns import VIEWS, foreign_from
from visioncal.interchange.formats.fields import fields_of_records
from visioncal.interchange.formats.file_search import files_in, head, images_of
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ImportOptions,
    PoseImportOptions,
)
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.interchange.formats.keys import number_in

# `franka_pose_rPe_3.yaml`: the end effector in the robot's reference frame; `pose_cPo_3.yaml`: the
# object in the camera.
_POSE_NAME = re.compile(r".*pose_[a-z]Pe_[0-9]+\.ya?ml", re.IGNORECASE)
_CAMERA_POSE_NAME = re.compile(r".*pose_cPo_[0-9]+\.ya?ml", re.IGNORECASE)
_ZIVID_NAME = re.compile(r"(pos|pose|robot_pose)_?[0-9]+\.ya?ml", re.IGNORECASE)


def _named(path: Path, name: re.Pattern[str]) -> tuple[Path, ...]:
    """Files of a folder whose names match; none of another path."""
    return tuple(file for file in files_in(path) if name.fullmatch(file.name))


def _is_zivid(path: Path) -> bool:
    first = next(iter(_named(path, _ZIVID_NAME)), None)
    return first is not None and bool(re.search("FloatMatrix|PoseState", head(first)))


def _read_zivid(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads pos01.yaml ... (Zivid SDK, Matrix4x4; older samples, OpenCV's `PoseState`)."""
    stated = requested.with_poses(PoseImportOptions(unit="mm"), PoseImportOptions())
    return VIEWS.read(path, stated)


ZIVID = ForeignFormat("zivid", "Zivid's pos01.yaml ... in millimetres", _is_zivid, _read_zivid)


def _read(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads the folder; a pose is tx, ty, tz [m] and theta-u [rad] (ViSP, vpPoseVector)."""
    files = _named(path, _POSE_NAME)
    cameras = {number_in(file.name): file for file in _named(path, _CAMERA_POSE_NAME)}
    records = [
        {
            name: as_numbers(mapping(read_yaml(at), str(at)).get("data"), f"{at}: data").reshape(-1)
            for name, at in (("robot", file), ("camera", cameras.get(number_in(file.name))))
            if at is not None
        }
        for file in files
    ]
    places, views = zip(*((file.name, number_in(file.name) or 0) for file in files), strict=True)
    fields = fields_of_records(records, places, path.resolve().name, path, views)
    robot, camera = (
        PoseImportOptions((name,), "rotation-vector", "m") for name in ("robot", "camera")
    )
    stated = requested.with_poses(robot, camera if cameras else PoseImportOptions())
    foreign = foreign_from(fields, stated, images=images_of(path))
    notes = [*foreign.notes]
    lenses = [file for file in files_in(path) if file.suffix.lower() == ".xml"]
    lens, lens_notes = read_intrinsics(lenses[0]) if lenses else (None, ())
    mount = next((mount for mount in MOUNTS if mount in path.resolve().name), None)
    if mount is not None:
        notes.append(f"The mount is taken from the folder's name: {mount}.")
    target = None if requested.target else _target(path)
    return replace(
        foreign,
        # Poses of the object in the camera are used only where there are no images.
        camera=None if any(foreign.images) else foreign.camera,
        mount=mount,
        target=target,
        lens=lens,
        notes=(*notes, *lens_notes),
    )


def _target(path: Path) -> dict[str, Any] | None:
    """Reads a checkerboard from a note beside the images, where that is complete."""
    for file in files_in(path):
        text = read_plain_text(file) if file.name.endswith("-data.txt") else ""
        size = re.search(r"size:\s*([0-9]{1,6}(?:\.[0-9]{1,9})?)\s*m\b", text)
        board = re.search(r"([0-9]{1,3})\s*x\s*([0-9]{1,3})", text)
        if size and board and "chess" in text.lower():
            columns, rows = int(board[1]), int(board[2])
            square = {"square_m": float(size[1])}
            return {"kind": "checkerboard", "columns": columns, "rows": rows, **square}
    return None


VISP = ForeignFormat(
    "visp",
    "ViSP's poses (*_pose_rPe_1.yaml) with images and a camera XML, or with pose_cPo_1.yaml",
    lambda path: bool(_named(path, _POSE_NAME)),
    _read,
)
