"""Lossless storage of a session and its results in a recording.

Each is one static JSON document with a SHA-256 seal that detects changes, which rerun does not;
arrays in it are the base64 of their bytes. Images are stored as the bytes of their files, at the
entity that shows them; their digests are in the session's record.
"""

import json
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from datetime import date, time
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import rerun as rr

from visioncal.core.documents.toml import parse_toml
from visioncal.core.errors import DataError
from visioncal.core.files import sha256
from visioncal.core.types import Corners, Rejection, Searched
from visioncal.core.version import __version__
from visioncal.present.recording import paths
from visioncal.results.evidence import ViewEvidence
from visioncal.session.corners import CornerTable
from visioncal.session.images import ImageStore
from visioncal.session.streams import Stream

# Only recordings of this format are read.
FORMAT = 7

# A record: texts, numbers and arrays by name.
Record: TypeAlias = Mapping[str, Any]

_BLOB = "EncodedImage:blob"
_RECORD = "visioncal.Session"


def log_record(stream: rr.RecordingStream, entity: str, record: Record) -> None:
    """Logs a record with its seal."""
    content = json.dumps(record, default=_packed)
    texts = {"format": str(FORMAT), "visioncal": __version__, "content": content}
    texts["seal"] = sha256(content.encode())
    components = {name: pa.array([text], pa.string()) for name, text in texts.items()}
    stream.log(entity, rr.DynamicArchetype(_RECORD, components=components), static=True)


def read_record(batch: pa.RecordBatch, path: Path) -> Record:
    """Reads the record of a chunk; `path` names the recording.

    Raises:
        DataError: The recording is of another format.
        ValueError: The record was changed after it was written.
    """
    version, writer_version = _text(batch, "format"), _text(batch, "visioncal") or "before 0.1"
    if version != str(FORMAT):
        raise DataError(
            f"{path} is a recording of format {version}, written by visioncal {writer_version}; "
            f"this version ({__version__}) reads format {FORMAT}.",
            culprits=[str(path)],
            next_step=f"Install visioncal {writer_version} or newer."
            if version.isdecimal() and int(version) > FORMAT
            else "Calibrate its session's folder again.",
        )
    content = _text(batch, "content")
    if _text(batch, "seal") != sha256(content.encode()):
        raise ValueError("a record was changed after it was written")
    return dict(json.loads(content, object_hook=_unpacked))


def _text(batch: pa.RecordBatch, name: str) -> str:
    """One text of a chunk's record; empty if it is not stored."""
    name = f"{_RECORD}:{name}"
    return str(batch.column(name)[0].values[0]) if name in batch.schema.names else ""


def _packed(value: np.ndarray | date | time) -> object:
    """An array as a table, and a date of a TOML file as text, which has the same digest."""
    if isinstance(value, date | time):
        return value.isoformat()
    content = b64encode(value.tobytes()).decode()
    return {"dtype": value.dtype.str, "shape": value.shape, "base64": content}


def _unpacked(table: dict[str, Any]) -> object:
    if table.keys() != {"dtype", "shape", "base64"}:
        return table
    return np.frombuffer(b64decode(table["base64"]), table["dtype"]).reshape(table["shape"])


def content_of(record: Record, images: ImageStore) -> tuple[dict[str, Any], dict[str, Stream]]:
    """Arguments of `Session.assemble`, and the streams, of the session of a record."""
    corners = None
    if record["corners"] is not None:
        views, points, px, targets, sigmas_px = record["corners"]
        corners = CornerTable(views, points, px, tuple(targets), sigmas_px)
    content = {
        "document": parse_toml(record["session_toml"], "session.toml"),
        "columns": record["columns"],
        "cells": record["cells"],
        "images": images,
        "target_document": record["target"],
        "robot_document": record["robot"],
        "corners": corners,
    }
    streams = record["streams"].items()
    return content, {name: Stream(tuple(names), values) for name, (names, values) in streams}


def image_names(record: Record) -> list[str]:
    """Names of the views' images; empty without one."""
    columns = record["columns"]
    at = columns.index("image") if "image" in columns else None
    return ["" if at is None else cells[at] for cells in record["cells"]]


def searches_of(record: Record) -> dict[tuple[str, str], Searched]:
    """Corners found in images, by their names and those of their boards."""
    return {
        (image, board): Searched(
            Rejection(0, found) if isinstance(found, str) else Corners(0, *found),
            size and (int(size[0]), int(size[1])),
            bool(misfit),
        )
        for image, board, size, misfit, found in record["searches"]
    }


def result_record(text: str, evidence: Sequence[ViewEvidence]) -> Record:
    """The record of a result: calibration.json, and the views' exact evidence in its order."""
    views = []
    for view in evidence:
        corners = None if view.corners is None else search_result(view.corners)
        poses = view.base_from_flange, view.cam_from_target, view.depth
        views.append((view.view, corners, view.predicted_px, *poses))
    return {"calibration": text, "views": views}


def evidence_of(record: Record) -> tuple[ViewEvidence, ...]:
    """The evidence of a result's record."""
    return tuple(
        ViewEvidence(view, None if corners is None else Corners(view, *corners), *arrays)
        for view, corners, *arrays in record["views"]
    )


def image_places(batch: pa.RecordBatch) -> dict[int, int]:
    """Positions of images in a chunk, by row number."""
    if _BLOB not in batch.schema.names:
        return {}
    blobs, rows = batch.column(_BLOB), batch.column(paths.TIMELINE).to_pylist()
    return {row: position for position, row in enumerate(rows) if blobs[position].is_valid}


def image_at(batch: pa.RecordBatch, position: int) -> bytes:
    """Reads the bytes of the image at one position of a chunk."""
    blob = batch.column(_BLOB)[position].values[0]
    return bytes(blob.values.to_numpy().tobytes())


def search_result(found: Corners | Rejection) -> object:
    """Fields of what was found in an image, or why nothing was."""
    if isinstance(found, Rejection):
        return found.reason
    return found.ids, found.px, found.blur_px, found.weights, None, found.drawn_m
