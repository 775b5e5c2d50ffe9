"""Folders with one file a view, or several kinds of file a view.

Among them HALCON's poses: `f 0`, `r` with a rotation, `t` with a translation [m].
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.documents import is_number, read_table
from visioncal.core.documents.arrays import read_npy, read_npz
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import is_inside
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.columns import DOCUMENTS, ENDINGS, foreign_from, read_document
from visioncal.interchange.formats.fields import fields_of_records, flattened
from visioncal.interchange.formats.file_search import (
    files_in,
    is_image_name,
    number_in,
    series_name,
)
from visioncal.interchange.formats.foreign import ForeignFormat, ForeignRecording, ImportOptions

_LINE = re.compile(r"^[ \t]*([frt])[ \t]+(\S.*)$", re.MULTILINE)
# Rotation forms by the code of the representation (create_pose): angles about x, y, z in the
# letters' order, or the Rodrigues vector of length tan(angle / 2).
_EULER = {0: "XYZ", 2: "xyz"}
_RODRIGUES = 4


@dataclass(frozen=True)
class _Family:
    """Files of one kind in a folder, one a view: `pose_000.txt`, `pose_001.txt`, ..."""

    name: str
    files: Mapping[int, Path]


def _families(folder: Path) -> tuple[_Family, ...]:
    """Groups a folder's data files by their names without the number, the largest group first."""
    groups: dict[str, dict[int, Path]] = defaultdict(dict)
    for file in files_in(folder):
        number = number_in(file.name)
        if file.suffix.lower() in ENDINGS and number is not None:
            groups[series_name(file)].setdefault(number, file)
    families = [_Family(name.rsplit(".", 1)[0], files) for name, files in groups.items()]
    return tuple(
        sorted(
            (family for family in families if len(family.files) > 1),
            key=lambda family: -len(family.files),
        )
    )


def _view_folder(path: Path) -> Path | None:
    """The folder with one file a view: the named one, or `poses` in it."""
    if not path.is_dir():
        return None
    inner = path / "poses"
    folders = (path, inner) if is_inside(inner, path) else (path,)
    return next((folder for folder in folders if _families(folder)), None)


def _read_views(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a folder with one file a view, or several kinds of file a view."""
    folder = _view_folder(path)
    if folder is None:
        raise DataError(f"{path} has no files like pose_01.json.", culprits=[str(path)])
    families = _families(folder)
    views = sorted({number for family in families for number in family.files})
    records: list[dict[str, object]] = [{} for _ in views]
    for family in families:
        prefix = f"{family.name}." if len(families) > 1 else ""
        for at, view in enumerate(views):
            if view in family.files:
                for key, value in _record(family.files[view]).items():
                    key_name = family.name if key == "matrix" else f"{prefix}{key}"
                    records[at][key_name or "matrix"] = value
    places = [
        " and ".join(family.files[view].name for family in families if view in family.files)
        for view in views
    ]
    name = (path if folder == path else folder.parent).resolve().name
    fields = fields_of_records(records, places, name, folder, tuple(views))
    folders = (file for file in (folder, path, path / "images") if is_inside(file, path))
    images = next(
        (file for file in folders if any(is_image_name(at.name) for at in files_in(file))), None
    )
    return foreign_from(fields, requested, images=images)


def _record(path: Path) -> dict[str, object]:
    """Reads one view's file; numbers without a name are its matrix or pose."""
    suffix = path.suffix.lower()
    document: object
    if suffix == ".npz":
        document = read_npz(path)
    elif suffix == ".npy":
        document = read_npy(path)
    elif suffix in DOCUMENTS:
        document = read_document(path)
    else:
        pose = _halcon_pose(path) if suffix == ".dat" else None
        document = _table_record(path) if pose is None else pose
    return flattened(document if isinstance(document, Mapping) else {"matrix": document})


def _table_record(path: Path) -> object:
    table = read_table(path)
    if table.has_header and len(table.rows) == 1:
        return dict(zip(table.columns, (_cell(row) for row in table.rows[0]), strict=True))
    rows = [[_cell(name) for name in row] for row in table.rows]
    return rows[0] if len(rows) == 1 else rows


def _cell(text: str) -> object:
    return float(text) if is_number(text) else text


VIEWS = ForeignFormat(
    "views",
    "a folder with one or more files a view (pose_01.json, .txt, .npz)",
    lambda path: _view_folder(path) is not None,
    _read_views,
)


def _halcon_pose(path: Path) -> FloatArray | None:
    """Reads one file's (4, 4) pose [m]."""
    lines = {match[1]: match[2].split() for match in _LINE.finditer(read_plain_text(path))}
    if lines.keys() != {"f", "r", "t"}:
        return None
    counts = {name: len(words) for name, words in lines.items()}
    if counts != {"f": 1, "r": 3, "t": 3} or not all(
        is_number(name) for values in lines.values() for name in values
    ):
        raise DataError(f"{path}: f, r and t hold 1, 3 and 3 numbers.", culprits=[str(path)])
    (code,), turns, position = (np.array(lines[name], dtype=float) for name in "frt")
    if code == _RODRIGUES:
        half = np.arctan(np.linalg.norm(turns))
        rotation = Rotation.from_rotvec(2.0 * half * turns / max(float(np.tan(half)), 1e-300))
    elif code in _EULER:
        rotation = Rotation.from_euler(_EULER[int(code)], turns, degrees=True)
    else:
        raise DataError(
            f"{path}: the pose is of type {code:g}; {_RODRIGUES} and {[*_EULER]} are read.",
            culprits=[str(path)],
            next_step="Write it with convert_pose_type as 'Rp+T', 'gba', 'point'.",
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose
