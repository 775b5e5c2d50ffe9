"""Writes a recording: the facts of a session, and what was computed from them."""

import json
import os
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.blueprint import BlueprintLike
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from visioncal.calibration import Calibration, to_document
from visioncal.errors import DataError
from visioncal.evidence import ViewEvidence
from visioncal.recording import codec, notes, overlays, paths
from visioncal.recording.scene import Scene
from visioncal.session import Session

_EVIDENCE = "visioncal.Evidence"
# Room for one more view, however large its image, and for the end of the file.
_ROOM_BYTES = 100_000_000


def write_recording(
    path: Path,
    session: Session,
    calibration: Calibration | None,
    evidence: Sequence[ViewEvidence],
    blueprint: BlueprintLike | None,
) -> None:
    """Writes a session and its results as one recording.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        session: What was recorded; `read_session` gives it back.
        calibration: Its result, if there is one.
        evidence: What was seen and computed of the views, in any order.
        blueprint: The layout to open it in, as `visioncal.viewer.blueprint` makes it; the viewer
            makes its own where None.

    Raises:
        DataError: The file cannot be written, or an image of the session cannot be read.
    """
    with _whole_or_absent(path) as aside:
        stream = rr.RecordingStream(paths.APPLICATION)
        _open(stream, aside, blueprint)
        try:
            stream.send_recording_name(session.name)
            _log_all(stream, session, calibration, {it.view: it for it in evidence}, path.parent)
        finally:
            # Writes the footer, which comes last.
            stream.disconnect()
        _check_finished(aside)


def _open(stream: rr.RecordingStream, path: Path, blueprint: BlueprintLike | None) -> None:
    try:
        stream.save(path, default_blueprint=blueprint)
    except RuntimeError as error:
        # This is how rerun reports a file that it cannot create.
        raise OSError(str(error)) from error


def _check_room(folder: Path) -> None:
    """Stops in time: on a full disk, rerun's own thread dies and whoever waits for it hangs."""
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < _ROOM_BYTES:
        raise OSError(f"{free_bytes / 1e6:.0f} MB are free, {_ROOM_BYTES / 1e6:.0f} are needed")


def _check_finished(path: Path) -> None:
    """Rerun only prints that it could not write; a file that lacks its footer is not whole."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RerunWarning)
            RrdReader(path).store()
    except (RuntimeError, ValueError) as error:
        raise OSError("its end is missing; the disk may be full") from error


def _log_all(
    stream: rr.RecordingStream,
    session: Session,
    calibration: Calibration | None,
    evidence: dict[int, ViewEvidence],
    folder: Path,
) -> None:
    codec.log_header(stream, session)
    scene = Scene.of(session, calibration, evidence)
    overlay = overlays.Overlay.of(session, calibration, evidence)
    scene.log_static(stream)
    if calibration is not None:
        _log_calibration(stream, calibration)
        notes.log_static(stream, calibration)
    results = {} if calibration is None else {it.view: it for it in calibration.views}
    for index, view in enumerate(session.views):
        _check_room(folder)
        stream.set_time(paths.TIMELINE, sequence=index)
        seen = evidence.get(view.number, ViewEvidence(view.number))
        codec.log_row(stream, session, view)
        _log_evidence(stream, seen)
        scene.log_view(stream, view, seen)
        overlay.log_view(stream, seen)
        if view.number in results:
            notes.log_view(stream, results[view.number])
        # Keeps one view in memory rather than all, and the room that is left up to date.
        stream.flush()


def _log_calibration(stream: rr.RecordingStream, calibration: Calibration) -> None:
    text = json.dumps(to_document(calibration), indent=2)
    document = rr.TextDocument(text, media_type="application/json")
    stream.log(paths.CALIBRATION, document, static=True)


def _log_evidence(stream: rr.RecordingStream, seen: ViewEvidence) -> None:
    """Keeps what was computed of a view exactly; what is drawn has single precision."""
    components: dict[str, pa.Array] = {}
    if seen.corners is not None:
        components["corner_ids"] = pa.array(seen.corners.ids, pa.int64())
        components["corner_px"] = _exact(seen.corners.px)
        components["blur_px"] = _exact(seen.corners.blur_px)
    for name in ("predicted_px", "base_from_flange", "cam_from_target"):
        values = getattr(seen, name)
        if values is not None:
            components[name] = _exact(values)
    if components:
        stream.log(paths.EVIDENCE, rr.DynamicArchetype(_EVIDENCE, components=components))


def _exact(values: Any) -> pa.Array:  # noqa: ANN401 - a number or an array
    return pa.array(np.ravel(values), pa.float64())


@contextmanager
def _whole_or_absent(path: Path) -> Iterator[Path]:
    """Gives a name beside `path` to write to; what was written takes the place of `path`."""
    aside = path.parent / f".{uuid4().hex}.tmp"
    try:
        try:
            yield aside
            with aside.open("rb") as file:
                os.fsync(file.fileno())
            aside.replace(path)
        finally:
            with suppress(OSError):
                aside.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(
            f"{path} cannot be written: {error}.",
            culprits=[str(path)],
            next_step="Choose a folder that exists, can be written, and has room.",
        ) from error
