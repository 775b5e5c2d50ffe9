"""Jobs of a batch, and a worker's calibration of one session."""

import json
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.files import natural, read_text, write_atomically
from visioncal.core.threads import one_blas_thread
from visioncal.core.version import __version__
from visioncal.interchange.outputs import CALIBRATION, RECORDING, REPORT, Written, write_outputs
from visioncal.results import Calibration
from visioncal.results.fleet import FleetRow, row_of
from visioncal.session import Session

ROW, PICTURE = "row.json", "picture.jpg"
_SESSION = "session.toml"


@dataclass(frozen=True)
class Options:
    """Options of a batch on which its results depend, as in `calibrate`."""

    level: str = "auto"
    need_mm: float | None = None
    need_deg: float | None = None
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """One session to be calibrated."""

    name: str  # Its name in the batch.
    session: Path
    folder: Path  # Absolute path for its result.
    options: Options


def jobs_of(sessions: Iterable[Path | str], out: Path, options: Options) -> list[Job]:
    """One job a session, in their natural order.

    Sessions are folders, recordings, folders of sessions, or globs.

    Returns:
        The jobs, named by their paths below the folder that all sessions share.

    Raises:
        DataError: There are no sessions, a glob finds none, or two would have one name.
    """
    by_argument = {str(session): [*_sessions_of(str(session))] for session in sessions}
    empty = [name for name, found in by_argument.items() if not found]
    paths = sorted(
        {path.absolute() for found in by_argument.values() for path in found},
        key=lambda value: [natural(Path(part)) for part in value.parts],
    )
    if empty or not paths:
        raise DataError(
            f"{', '.join(empty) or 'nothing'}: there is no session.",
            next_step="Name folders of sessions, .rrd recordings, or a glob in quotes.",
        )
    shared = Path(os.path.commonpath([path.parent for path in paths]))
    names = [path.relative_to(shared).with_suffix("").as_posix() for path in paths]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise DataError(
            f"two sessions are called {twice[0]}: a folder and a recording beside it.",
            culprits=twice,
            next_step="Leave one of them out.",
        )
    root = out.absolute()
    return [Job(name, path, root / name, options) for name, path in zip(names, paths, strict=True)]


def _sessions_of(given: str) -> Iterator[Path]:
    """Sessions of a path or glob; a path without a session is kept, so that its row says so."""
    first_glob = next(
        (at for at, part in enumerate(Path(given).parts) if set(part) & set("*?[")), None
    )
    if first_glob is None or Path(given).exists():
        yield from _sessions_in(Path(given))
    else:
        parts = Path(given).parts
        for found in Path(*parts[:first_glob]).glob(str(Path(*parts[first_glob:]))):
            # Other files beside sessions, such as truths and notes, are skipped.
            if found.is_dir() or found.suffix.lower() == ".rrd":
                yield from _sessions_in(found)


def _sessions_in(path: Path) -> Iterator[Path]:
    folders = []
    if path.is_dir() and not (path / _SESSION).exists():
        folders = [file.parent for file in path.rglob(_SESSION)]
    yield from folders or [path]


def work(job: Job) -> FleetRow:
    """Calibrates one session into its folder, on one thread.

    Returns:
        The row of its result, or of its error.
    """
    begin = time.perf_counter()
    try:
        with one_blas_thread():
            session = _session(job)
            calibration, written = _calibrated(job, session)
            row = row_of(job.name, str(job.session), calibration, __version__)
            has_report = job.folder / REPORT in written.files
            row = replace(
                row, has_picture=_draw(job.folder, session, calibration), has_report=has_report
            )
            # Written last: it marks the session as done.
            document = {**_made_by(job, session), "row": asdict(row)}
            write_atomically(job.folder / ROW, json.dumps(document, indent=1))
    except VisioncalError as error:
        row = failed_row(job, type(error).__name__, error.message, error.next_step)
    except Exception as error:  # noqa: BLE001 - a bug in one of a thousand ends no batch
        row = failed_row(job, type(error).__name__, str(error), "Report this with the session.")
    return replace(row, seconds=time.perf_counter() - begin)


def failed_row(job: Job, error: str, words: str, next_step: str) -> FleetRow:
    """The row of a session without a result: the error's class, its words, and what to do."""
    return FleetRow(
        name=job.name,
        session=str(job.session),
        state="failed",
        words=words,
        error=error,
        next_step=next_step,
    )


def kept_row(job: Job) -> FleetRow | None:
    """The row of an earlier run with the same inputs; None where there is none."""
    names = {field.name for field in fields(FleetRow)}
    try:
        document = json.loads(read_text(job.folder / ROW))
        made_by = _made_by(job, _session(job))
    except (VisioncalError, ValueError):
        return None
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


def _session(job: Job) -> Session:
    return Session.load(job.session).needing(job.options.need_mm, job.options.need_deg)


def _made_by(job: Job, session: Session) -> dict[str, object]:
    """What a result depends on."""
    return {
        "session_sha256": session.digest(),
        "visioncal": __version__,
        # The need is not part of the digest, which is of the recorded facts.
        "need": None if session.need is None else list(map(str, asdict(session.need).values())),
        "options": asdict(job.options) | {"without": list(job.options.without)},
    }


def _calibrated(job: Job, session: Session) -> tuple[Calibration, Written]:
    """Calibrates on one thread, and writes the outputs of `visioncal calibrate`."""
    # Imported late, since a finished batch needs none of it.
    from visioncal.calibration.pipeline import run
    from visioncal.calibration.stages.detect import ONE_OPENCV_THREAD

    with ONE_OPENCV_THREAD.held():
        pictures = RECORDING not in job.options.without
        result = run(session, level=job.options.level, threads=1, pictures=pictures)
    result = result.with_paths(job.session, job.folder)
    written = write_outputs(job.folder, session, result, without=job.options.without)
    return result.calibration, written


def _draw(folder: Path, session: Session, calibration: Calibration) -> bool:
    """Writes a small picture of the first view that was used; returns whether there is one."""
    from visioncal.present.report.thumbnails import small_picture

    used = {view.view for view in calibration.views if view.used}
    for view in session.views:
        if view.number in used and view.image and session.images.exists(view.image):
            picture = small_picture(session.images.read(view.image))
            if picture is not None:
                write_atomically(folder / PICTURE, picture)
            return picture is not None
    (folder / PICTURE).unlink(missing_ok=True)
    return False
