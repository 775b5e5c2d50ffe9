"""Writes recordings of sessions and their results."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np
import rerun as rr
import tomli_w
from rerun.blueprint import BlueprintLike

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.core.files import replacing_file, sha256
from visioncal.core.types import Searched
from visioncal.present.recording import codec, notes, paths
from visioncal.present.recording.overlays import Overlay, log_image_frames
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.scene import Scene
from visioncal.present.recording.stored import RecordedImages
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, View
from visioncal.vision.boards.imaging import decode_image, faint_jpeg

_MEDIA_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".tif": "image/tiff",
    ".tiff": "image/tiff",
    ".bmp": "image/bmp",
    ".webp": "image/webp",
}


def write_recording(
    path: Path,
    session: Session,
    calibration: Calibration | None,
    evidence: Sequence[ViewEvidence],
    blueprint: BlueprintLike | None,
    images: ImagesKept = "full",
    searches: Mapping[int, Searched] | None = None,
) -> None:
    """Writes a session and its results as one recording.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        session: The session; `Session.load` returns it.
        calibration: Result of the session; None draws the cell as recorded.
        evidence: Evidence of the views, in any order.
        blueprint: Viewer layout, as by `viewer.blueprint`; None for the viewer's own.
        images: What is stored of the images beside their digests. They are stored whole where the
            session could not be calibrated again without them: unless all searched ones are in
            `searches`. Images beside depth are always.
        searches: What was found in each image, by view.

    Raises:
        DataError: The file cannot be written, an image of the session cannot be read, the evidence
            names a view that the session does not have, or a section of the result cannot be read.
    """
    seen_of = {view.view: view for view in evidence}
    unknown = seen_of.keys() - {view.number for view in session.views}
    if unknown:
        culprits = [f"view {number}" for number in sorted(unknown)]
        raise DataError(
            f"The evidence names {', '.join(culprits)}, which the session {session.name!r} does "
            "not have.",
            culprits=culprits,
        )
    rows = {view.number: row for row, view in enumerate(session.views)}
    seen = [seen_of.get(view, ViewEvidence(view)) for view in rows]
    with recording(path, session, blueprint, images, searches or {}) as recorder:
        stream, scene = recorder.stream, Scene.of(session, calibration, seen_of)
        scene.log_static(stream)
        scene.log_stops(stream)
        scene.log_views(stream, rows)
        overlay = Overlay.of(session, calibration, seen_of)
        overlay.log_views(stream, seen)
        if calibration is not None:
            if calibration.cell is not None:
                scene.log_network(stream, calibration)
                log_image_frames(stream, paths.IMAGE, overlay.frames)
            scene.log_seen_targets(stream, session, calibration, seen)
            notes.log_static(stream, calibration)
            shown = {rows[view.view]: view for view in calibration.views if view.view in rows}
            unposed = {row: scene.unposed(view) for view, row in rows.items()}
            notes.log_views(stream, shown, dict(enumerate(session.views)), unposed)
        text = "" if calibration is None else calibration.text
        codec.log_record(stream, paths.CALIBRATION, codec.result_record(text, evidence))


@contextmanager
def recording(
    path: Path,
    session: Session,
    blueprint: BlueprintLike | None,
    images: ImagesKept = "full",
    searches: Mapping[int, Searched] | None = None,
) -> Iterator[Recorder]:
    """Starts a recording with a session; see `write_recording`.

    Yields:
        The recorder, for what is drawn besides.

    Raises:
        DataError: The file cannot be written, or an image of the session cannot be read.
    """
    store, by_view = session.images, searches or {}
    searched = [view for view in session.views if view.image and not view.has_corners]
    found: dict[tuple[str, str], Searched] = {}
    for view in searched:
        key = view.image, session.board_of(view)
        search = by_view.get(view.number) or store.search_of(*key)
        if search is not None:
            found[key] = search
    if all(store.exists(view.image) for view in searched) and any(
        (view.image, session.board_of(view)) not in found for view in searched
    ):
        images = "full"
    elif isinstance(store, RecordedImages) and store.kept != "full":
        images = store.kept
    with replacing_file(path) as aside, Recorder(aside) as recorder:
        recorder.stream.send_recording_name(session.name)
        digests = []
        for row, view in enumerate(session.views):
            recorder.at(row)
            digests.append(_log_image(recorder.stream, session, view, images, found))
        stored = {} if images == "full" else found
        record = session_record(session, images, digests, stored)
        codec.log_record(recorder.stream, paths.SESSION, record)
        recorder.lay_out(blueprint)
        recorder.keep()
        yield recorder


def _log_image(
    stream: rr.RecordingStream,
    session: Session,
    view: View,
    images: ImagesKept,
    found: Mapping[tuple[str, str], Searched],
) -> str:
    """Logs what is kept of a view's image at the stream's current time; returns its SHA-256."""
    store, shown, name = session.images, None, view.image
    digest = store.sha256(name) if name else ""
    has_image = bool(name) and store.exists(name)
    if images == "full" and has_image:
        shown = store.read(name)
        digest = sha256(shown)
    elif images == "thumbnail" and name:
        search, name = found.get((name, session.board_of(view))), f"{name}.jpg"
        shown = (search and search.faint_jpeg) or store.shown(view.image)
        if shown is None and has_image:
            pixels = decode_image(store.read(view.image), colour=True)
            shown = None if isinstance(pixels, str) else faint_jpeg(pixels)
    if shown is None:
        # Otherwise the viewer would keep showing the previous view's image.
        stream.log(paths.IMAGE, rr.Clear(recursive=False))
    else:
        media_type = _MEDIA_TYPES.get(PurePosixPath(name).suffix.lower())
        stream.log(paths.IMAGE, rr.EncodedImage(contents=shown, media_type=media_type))
    return digest


def session_record(
    session: Session,
    kept: str,
    digests: Sequence[str],
    searches: Mapping[tuple[str, str], Searched],
) -> codec.Record:
    """The record of a session.

    Args:
        session: The session.
        kept: What is stored of its images, as `ImagesKept`.
        digests: SHA-256 of each view's image; empty without an image.
        searches: What was found in images, by their names and those of their boards.
    """
    corners, table = None, session.corner_table
    # Of some views alone, a table may have no rows.
    if table is not None:
        corners = table.views, table.points, table.px, table.targets, table.sigmas_px
    # Depth is compared where the image beside it is white, or black.
    with_depth = [view for view in session.views if view.depth]
    kept_whole = {
        path: None
        for view in with_depth
        for path in ((view.depth,) if kept == "full" else view.files)
    }
    return {
        "session_toml": tomli_w.dumps(session.document),
        "target": session.target_document,
        "robot": session.robot_document,
        "columns": session.columns,
        "cells": [[view.cell(column) for column in session.columns] for view in session.views],
        "images": kept,
        "digests": digests,
        "depths": {
            path: np.frombuffer(session.images.read(path), np.uint8)
            for path in kept_whole
            if session.images.exists(path)
        },
        "streams": {
            name: (samples.columns, samples.values) for name, samples in session.streams.items()
        },
        "corners": corners,
        "searches": [
            (*key, search.size, search.misfit, codec.search_result(search.found))
            for key, search in searches.items()
        ],
    }
