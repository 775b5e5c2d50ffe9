"""How the facts of a session are kept in a recording, without loss.

One static entity holds session.toml, the target and the robot; one row an observation holds its
cells, the numbers as float64. The images are the bytes of their files, at the entity that shows
them. Rerun itself detects no damage, so each record carries a SHA-256 seal of its content.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.files import sha256
from visioncal.core.version import __version__
from visioncal.present.recording import paths
from visioncal.session import Session, Stream, View
from visioncal.session.columns import is_number
from visioncal.session.corners import CornerTable

# 2: the writer's version, a mark behind the last view, and seals on the results; 3: streams;
# 4: corners that another detector found; 5: images that are elsewhere.
FORMAT = 5
# In place of the number of views where that was not known from the start.
UNKNOWN = -1

_BLOB = "EncodedImage:blob"
_HEADER, _ROW, _END = "visioncal.Session", "visioncal.Row", "visioncal.End"
_STREAM, _CORNERS = "visioncal.Stream", "visioncal.Corners"
_MEDIA_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".tif": "image/tiff",
    ".tiff": "image/tiff",
}


@dataclass(frozen=True)
class Header:
    """What holds for all rows; an empty text stands for a document that the session lacks.

    Attributes:
        rows: How many were announced; UNKNOWN where that was open.
        columns: The columns of views.csv.
        number_columns: Those of them that are kept as numbers.
        session_toml: The content of session.toml.
        target_json: The content of the target's file.
        robot_json: The robot's model.
        streams: The names of the streams, and as many seals of them behind.
        corners: The seal of the corners that another detector found; empty where there are none.
        images: What there is of the images: empty for all, `thumbnail`, or `none`; their digests
            are in the rows in any case.
    """

    rows: int
    columns: tuple[str, ...]
    number_columns: tuple[str, ...]
    session_toml: str
    target_json: str
    robot_json: str
    streams: tuple[str, ...] = ()
    corners: str = ""
    images: str = ""

    @classmethod
    def of(cls, session: Session, announced: int, images: str = "") -> "Header":
        """Collects what holds for all rows of a session."""
        return cls(
            announced,
            session.columns,
            tuple(name for name in session.columns if is_number(name)),
            tomli_w.dumps(session.document),
            _to_json(session.target_document),
            _to_json(session.robot_document),
            (*session.streams, *map(fact_seal, session.streams.values())),
            "" if session.corner_table is None else fact_seal(session.corner_table),
            images,
        )

    def seal(self) -> str:
        """SHA-256 of the content."""
        content = list(vars(self).values())
        # Before the third format there were no streams, before the fourth no corners, and before
        # the fifth all images.
        while not content[-1] and len(content) > len(vars(self)) - 3:
            content.pop()
        return sha256(json.dumps(content).encode())

    @property
    def stream_seals(self) -> dict[str, str]:
        """The seals of the streams by their names."""
        count = len(self.streams) // 2
        return dict(zip(self.streams[:count], self.streams[count:], strict=True))

    def cells(self, row: "StoredRow") -> list[str]:
        """Writes a row as texts in the order of the columns, as `View.cell` does."""
        numbers, texts = iter(row.numbers), iter(row.texts)
        cells = []
        for name in self.columns:
            if name in self.number_columns:
                value = next(numbers)
                cells.append("" if math.isnan(value) else repr(value))
            else:
                cells.append(next(texts))
        return cells


@dataclass(frozen=True)
class StoredRow:
    """One row as it is kept: NaN and empty text stand for cells that are not filled.

    Attributes:
        numbers: The cells of the number columns.
        texts: The cells of the other columns.
        image_sha256: Of the image's bytes; empty where there was no image.
    """

    numbers: tuple[float, ...]
    texts: tuple[str, ...]
    image_sha256: str

    @classmethod
    def of(cls, columns: tuple[str, ...], view: View, image_sha256: str) -> "StoredRow":
        """Collects the cells of a view."""
        return cls(
            tuple(view.numbers.get(name, math.nan) for name in columns if is_number(name)),
            tuple(view.cell(name) for name in columns if not is_number(name)),
            image_sha256,
        )

    def seal(self) -> str:
        """SHA-256 of the content."""
        numbers = struct.pack(f"<{len(self.numbers)}d", *self.numbers)
        return sha256(numbers + json.dumps([self.texts, self.image_sha256]).encode())


def log_header(stream: rr.RecordingStream, header: Header) -> None:
    """Logs what holds for all views: session.toml, the columns, the target and the robot."""
    components = {
        "format": pa.array([FORMAT], pa.int64()),
        "visioncal": pa.array([__version__], pa.string()),
        "rows": pa.array([header.rows], pa.int64()),
        "columns": pa.array(header.columns, pa.string()),
        "number_columns": pa.array(header.number_columns, pa.string()),
        "session_toml": pa.array([header.session_toml], pa.string()),
        "target_json": pa.array([header.target_json], pa.string()),
        "robot_json": pa.array([header.robot_json], pa.string()),
        "streams": pa.array(header.streams, pa.string()),
        "corners": pa.array([header.corners], pa.string()),
        "images": pa.array([header.images], pa.string()),
        "seal": pa.array([header.seal()], pa.string()),
    }
    stream.log(paths.SESSION, rr.DynamicArchetype(_HEADER, components=components), static=True)


def log_row(stream: rr.RecordingStream, row: StoredRow) -> None:
    """Logs one row of the session at the stream's current time."""
    components = {
        "numbers": pa.array(row.numbers, pa.float64()),
        "texts": pa.array(row.texts, pa.string()),
        "image_sha256": pa.array([row.image_sha256], pa.string()),
        "seal": pa.array([row.seal()], pa.string()),
    }
    stream.log(paths.ROWS, rr.DynamicArchetype(_ROW, components=components))


def log_image(stream: rr.RecordingStream, name: str, image: bytes | None) -> None:
    """Logs the bytes of an image's file at the stream's current time."""
    if image is None:
        # Without this, the viewer would go on to show the image of the view before.
        stream.log(paths.IMAGE, rr.Clear(recursive=False))
    else:
        media_type = _MEDIA_TYPES.get(PurePosixPath(name).suffix.lower())
        stream.log(paths.IMAGE, rr.EncodedImage(contents=image, media_type=media_type))


def fact_seal(table: Stream | CornerTable) -> str:
    """SHA-256 of what counts of a table."""
    return sha256(json.dumps(table.fact()).encode())


def log_samples(recording: rr.RecordingStream, name: str, samples: Stream) -> None:
    """Logs a stream of the session at the recording's current time."""
    components = {
        "name": pa.array([name], pa.string()),
        "columns": pa.array(samples.columns, pa.string()),
        "values": pa.array(samples.values.ravel(), pa.float64()),
    }
    recording.log(paths.STREAMS, rr.DynamicArchetype(_STREAM, components=components))


def log_corners(recording: rr.RecordingStream, corners: CornerTable) -> None:
    """Logs the corners that another detector found, of all views."""
    sigmas = np.zeros(0) if corners.sigmas_px is None else corners.sigmas_px
    components = {
        "views": pa.array(corners.views, pa.int64()),
        "points": pa.array(corners.points, pa.int64()),
        "px": pa.array(corners.px.ravel(), pa.float64()),
        "targets": pa.array(corners.targets, pa.string()),
        "sigmas_px": pa.array(sigmas, pa.float64()),
    }
    recording.log(paths.CORNERS, rr.DynamicArchetype(_CORNERS, components=components), static=True)


def log_end(stream: rr.RecordingStream, rows: int) -> None:
    """Logs that no row will follow."""
    components = {"rows": pa.array([rows], pa.int64())}
    stream.log(paths.END, rr.DynamicArchetype(_END, components=components), static=True)


def values_of(batch: pa.RecordBatch, archetype: str, place: int = 0) -> dict[str, Any]:
    """The components of an archetype that one row of a chunk has."""
    columns = [name for name in batch.schema.names if name.startswith(f"{archetype}:")]
    values = {name.removeprefix(f"{archetype}:"): batch.column(name)[place] for name in columns}
    return {name: value.as_py() for name, value in values.items() if value.is_valid}


def read_header(batch: pa.RecordBatch, path: Path) -> tuple[int, Header]:
    """Reads the format and what holds for all rows; `path` names the recording in messages.

    Raises:
        DataError: The format is newer than this version.
        ValueError: It was changed after it was written.
    """
    values = values_of(batch, _HEADER)
    (found,) = values["format"]
    if found > FORMAT:
        writer = values["visioncal"][0]
        raise DataError(
            f"{path} is a recording of format {found}, written by visioncal {writer}; this version "
            f"({__version__}) reads formats up to {FORMAT}.",
            culprits=[str(path)],
            next_step=f"Install visioncal {writer} or newer.",
        )
    header = Header(
        int(values["rows"][0]),
        tuple(values["columns"]),
        tuple(values.get("number_columns") or ()),
        values["session_toml"][0],
        values["target_json"][0],
        values["robot_json"][0],
        tuple(values.get("streams") or ()),
        (values.get("corners") or [""])[0],
        (values.get("images") or [""])[0],
    )
    if header.seal() != values["seal"][0]:
        raise ValueError("the session's declaration was changed or damaged after it was written")
    return found, header


def read_rows(batch: pa.RecordBatch) -> dict[int, StoredRow]:
    """Reads those rows whose seal holds, by their place in the session."""
    rows = {}
    for place, index in enumerate(places(batch)):
        stored = values_of(batch, _ROW, place)
        row = StoredRow(
            tuple(stored.get("numbers") or ()), tuple(stored["texts"]), stored["image_sha256"][0]
        )
        if row.seal() == stored["seal"][0]:
            rows[index] = row
    return rows


def read_samples(batch: pa.RecordBatch) -> dict[str, Stream]:
    """Reads streams by their names."""
    streams = {}
    for place in range(batch.num_rows):
        name, columns = (
            batch.column(f"{_STREAM}:{name}")[place].as_py() for name in ("name", "columns")
        )
        cells = batch.column(f"{_STREAM}:values")[place].values.to_numpy(zero_copy_only=False)
        values = np.array(cells, dtype=float).reshape(-1, len(columns))
        values.setflags(write=False)
        streams[name[0]] = Stream(tuple(columns), values)
    return streams


def read_corners(batch: pa.RecordBatch) -> CornerTable:
    """Reads the corners that another detector found."""
    found = values_of(batch, _CORNERS)
    names = ("views", "points", "px", "targets", "sigmas_px")
    views, points, px, targets, sigmas_px = (found.get(name) or () for name in names)
    return CornerTable(
        np.array(views, dtype=np.int64),
        np.array(points, dtype=np.int64),
        np.array(px, dtype=float).reshape(-1, 2),
        tuple(targets),
        np.array(sigmas_px, dtype=float) if sigmas_px else None,
    )


def image_places(batch: pa.RecordBatch) -> dict[int, int]:
    """Finds the rows of a chunk that hold images, by the place of their view in the session."""
    if _BLOB not in batch.schema.names:
        return {}
    blobs = batch.column(_BLOB)
    return {row: place for place, row in enumerate(places(batch)) if blobs[place].is_valid}


def image_at(batch: pa.RecordBatch, place: int) -> bytes:
    """Reads the bytes of the image in one row of a chunk."""
    blob = batch.column(_BLOB)[place].values[0]
    return bytes(blob.values.to_numpy().tobytes())


def read_end(batch: pa.RecordBatch) -> int:
    """Reads how many rows there are in all."""
    return int(batch.column(f"{_END}:rows")[0].as_py()[0])


def places(batch: pa.RecordBatch) -> list[int]:
    """The places in the session of the views that a chunk's rows belong to."""
    return list(batch.column(paths.TIMELINE).to_pylist())


def from_json(text: str) -> dict[str, Any] | None:
    """Reads a document that the session may lack."""
    return dict(json.loads(text)) if text else None


def _to_json(document: Mapping[str, Any] | None) -> str:
    return "" if document is None else json.dumps(document)
