"""Lossless storage of a session's data in a recording.

One static entity holds session.toml, the target and the robot. Each view is one row, with its
numbers as float64. Images are stored as the bytes of their files, at the entity that shows them.
Rerun itself detects no damage, so each record carries a SHA-256 seal of its content.
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
from visioncal.core.types import Corners, Rejection, Searched
from visioncal.core.version import __version__
from visioncal.present.recording import paths
from visioncal.session import Session, Stream, View
from visioncal.session.columns import is_number
from visioncal.session.corners import CornerTable

# Only recordings of this format are read.
FORMAT = 5
# Stands for a number of views that was not known at the start.
UNKNOWN = -1

_BLOB = "EncodedImage:blob"
_HEADER, _ROW, _END = "visioncal.Session", "visioncal.Row", "visioncal.End"
_STREAM, _CORNERS, _SEARCHES = "visioncal.Stream", "visioncal.Corners", "visioncal.Searches"
_NONE = np.zeros(0, dtype=np.int64)
_MEDIA_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".tif": "image/tiff",
    ".tiff": "image/tiff",
    ".bmp": "image/bmp",
    ".webp": "image/webp",
}


@dataclass(frozen=True)
class Header:
    """Data that holds for all rows; an empty text stands for a document that the session lacks."""

    rows: int  # Announced number of rows; UNKNOWN if it was not known.
    columns: tuple[str, ...]  # Columns of views.csv.
    number_columns: tuple[str, ...]  # Those of them that are stored as numbers.
    session_toml: str  # Content of session.toml.
    target_json: str  # Content of the target's file.
    robot_json: str  # The robot's model.
    streams: tuple[str, ...] = ()  # Names of the streams, followed by their seals.
    corners: str = ""  # Seal of the external detector's corners; empty if there are none.
    # What is stored of the images: empty for all, `thumbnail`, or `none`; their digests are in the
    # rows in any case.
    images: str = ""

    @classmethod
    def of(cls, session: Session, announced: int, images: str = "") -> "Header":
        """The header of a session."""
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
        # Without the last fields, where they are empty.
        while not content[-1] and len(content) > len(vars(self)) - 3:
            content.pop()
        return sha256(json.dumps(content).encode())

    @property
    def stream_seals(self) -> dict[str, str]:
        """Seals of the streams by name."""
        count = len(self.streams) // 2
        return dict(zip(self.streams[:count], self.streams[count:], strict=True))

    def cells(self, row: "StoredRow") -> list[str]:
        """A row as texts in the order of the columns, as by `View.cell`."""
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
    """A row as stored: NaN and empty text stand for empty cells."""

    numbers: tuple[float, ...]  # Cells of the number columns.
    texts: tuple[str, ...]  # Cells of the other columns.
    image_sha256: str  # Digest of the image's bytes; empty without an image.

    @classmethod
    def of(cls, columns: tuple[str, ...], view: View, image_sha256: str) -> "StoredRow":
        """The stored row of a view."""
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
    """Logs session.toml, the columns, the target and the robot."""
    stored = {"format": FORMAT, "visioncal": __version__, **vars(header), "seal": header.seal()}
    components = {
        name: pa.array(
            value if isinstance(value, tuple) else [value],
            pa.int64() if isinstance(value, int) else pa.string(),
        )
        for name, value in stored.items()
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
        # Otherwise the viewer would keep showing the previous view's image.
        stream.log(paths.IMAGE, rr.Clear(recursive=False))
    else:
        media_type = _MEDIA_TYPES.get(PurePosixPath(name).suffix.lower())
        stream.log(paths.IMAGE, rr.EncodedImage(contents=image, media_type=media_type))


def fact_seal(table: Stream | CornerTable) -> str:
    """SHA-256 of a table's content."""
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
    """Logs the corners of all views that an external detector found."""
    sigmas = np.zeros(0) if corners.sigmas_px is None else corners.sigmas_px
    components = {
        "views": pa.array(corners.views, pa.int64()),
        "points": pa.array(corners.points, pa.int64()),
        "px": pa.array(corners.px.ravel(), pa.float64()),
        "targets": pa.array(corners.targets, pa.string()),
        "sigmas_px": pa.array(sigmas, pa.float64()),
    }
    recording.log(paths.CORNERS, rr.DynamicArchetype(_CORNERS, components=components), static=True)


def log_searches(
    recording: rr.RecordingStream, searches: Mapping[tuple[str, str], Searched]
) -> None:
    """Logs what was found in images, by their names and those of their boards."""
    found = [search.found for search in searches.values()]
    seen = [corners for corners in found if isinstance(corners, Corners)]
    sizes = [(0, 0) if search.size is None else search.size for search in searches.values()]
    weights = [np.zeros(0) if corners.weights is None else corners.weights for corners in seen]
    components = {
        "images": pa.array([image for image, _ in searches], pa.string()),
        "boards": pa.array([board for _, board in searches], pa.string()),
        # Empty where corners were found.
        "reasons": pa.array([getattr(entry, "reason", "") for entry in found], pa.string()),
        "sizes": pa.array(np.ravel(sizes), pa.int64()),
        "misfits": pa.array([int(search.misfit) for search in searches.values()], pa.int64()),
        "counts": pa.array([len(corners.ids) for corners in seen], pa.int64()),
        "ids": pa.array(np.concatenate([_NONE, *(at.ids for at in seen)]), pa.int64()),
        "px": pa.array(np.concatenate([_NONE, *(at.px.ravel() for at in seen)]), pa.float64()),
        "blur_px": pa.array([corners.blur_px for corners in seen], pa.float64()),
        "weighted": pa.array([len(values) for values in weights], pa.int64()),
        "weights": pa.array(np.concatenate([_NONE, *weights]), pa.float64()),
    }
    seal = sha256(json.dumps([values.to_pylist() for values in components.values()]).encode())
    components["seal"] = pa.array([seal], pa.string())
    archetype = rr.DynamicArchetype(_SEARCHES, components=components)
    recording.log(paths.SEARCHES, archetype, static=True)


def read_searches(batch: pa.RecordBatch) -> dict[tuple[str, str], Searched]:
    """Reads what was found in images, by their names and those of their boards.

    Raises:
        ValueError: It was changed after it was written.
    """
    names = ("images", "boards", "reasons", "sizes", "misfits", "counts", "ids", "px", "blur_px")
    stored = values_of(batch, _SEARCHES)
    columns = [stored.get(name) or [] for name in (*names, "weighted", "weights")]
    if sha256(json.dumps(columns).encode()) != stored["seal"][0]:
        raise ValueError("what was found in images was changed after it was written")
    images, boards, reasons, sizes, misfits, counts, ids, px, blur_px, weighted, weights = columns
    ends, weight_ends = np.cumsum(counts)[:-1], np.cumsum(weighted)[:-1]
    corners = zip(
        np.split(np.array(ids, dtype=np.int64), ends),
        np.split(np.array(px, dtype=float).reshape(-1, 2), ends),
        blur_px,
        np.split(np.array(weights, dtype=float), weight_ends),
        strict=False,
    )
    found: dict[tuple[str, str], Searched] = {}
    for at, reason in enumerate(reasons):
        entry: Corners | Rejection = Rejection(0, reason)
        if not reason:
            own_ids, own_px, blur, own_weights = next(corners)
            entry = Corners(0, own_ids, own_px, blur, own_weights if len(own_weights) else None)
        width, height = sizes[2 * at : 2 * at + 2]
        size = (width, height) if width else None
        found[images[at], boards[at]] = Searched(entry, size, bool(misfits[at]))
    return found


def log_end(stream: rr.RecordingStream, rows: int) -> None:
    """Logs the end mark: no further row will follow."""
    components = {"rows": pa.array([rows], pa.int64())}
    stream.log(paths.END, rr.DynamicArchetype(_END, components=components), static=True)


def values_of(batch: pa.RecordBatch, archetype: str, position: int = 0) -> dict[str, Any]:
    """Components of an archetype in one row of a chunk."""
    columns = [name for name in batch.schema.names if name.startswith(f"{archetype}:")]
    values = {name.removeprefix(f"{archetype}:"): batch.column(name)[position] for name in columns}
    return {name: value.as_py() for name, value in values.items() if value.is_valid}


def read_header(batch: pa.RecordBatch, path: Path) -> Header:
    """Reads the header; `path` names the recording in messages.

    Raises:
        DataError: The recording is of another format.
        ValueError: The header was changed after it was written.
    """
    values = values_of(batch, _HEADER)
    (version,) = values["format"]
    if version != FORMAT:
        writer_version = values.get("visioncal", ["before 0.1"])[0]
        raise DataError(
            f"{path} is a recording of format {version}, written by visioncal {writer_version}; "
            f"this version ({__version__}) reads format {FORMAT}.",
            culprits=[str(path)],
            next_step=f"Install visioncal {writer_version} or newer."
            if version > FORMAT
            else "Calibrate its session's folder again.",
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
    return header


def read_rows(batch: pa.RecordBatch) -> dict[int, StoredRow]:
    """Reads the rows whose seal is intact, by row number."""
    rows = {}
    for position, index in enumerate(places(batch)):
        stored = values_of(batch, _ROW, position)
        row = StoredRow(
            tuple(stored.get("numbers") or ()), tuple(stored["texts"]), stored["image_sha256"][0]
        )
        if row.seal() == stored["seal"][0]:
            rows[index] = row
    return rows


def read_samples(batch: pa.RecordBatch) -> dict[str, Stream]:
    """Reads streams by name."""
    streams = {}
    for position in range(batch.num_rows):
        name, columns = (
            batch.column(f"{_STREAM}:{name}")[position].as_py() for name in ("name", "columns")
        )
        cells = batch.column(f"{_STREAM}:values")[position].values.to_numpy(zero_copy_only=False)
        values = np.array(cells, dtype=float).reshape(-1, len(columns))
        values.setflags(write=False)
        streams[name[0]] = Stream(tuple(columns), values)
    return streams


def read_corners(batch: pa.RecordBatch) -> CornerTable:
    """Reads the corners that an external detector found."""
    components = values_of(batch, _CORNERS)
    names = ("views", "points", "px", "targets", "sigmas_px")
    views, points, px, targets, sigmas_px = (components.get(name) or () for name in names)
    return CornerTable(
        np.array(views, dtype=np.int64),
        np.array(points, dtype=np.int64),
        np.array(px, dtype=float).reshape(-1, 2),
        tuple(targets),
        np.array(sigmas_px, dtype=float) if sigmas_px else None,
    )


def image_places(batch: pa.RecordBatch) -> dict[int, int]:
    """Positions of images in a chunk, by row number."""
    if _BLOB not in batch.schema.names:
        return {}
    blobs = batch.column(_BLOB)
    return {row: position for position, row in enumerate(places(batch)) if blobs[position].is_valid}


def image_at(batch: pa.RecordBatch, position: int) -> bytes:
    """Reads the bytes of the image at one position of a chunk."""
    blob = batch.column(_BLOB)[position].values[0]
    return bytes(blob.values.to_numpy().tobytes())


def read_end(batch: pa.RecordBatch) -> int:
    """Reads the total number of rows."""
    return int(batch.column(f"{_END}:rows")[0].as_py()[0])


def places(batch: pa.RecordBatch) -> list[int]:
    """Row numbers, in the session, of a chunk's rows."""
    return list(batch.column(paths.TIMELINE).to_pylist())


def from_json(text: str) -> dict[str, Any] | None:
    """Reads a document; None for empty text."""
    return dict(json.loads(text)) if text else None


def _to_json(document: Mapping[str, Any] | None) -> str:
    return "" if document is None else json.dumps(document)
