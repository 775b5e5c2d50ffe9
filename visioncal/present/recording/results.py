"""A session's results in its recording: as drawing, and exact.

A result is valid once its last message, the calibration's text, is there; the last of several
results holds.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pyarrow as pa
import rerun as rr

from visioncal.core.errors import DataError
from visioncal.core.files import sha256
from visioncal.core.types import Corners, FloatArray
from visioncal.present import result_parts
from visioncal.present.recording import codec, notes, overlays, paths
from visioncal.present.recording.reader import chunks
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.rrd_messages import MessageFrame, scan
from visioncal.present.recording.scene import SceneDrawing
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session

_EVIDENCE, _RESULT = "visioncal.Evidence", "visioncal.Result"


def log_results(
    recorder: Recorder,
    session: Session,
    calibration: Calibration | None,
    evidence: Sequence[ViewEvidence],
) -> None:
    """Logs results: their drawing, their exact values, then the message that validates them.

    Raises:
        DataError: The evidence names a view that the session does not have, or a section of the
            result cannot be read.
        OSError: The file cannot be written.
    """
    seen_of = {view.view: view for view in evidence}
    rows = {view.number: row for row, view in enumerate(session.views)}
    unknown = [f"view {number}" for number in sorted(seen_of.keys() - rows.keys())]
    if unknown:
        raise DataError(
            f"The evidence names {', '.join(unknown)}, which the session {session.name!r} does "
            "not have.",
            culprits=unknown,
        )
    _draw(recorder, session, calibration, seen_of)
    result = uuid4().hex
    for index, seen in enumerate(evidence):
        recorder.at(rows[seen.view])
        _log_evidence(recorder.stream, seen, result, index)
    # Rerun may reorder what it buffers, and the message that validates the result must be last.
    recorder.keep()
    text = "" if calibration is None else calibration.text
    components = {
        "result": pa.array([result], pa.string()),
        "evidence_count": pa.array([len(evidence)], pa.int64()),
        "seal": pa.array([sha256(text.encode())], pa.string()),
    }
    recorder.stream.log(
        paths.CALIBRATION,
        rr.TextDocument(text, media_type="application/json"),
        rr.DynamicArchetype(_RESULT, components=components),
        static=True,
    )
    recorder.keep()


def read_calibration(path: Path) -> Calibration | None:
    """Reads the result of a recording.

    Returns:
        The result added last; None if there is none.

    Raises:
        DataError: The file cannot be read, or the result is damaged.
    """
    text = _read_result(path).text
    if not text:
        return None
    return Calibration.from_json(text, str(path))


def read_evidence(path: Path) -> tuple[ViewEvidence, ...]:
    """Reads the evidence of the views, exactly as it was written.

    Returns:
        Evidence of the result added last, in its original order; empty if there is none.

    Raises:
        DataError: The file cannot be read, or the evidence is damaged.
    """
    result = _read_result(path)
    if len(result.evidence) != result.evidence_count:
        raise _damaged(path)
    return result.evidence


def _draw(
    recorder: Recorder,
    session: Session,
    calibration: Calibration | None,
    evidence: Mapping[int, ViewEvidence],
) -> None:
    stream, views = recorder.stream, dict(enumerate(session.views))
    scene = SceneDrawing.of(session, calibration, evidence)
    overlay = overlays.Overlay.of(session, calibration, evidence)
    scene.log_static(stream)
    if calibration is not None:
        notes.log_static(stream, calibration, result_parts.stated_boards(session))
    seen = [evidence.get(view.number, ViewEvidence(view.number)) for view in session.views]
    scene.log_views(stream, seen)
    overlay.log_views(stream, seen)
    if calibration is not None:
        rows = {view.number: row for row, view in views.items()}
        sights = {rows[view.view]: view for view in calibration.views if view.view in rows}
        unposed = {row: scene.unposed(view.number) for row, view in views.items()}
        notes.log_views(stream, sights, views, unposed)
        for name, arm in calibration.by_name.robots.items():
            drifts = () if arm.thermal is None else arm.thermal.views
            shown = {rows[drift.view]: drift for drift in drifts if drift.view in rows}
            for plot, attribute in ((paths.DRIFT_MM, "drift_mm"), (paths.RISE_K, "rise_k")):
                values = {row: float(getattr(drift, attribute)) for row, drift in shown.items()}
                notes.log_scalars(stream, paths.part_of(plot, name), values)
    recorder.keep()


def _log_evidence(stream: rr.RecordingStream, seen: ViewEvidence, result: str, index: int) -> None:
    """Logs a view's exact evidence; its drawing has single precision."""
    components = {
        "result": pa.array([result], pa.string()),
        "place": pa.array([index], pa.int64()),
        "view": pa.array([seen.view], pa.int64()),
    }
    if seen.corners is not None:
        components["corner_ids"] = pa.array(seen.corners.ids, pa.int64())
        components["corner_px"] = _exact(seen.corners.px)
        components["blur_px"] = _exact(seen.corners.blur_px)
    for name in ("predicted_px", "base_from_flange", "cam_from_target"):
        values = getattr(seen, name)
        if values is not None:
            components[name] = _exact(values)
    seal = _seal({name: values.to_pylist() for name, values in components.items()})
    components["seal"] = pa.array([seal], pa.string())
    stream.log(paths.EVIDENCE, rr.DynamicArchetype(_EVIDENCE, components=components))


def _exact(values: FloatArray | float) -> pa.Array:
    return pa.array(np.ravel(values), pa.float64())


def _seal(values: Mapping[str, list[Any]]) -> str:
    return sha256(json.dumps(values, sort_keys=True).encode())


@dataclass(frozen=True)
class _Result:
    """A stored result; its text is empty without a calibration."""

    text: str = ""
    evidence_count: int = 0
    evidence: tuple[ViewEvidence, ...] = ()


def _read_result(path: Path) -> _Result:
    """Reads the last result, with the intact part of its evidence."""
    latest: dict[str, Any] = {}
    evidence: dict[str, dict[int, ViewEvidence]] = {}
    damaged: list[MessageFrame] = []
    entities = (paths.CALIBRATION, paths.EVIDENCE)
    try:
        for _, entity, batch in chunks(scan(path), entities, damaged):
            for position in range(batch.num_rows):
                if entity == paths.EVIDENCE:
                    values = codec.values_of(batch, _EVIDENCE, position)
                    seen = _evidence(values)
                    evidence.setdefault(values["result"][0], {})[values["place"][0]] = seen
                else:
                    latest = codec.values_of(batch, _RESULT, position) | codec.values_of(
                        batch, "TextDocument", position
                    )
                    # Chunks damaged before this one hold no newer result.
                    damaged.clear()
        if damaged or (latest and sha256(latest["text"][0].encode()) != latest["seal"][0]):
            raise _damaged(path)
        if not latest:
            return _Result()
        (result,), (count,), (text,) = latest["result"], latest["evidence_count"], latest["text"]
    except (KeyError, ValueError, TypeError) as error:
        raise _damaged(path) from error
    own_evidence = evidence.get(result, {})
    return _Result(text, count, tuple(own_evidence[position] for position in sorted(own_evidence)))


def _evidence(values: Mapping[str, Any]) -> ViewEvidence:
    """Reads one view's evidence, after a check of its seal."""
    sealed = {name: entry for name, entry in values.items() if name != "seal"}
    if values["seal"] != [_seal(sealed)]:
        raise ValueError("the evidence was changed after it was written")

    def floats(name: str, *shape: int) -> FloatArray | None:
        return np.array(values[name], dtype=float).reshape(shape) if name in values else None

    (view,) = values["view"]
    px, corners = floats("corner_px", -1, 2), None
    if px is not None:
        ids = np.array(values["corner_ids"], dtype=np.int64)
        corners = Corners(view, ids, px, float(values["blur_px"][0]))
    return ViewEvidence(
        view,
        corners,
        floats("predicted_px", -1, 2),
        floats("base_from_flange", 4, 4),
        floats("cam_from_target", 4, 4),
    )


def _damaged(path: Path) -> DataError:
    return DataError(
        f"{path} is damaged: its last result was changed after it was written.",
        culprits=[str(path)],
        next_step="Calibrate the session in it again.",
    )
