"""What a worker does with one session."""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path

from visioncal.calibration.pipeline import align, run
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.files import read_text, write_atomically
from visioncal.core.version import __version__
from visioncal.interchange.batch.jobs import Job
from visioncal.interchange.outputs import (
    CALIBRATION,
    REPORT,
    Written,
    write_alignment,
    write_outputs,
)
from visioncal.results import Calibration
from visioncal.results.fleet import FleetRow, row_of
from visioncal.session import Session
from visioncal.session.single import is_whole_cell

ROW, PICTURE = "row.json", "picture.jpg"


def work(job: Job) -> FleetRow:
    """Calibrates one session into its folder, unless that has its result already.

    Returns:
        What became of it: where something is wrong, why.
    """
    begin = time.perf_counter()
    try:
        row = _worked(job)
    except VisioncalError as error:
        row = _failed(job, type(error).__name__, error.message, error.next_step)
    except Exception as error:  # noqa: BLE001 - a bug in one of a thousand ends no batch
        row = _failed(job, type(error).__name__, str(error), "Report this with the session.")
    return replace(row, seconds=time.perf_counter() - begin)


def died(job: Job, tries: int) -> FleetRow:
    """The row of a session whose workers died of it."""
    words = f"its worker died {tries} times, without a word"
    return _failed(job, "WorkerDied", words, "It may need more memory: calibrate it by itself.")


def _failed(job: Job, error: str, words: str, next_step: str) -> FleetRow:
    return FleetRow(
        name=job.name,
        session=str(job.session),
        state="failed",
        words=words,
        error=error,
        next_step=next_step,
    )


def _worked(job: Job) -> FleetRow:
    session = Session.load(job.session).needing(job.options.need_mm, job.options.need_deg)
    made_by = {
        "session_sha256": session.digest(),
        "visioncal": __version__,
        # What the task needs is no fact of what was recorded.
        "need": None if session.need is None else list(map(str, asdict(session.need).values())),
        "options": asdict(job.options) | {"without": list(job.options.without)},
    }
    kept = _kept(job, made_by)
    if kept is not None:
        return kept
    found, written = _calibrated(job, session)
    row = row_of(job.name, str(job.session), found, __version__)
    has_report = job.folder / REPORT in written.files
    row = replace(row, has_picture=_draw(job.folder, session, found), has_report=has_report)
    # What counts as done comes last.
    write_atomically(job.folder / ROW, json.dumps({**made_by, "row": asdict(row)}, indent=1))
    return row


def _kept(job: Job, made_by: Mapping[str, object]) -> FleetRow | None:
    """The row of an earlier run that made the same; None where there is none."""
    try:
        document = json.loads(read_text(job.folder / ROW))
    except (DataError, ValueError):
        return None
    names = {it.name for it in fields(FleetRow)}
    if (
        not isinstance(document, dict)
        or {key: document.get(key) for key in made_by} != made_by
        or set(document.get("row", ())) != names
        or not (job.folder / CALIBRATION).exists()
    ):
        return None
    return replace(
        FleetRow(**document["row"]), name=job.name, session=str(job.session), state="kept"
    )


def _calibrated(job: Job, session: Session) -> tuple[Calibration, Written]:
    """Calibrates on one thread, as `visioncal calibrate` does, and writes what it writes."""
    options = job.options
    if is_whole_cell(session):
        cell = align(session, level=options.level, threads=1)
        cell = replace(cell, verdict=cell.verdict.with_paths(job.session, job.folder))
        written = write_alignment(job.folder, session, cell, without=options.without)
        return Calibration.whole(cell), written
    done = run(session, level=options.level, threads=1).with_paths(job.session, job.folder)
    return done.calibration, write_outputs(job.folder, session, done, without=options.without)


def _draw(folder: Path, session: Session, found: Calibration) -> bool:
    """Writes a small picture of the first view that was used; returns whether there is one."""
    from visioncal.present.report.thumbnails import small_picture

    used = {it.view for it in found.views if it.used}
    for view in session.views:
        if view.number in used and view.image and session.images.exists(view.image):
            picture = small_picture(session.images.read(view.image))
            if picture is not None:
                write_atomically(folder / PICTURE, picture)
            return picture is not None
    (folder / PICTURE).unlink(missing_ok=True)
    return False
