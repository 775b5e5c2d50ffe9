"""The facts of a session in a recording, without loss.

One static entity holds session.toml, the target and the robot; one row an observation holds its
cells, the numbers as float64. The images are the bytes of their files, at the entity that shows
them. Rerun itself detects no damage, so each record carries a SHA-256 seal of its content.
"""

import json
import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import pyarrow as pa
import rerun as rr
import tomli_w
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from visioncal.errors import DataError
from visioncal.files import parse_toml, sha256
from visioncal.recording import paths
from visioncal.session import MemoryImages, Session, View
from visioncal.session.columns import is_number

FORMAT = 1

_HEADER = "visioncal.Session"
_ROW = "visioncal.Row"
_BLOB = "EncodedImage:blob"
_MEDIA_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".tif": "image/tiff",
    ".tiff": "image/tiff",
}


@dataclass(frozen=True)
class _Header:
    """What holds for all rows; an empty text stands for a document that the session lacks."""

    rows: int
    columns: tuple[str, ...]
    number_columns: tuple[str, ...]
    session_toml: str
    target_json: str
    robot_json: str

    def seal(self) -> str:
        return sha256(json.dumps(list(vars(self).values())).encode())


@dataclass(frozen=True)
class _Row:
    """One row as it is kept: NaN and empty text stand for cells that are not filled."""

    numbers: tuple[float, ...]
    texts: tuple[str, ...]
    image_sha256: str

    def seal(self) -> str:
        numbers = struct.pack(f"<{len(self.numbers)}d", *self.numbers)
        return sha256(numbers + json.dumps([self.texts, self.image_sha256]).encode())


def log_header(stream: rr.RecordingStream, session: Session) -> None:
    """Logs what holds for all views: session.toml, the columns, the target and the robot."""
    header = _Header(
        len(session.views),
        session.columns,
        tuple(name for name in session.columns if is_number(name)),
        tomli_w.dumps(session.document),
        _to_json(session.target_document),
        _to_json(session.robot_document),
    )
    components = {
        "format": pa.array([FORMAT], pa.int64()),
        "rows": pa.array([header.rows], pa.int64()),
        "columns": pa.array(header.columns, pa.string()),
        "number_columns": pa.array(header.number_columns, pa.string()),
        "session_toml": pa.array([header.session_toml], pa.string()),
        "target_json": pa.array([header.target_json], pa.string()),
        "robot_json": pa.array([header.robot_json], pa.string()),
        "seal": pa.array([header.seal()], pa.string()),
    }
    stream.log(paths.SESSION, rr.DynamicArchetype(_HEADER, components=components), static=True)


def log_row(stream: rr.RecordingStream, session: Session, view: View) -> None:
    """Logs one row of the session at the stream's current time, with its image's bytes."""
    has_image = bool(view.image) and session.images.exists(view.image)
    data = session.images.read(view.image) if has_image else b""
    row = _Row(
        tuple(view.numbers.get(name, math.nan) for name in session.columns if is_number(name)),
        tuple(view.cell(name) for name in session.columns if not is_number(name)),
        sha256(data) if has_image else "",
    )
    components = {
        "numbers": pa.array(row.numbers, pa.float64()),
        "texts": pa.array(row.texts, pa.string()),
        "image_sha256": pa.array([row.image_sha256], pa.string()),
        "seal": pa.array([row.seal()], pa.string()),
    }
    stream.log(paths.ROWS, rr.DynamicArchetype(_ROW, components=components))
    if has_image:
        media_type = _MEDIA_TYPES.get(PurePosixPath(view.image).suffix.lower())
        stream.log(paths.IMAGE, rr.EncodedImage(contents=data, media_type=media_type))
    else:
        # Without this, the viewer would go on to show the image of the view before.
        stream.log(paths.IMAGE, rr.Clear(recursive=False))


def read_session(path: Path) -> Session:
    """Reads the session that a recording holds.

    Args:
        path: The `.rrd`.

    Returns:
        The session, with the same facts and the same digest as the one that was written. Its
        images are held in memory.

    Raises:
        DataError: The file is missing, is no recording of a session, or is damaged; the message
            names the view and the image.
    """
    try:
        header, rows, blobs = _read_records(path)
    except (RuntimeError, ValueError, KeyError, IndexError) as error:
        raise DataError(
            f"{path} cannot be read as a recording of visioncal: {error}.",
            culprits=[str(path)],
            next_step="Give the .rrd that visioncal wrote, or the session's folder.",
        ) from error
    header = _checked_header(header, rows, path)
    cells = [_cells(header, rows[index]) for index in range(header.rows)]
    images: dict[str, bytes] = {}
    for index, row_cells in enumerate(cells):
        if rows[index].image_sha256:
            name = dict(zip(header.columns, row_cells, strict=True))["image"]
            images[name] = _checked_image(path, index, name, rows[index], blobs)
    return Session.assemble(
        parse_toml(header.session_toml, "session.toml"),
        header.columns,
        cells,
        MemoryImages(images),
        target_document=_from_json(header.target_json),
        robot_document=_from_json(header.robot_json),
    )


_Records: TypeAlias = tuple[_Header | None, dict[int, _Row], dict[int, bytes]]


def _read_records(path: Path) -> _Records:
    """Reads the header, and the rows and image bytes by their place in the session."""
    header: _Header | None = None
    rows: dict[int, _Row] = {}
    blobs: dict[int, bytes] = {}
    with warnings.catch_warnings():
        # A recording whose writer was killed lacks its footer and can be read nevertheless.
        warnings.simplefilter("ignore", RerunWarning)
        stream = RrdReader(path).stream()
    for chunk in stream.filter(content=[paths.SESSION, paths.ROWS, paths.IMAGE]):
        batch = chunk.to_record_batch()
        names = set(batch.schema.names)
        if chunk.entity_path == paths.SESSION:
            header = _header(batch)
        elif chunk.entity_path == paths.ROWS:
            for place, index in enumerate(batch.column(paths.TIMELINE).to_pylist()):
                rows[index] = _row(batch, place)
        elif _BLOB in names:
            indices = batch.column(paths.TIMELINE).to_pylist()
            for index, blob in zip(indices, batch.column(_BLOB), strict=True):
                if blob.is_valid:
                    blobs[index] = blob.values[0].values.to_numpy().tobytes()
    return header, rows, blobs


def _header(batch: pa.RecordBatch) -> _Header:
    values = {
        name.removeprefix(f"{_HEADER}:"): batch.column(name)[0].as_py()
        for name in batch.schema.names
        if name.startswith(f"{_HEADER}:")
    }
    if values["format"] != [FORMAT]:
        raise ValueError(f"its format is {values['format']}, this version reads {FORMAT}")
    header = _Header(
        int(values["rows"][0]),
        tuple(values["columns"]),
        tuple(values["number_columns"] or ()),
        values["session_toml"][0],
        values["target_json"][0],
        values["robot_json"][0],
    )
    if header.seal() != values["seal"][0]:
        raise ValueError("the session's declaration was changed or damaged after it was written")
    return header


def _row(batch: pa.RecordBatch, place: int) -> _Row:
    numbers, texts, image_sha256, seal = (
        batch.column(f"{_ROW}:{name}")[place].as_py()
        for name in ("numbers", "texts", "image_sha256", "seal")
    )
    row = _Row(tuple(numbers or ()), tuple(texts), image_sha256[0])
    if row.seal() != seal[0]:
        index = batch.column(paths.TIMELINE)[place].as_py()
        raise ValueError(f"row {index + 1} was changed or damaged after it was written")
    return row


def _checked_header(header: _Header | None, rows: Mapping[int, _Row], path: Path) -> _Header:
    """Checks that the records are complete."""
    if header is None:
        raise DataError(
            f"{path} is a recording without a session of visioncal.", culprits=[str(path)]
        )
    missing = [index + 1 for index in range(header.rows) if index not in rows]
    if missing:
        raise DataError(
            f"{path} lacks {len(missing)} of {header.rows} rows, the first of them row "
            f"{missing[0]}: it was cut or damaged.",
            culprits=[f"row {number}" for number in missing],
            next_step="Calibrate the session's folder, or record it again.",
        )
    return header


def _cells(header: _Header, row: _Row) -> list[str]:
    """Writes a row as texts in the order of the columns, as `View.cell` does."""
    numbers, texts = iter(row.numbers), iter(row.texts)
    cells = []
    for name in header.columns:
        if name in header.number_columns:
            value = next(numbers)
            cells.append("" if math.isnan(value) else repr(value))
        else:
            cells.append(next(texts))
    return cells


def _checked_image(
    path: Path, index: int, name: str, row: _Row, blobs: Mapping[int, bytes]
) -> bytes:
    data = blobs.get(index)
    if data is None or sha256(data) != row.image_sha256:
        what = "is missing" if data is None else "does not match its SHA-256: bytes were changed"
        raise DataError(
            f"{path}: the image {name} (row {index + 1}) {what}.",
            culprits=[name],
            next_step="The recording is damaged: take it again from its origin.",
        )
    return data


def _to_json(document: Mapping[str, Any] | None) -> str:
    return "" if document is None else json.dumps(document)


def _from_json(text: str) -> dict[str, Any] | None:
    return dict(json.loads(text)) if text else None
