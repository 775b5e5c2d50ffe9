"""Folders with one file a view, or several kinds of file a view.

Among them HALCON's poses: `f 0`, `r` with a rotation, `t` with a translation [m].
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.documents import is_number, read_table
from visioncal.core.documents.arrays import read_npy, read_npz
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import is_inside
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.columns import foreign_from
from visioncal.interchange.formats.fields import fields_of_records, flattened
from visioncal.interchange.formats.file_search import (
    files_in,
    is_image_name,
    number_in,
    series_name,
)
from visioncal.interchange.formats.foreign import ForeignFormat, ForeignRecording, ImportOptions
from visioncal.interchange.formats.reading import DOCUMENTS, ENDINGS, read_document

_LINE = re.compile(r"^[ \t]*([frt])[ \t]+(\S.*)$", re.MULTILINE)
# Rotation forms by the code of the representation (create_pose): angles about x, y, z in the
# letters' order, or the Rodrigues vector of length tan(angle / 2).
_EULER = {0: "XYZ", 2: "xyz"}
_RODRIGUES = 4


def _families(folder: Path) -> list[tuple[str, dict[int, Path]]]:
    """Groups a folder's data files by their names without the number, the largest group first.

    A group has one file a view: `pose_000.txt`, `pose_001.txt`, ...
    """
    groups: dict[str, dict[int, Path]] = defaultdict(dict)
    for file in files_in(folder):
        number = number_in(file.name)
        if file.suffix.lower() in ENDINGS and number is not None:
            groups[series_name(file)].setdefault(number, file)
    families = [(name.rsplit(".", 1)[0], files) for name, files in groups.items() if len(files) > 1]
    return sorted(families, key=lambda family: -len(family[1]))


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
    records: dict[int, dict[str, object]] = {}
    places: dict[int, list[str]] = defaultdict(list)
    for view in sorted({number for _, files in families for number in files}):
        records[view] = {}
        for kind, files in ((kind, files) for kind, files in families if view in files):
            places[view].append(files[view].name)
            prefix = f"{kind}." if len(families) > 1 else ""
            for key, value in _record(files[view]).items():
                key_name = kind if key == "matrix" else f"{prefix}{key}"
                records[view][key_name or "matrix"] = value
    name = (path if folder == path else folder.parent).resolve().name
    joined = [" and ".join(names) for names in places.values()]
    fields = fields_of_records([*records.values()], joined, name, folder, tuple(records))
    folders = (file for file in (folder, path, path / "images") if is_inside(file, path))
    images = next(
        (file for file in folders if any(is_image_name(at.name) for at in files_in(file))), None
    )
    return foreign_from(fields, requested, images=images)


def _record(path: Path) -> dict[str, object]:
    """Reads one view's file; numbers without a name are its matrix or pose."""
    suffix = path.suffix.lower()
    document: object = _halcon_pose(path) if suffix == ".dat" else None
    if suffix == ".npz":
        document = read_npz(path)
    elif suffix == ".npy":
        document = read_npy(path)
    elif suffix in DOCUMENTS:
        document = read_document(path)
    elif document is None:
        table = read_table(path)
        rows = [[float(cell) if is_number(cell) else cell for cell in row] for row in table.rows]
        document = rows[0] if len(rows) == 1 else rows
        if table.has_header and len(rows) == 1:
            document = dict(zip(table.columns, rows[0], strict=True))
    return flattened(document if isinstance(document, Mapping) else {"matrix": document})


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
