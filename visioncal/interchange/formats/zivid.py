"""Zivid: a 4 x 4 matrix in millimetres a pose, as its SDK writes them."""

import re
from pathlib import Path

import numpy as np

from visioncal.core.documents import mapping, read_yaml
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.finding import head, images_beside, listed, number_in
from visioncal.interchange.formats.foreign import Foreign, ForeignFormat
from visioncal.interchange.formats.import_options import ImportOptions
from visioncal.interchange.formats.poses import as_matrix, matrix_numbers

_POSE_NAME = re.compile(r"(pos|pose|robot_pose)_?[0-9]+\.ya?ml", re.IGNORECASE)


def _pose_files(path: Path) -> tuple[Path, ...]:
    if not path.is_dir():
        return ()
    named = tuple(it for it in listed(path) if _POSE_NAME.fullmatch(it.name))
    return named if named and re.search("FloatMatrix|PoseState", head(named[0])) else ()


def _read(path: Path, requested: ImportOptions) -> Foreign:
    """Reads pos01.yaml ... (Zivid SDK, Matrix4x4; older samples, OpenCV's `PoseState`)."""
    files = _pose_files(path)
    if not files:
        raise DataError(f"{path} has no files like pos01.yaml.", culprits=[str(path)])
    matrices = np.array([_matrix(it) for it in files])
    numbers = [number_in(it.name) for it in files]
    views = tuple(it for it in numbers if it is not None)
    places = tuple(it.name for it in files)
    images, notes = images_beside(path, requested.images, views, places, numbered=True)
    return Foreign(
        name=path.resolve().name,
        robot=requested.robot.applied_to(matrix_numbers(matrices, places, unit="mm")),
        images=images,
        views=views,
        notes=notes,
    )


def _matrix(path: Path) -> FloatArray:
    content = mapping(read_yaml(path), str(path))
    value = content.get("PoseState")
    if value is None:
        value = mapping(content.get("FloatMatrix"), f"{path}: FloatMatrix").get("Data")
    return as_matrix(value, f"{path}: Data")


ZIVID = ForeignFormat(
    "zivid", "Zivid's pos01.yaml ... in millimetres", lambda path: bool(_pose_files(path)), _read
)
