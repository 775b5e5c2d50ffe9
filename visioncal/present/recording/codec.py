"""Lossless storage of a session and its results in a recording.

Each is one static record of named one-dimensional arrays, whose SHA-256 seal detects changes, which
rerun does not. Images are stored as the bytes of their files, at the entity that shows them; their
digests are in the session's record.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.files import parse_toml, sha256
from visioncal.core.types import Corners, FloatArray, IntArray, Rejection, Searched
from visioncal.core.version import __version__
from visioncal.present.recording import paths
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, Stream
from visioncal.session.corners import CornerTable
from visioncal.session.images import ImageStore

# Only recordings of this format are read.
FORMAT = 6

_BLOB = "EncodedImage:blob"
_RECORD = "visioncal.Session"
_MISSING = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Record:
    """One-dimensional arrays of numbers or texts by name; an empty one is not stored."""

    values: Mapping[str, pa.Array]

    @classmethod
    def of(cls, **values: str | Sequence[str] | Sequence[FloatArray | IntArray]) -> "Record":
        """A record of texts, and of sequences of arrays, which are stored flat and by size."""
        stored: dict[str, pa.Array] = {}
        for name, value in values.items():
            if isinstance(value, str) or all(isinstance(part, str) for part in value):
                stored[name] = pa.array([value] if isinstance(value, str) else value, pa.string())
                continue
            parts = [np.ravel(part) for part in value]
            stored[name] = pa.array(np.concatenate(parts))
            stored[f"{name}_sizes"] = pa.array([len(part) for part in parts], pa.int64())
        return cls({name: array for name, array in stored.items() if len(array)})

    def log(self, stream: rr.RecordingStream, entity: str) -> None:
        """Logs the record with its seal."""
        components = {**self.values, "seal": pa.array([self._seal()], pa.string())}
        stream.log(entity, rr.DynamicArchetype(_RECORD, components=components), static=True)

    @classmethod
    def read(cls, batch: pa.RecordBatch) -> "Record":
        """Reads the record of a chunk.

        Raises:
            ValueError: It was changed after it was written.
        """
        prefix = f"{_RECORD}:"
        columns = [name for name in batch.schema.names if name.startswith(prefix)]
        stored = {name.removeprefix(prefix): batch.column(name)[0] for name in columns}
        values = {name: value.values for name, value in stored.items() if value.is_valid}
        record, seal = cls(values), values.pop("seal").to_pylist()
        if record.text("format") == str(FORMAT) and seal != [record._seal()]:
            raise ValueError("a record was changed after it was written")
        return record

    def _seal(self) -> str:
        """SHA-256 of the content."""
        content = [
            (name, array.to_pylist() if pa.types.is_string(array.type) else _digest(array))
            for name, array in sorted(self.values.items())
        ]
        return sha256(json.dumps(content).encode())

    def texts(self, name: str) -> list[str]:
        """A sequence of texts."""
        return list(map(str, self.values[name].to_pylist())) if name in self.values else []

    def text(self, name: str) -> str:
        """One text; empty if it is not stored."""
        return next(iter(self.texts(name)), "")

    def parts(self, name: str) -> list[np.ndarray]:
        """A sequence of flat arrays."""
        sizes = self._numbers(f"{name}_sizes").astype(np.int64)
        return np.split(self._numbers(name), np.cumsum(sizes)[:-1]) if len(sizes) else []

    def _numbers(self, name: str) -> np.ndarray:
        stored = self.values.get(name)
        return _MISSING if stored is None else stored.to_numpy(zero_copy_only=False)


def _digest(array: pa.Array) -> str:
    return sha256(array.to_numpy(zero_copy_only=False).tobytes())


def session_record(
    session: Session,
    kept: str,
    digests: Sequence[str],
    searches: Mapping[tuple[str, str], Searched],
) -> Record:
    """The record of a session.

    Args:
        session: The session.
        kept: What is stored of its images, as `ImagesKept`.
        digests: SHA-256 of each view's image; empty without an image.
        searches: What was found in images, by their names and those of their boards.
    """
    corners, streams = session.corner_table, session.streams.values()
    tables: list[FloatArray | IntArray] = []
    if corners is not None:
        sigmas = _MISSING if corners.sigmas_px is None else corners.sigmas_px
        tables = [corners.views, corners.points, corners.px, sigmas]
    found = [search.found for search in searches.values()]
    seen = [
        entry if isinstance(entry, Corners) else Corners(0, np.zeros(0, int), np.zeros((0, 2)), 0.0)
        for entry in found
    ]
    return Record.of(
        format=str(FORMAT),
        visioncal=__version__,
        session_toml=tomli_w.dumps(session.document),
        target_json=_to_json(session.target_document),
        robot_json=_to_json(session.robot_document),
        columns=session.columns,
        cells=[view.cell(column) for view in session.views for column in session.columns],
        images=kept,
        digests=digests,
        streams=[*session.streams],
        stream_columns=[json.dumps(samples.columns) for samples in streams],
        stream_values=[samples.values for samples in streams],
        corners=tables,
        corner_targets=() if corners is None else corners.targets,
        search_images=[image for image, _ in searches],
        search_boards=[board for _, board in searches],
        # Empty where corners were found.
        search_reasons=[getattr(entry, "reason", "") for entry in found],
        search_facts=[
            np.array([*(search.size or (0, 0)), search.misfit, corners.blur_px], dtype=float)
            for search, corners in zip(searches.values(), seen, strict=True)
        ],
        search_ids=[corners.ids for corners in seen],
        search_px=[corners.px for corners in seen],
        search_weights=[
            _MISSING if corners.weights is None else corners.weights for corners in seen
        ],
    )


def session_of(record: Record, images: ImageStore) -> Session:
    """The session of a record."""
    columns, cells = record.texts("columns"), record.texts("cells")
    corners = None
    if tables := record.parts("corners"):
        views, points, px, sigmas_px = tables
        corners = CornerTable(
            views.astype(np.int64),
            points.astype(np.int64),
            px.reshape(-1, 2),
            tuple(record.texts("corner_targets")),
            sigmas_px if len(sigmas_px) else None,
        )
    streams = {}
    for name, names, values in zip(
        record.texts("streams"),
        map(json.loads, record.texts("stream_columns")),
        record.parts("stream_values"),
        strict=True,
    ):
        samples = values.reshape(-1, len(names))
        samples.setflags(write=False)
        streams[name] = Stream(tuple(names), samples)
    return Session.assemble(
        parse_toml(record.text("session_toml"), "session.toml"),
        columns,
        [cells[start : start + len(columns)] for start in range(0, len(cells), len(columns))],
        images,
        target_document=_from_json(record.text("target_json")),
        robot_document=_from_json(record.text("robot_json")),
        corners=corners,
    ).with_streams(streams)


def image_names(record: Record) -> list[str]:
    """Names of the views' images; empty without one."""
    columns, cells = record.texts("columns"), record.texts("cells")
    if "image" not in columns:
        return [""] * len(record.texts("digests"))
    return cells[columns.index("image") :: len(columns)]


def searches_of(record: Record) -> dict[tuple[str, str], Searched]:
    """What was found in images, by their names and those of their boards."""
    found: dict[tuple[str, str], Searched] = {}
    for image, board, reason, facts, ids, px, weights in zip(
        record.texts("search_images"),
        record.texts("search_boards"),
        record.texts("search_reasons"),
        record.parts("search_facts"),
        record.parts("search_ids"),
        record.parts("search_px"),
        record.parts("search_weights"),
        strict=True,
    ):
        width, height, misfit, blur_px = facts.tolist()
        entry: Corners | Rejection = Rejection(0, reason)
        if not reason:
            own_weights = weights if len(weights) else None
            entry = Corners(0, ids.astype(np.int64), px.reshape(-1, 2), blur_px, own_weights)
        size = (int(width), int(height)) if width else None
        found[image, board] = Searched(entry, size, bool(misfit))
    return found


def result_record(text: str, evidence: Sequence[ViewEvidence]) -> Record:
    """The record of a result: calibration.json, and the views' exact evidence in its order."""
    seen = [view.corners for view in evidence]
    return Record.of(
        format=str(FORMAT),
        calibration=text,
        # Without corners, their blur is not a number.
        views=[
            np.array([view.view, np.nan if view.corners is None else view.corners.blur_px])
            for view in evidence
        ],
        corner_ids=[np.zeros(0, int) if corners is None else corners.ids for corners in seen],
        corner_px=[_MISSING if corners is None else corners.px for corners in seen],
        **{
            name: [
                _MISSING if (values := getattr(view, name)) is None else values for view in evidence
            ]
            for name in ("predicted_px", "base_from_flange", "cam_from_target")
        },
    )


def evidence_of(record: Record) -> tuple[ViewEvidence, ...]:
    """The evidence of a result's record."""
    evidence = []
    for (view, blur_px), ids, px, predicted_px, flange, target in zip(
        record.parts("views"),
        record.parts("corner_ids"),
        record.parts("corner_px"),
        record.parts("predicted_px"),
        record.parts("base_from_flange"),
        record.parts("cam_from_target"),
        strict=True,
    ):
        corners = None
        if not np.isnan(blur_px):
            corners = Corners(int(view), ids.astype(int), px.reshape(-1, 2), float(blur_px))
        evidence.append(
            ViewEvidence(
                int(view),
                corners,
                predicted_px.reshape(-1, 2) if len(predicted_px) else None,
                flange.reshape(4, 4) if len(flange) else None,
                target.reshape(4, 4) if len(target) else None,
            )
        )
    return tuple(evidence)


def check_format(record: Record, path: Path) -> None:
    """Refuses a record of another format; `path` names the recording.

    Raises:
        DataError: The recording is of another format.
    """
    version = record.text("format")
    if version != str(FORMAT):
        writer_version = record.text("visioncal") or "before 0.1"
        raise DataError(
            f"{path} is a recording of format {version}, written by visioncal {writer_version}; "
            f"this version ({__version__}) reads format {FORMAT}.",
            culprits=[str(path)],
            next_step=f"Install visioncal {writer_version} or newer."
            if version.isdecimal() and int(version) > FORMAT
            else "Calibrate its session's folder again.",
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


def _from_json(text: str) -> dict[str, Any] | None:
    """Reads a document; None for empty text."""
    return dict(json.loads(text)) if text else None


def _to_json(document: Mapping[str, Any] | None) -> str:
    return "" if document is None else json.dumps(document)
