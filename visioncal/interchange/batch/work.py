"""What a batch is to do, and what a worker does with one session."""

import json
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from visioncal.calibration.pipeline import run
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.files import natural, read_text, write_atomically
from visioncal.core.version import __version__
from visioncal.interchange.outputs import CALIBRATION, REPORT, Written, write_outputs
from visioncal.results import Calibration
from visioncal.results.fleet import FleetRow, row_of
from visioncal.session import Session

ROW, PICTURE = "row.json", "picture.jpg"
_SESSION = "session.toml"


@dataclass(frozen=True)
class Options:
    """What the results of a batch depend on, beside the sessions.

    Attributes:
        level: As in `calibrate`.
        need_mm: Likewise.
        need_deg: Likewise.
        without: The files that are not drawn.
    """

    level: str = "auto"
    need_mm: float | None = None
    need_deg: float | None = None
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """One session to be calibrated.

    Attributes:
        name: Its name in the batch.
        session: Its absolute path.
        folder: Where its result goes, likewise.
        options: How it is calibrated.
    """

    name: str
    session: Path
    folder: Path
    options: Options


def jobs_of(sessions: Iterable[Path | str], out: Path, options: Options) -> list[Job]:
    """One job a session, in their natural order.

    Args:
        sessions: Folders of sessions, recordings, folders that have some below them, or globs.
        out: Where the results go.
        options: How they are calibrated.

    Returns:
        The jobs. Names are paths below the folder that all sessions share.

    Raises:
        DataError: There are no sessions, a glob finds none, or two would have one name.
    """
    given = {str(session): [*_named(str(session))] for session in sessions}
    empty = [name for name, found in given.items() if not found]
    paths = sorted(
        {path.absolute() for found in given.values() for path in found},
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
    whole = out.absolute()
    return [Job(name, path, whole / name, options) for name, path in zip(names, paths, strict=True)]


def _named(given: str) -> Iterator[Path]:
    """The sessions that are meant; what is none is kept, so that its row can say so."""
    magic = next((at for at, part in enumerate(Path(given).parts) if set(part) & set("*?[")), None)
    if magic is None or Path(given).exists():
        yield from _within(Path(given))
    else:
        parts = Path(given).parts
        for found in Path(*parts[:magic]).glob(str(Path(*parts[magic:]))):
            # What lies beside sessions, as their truths and notes, is not meant.
            if found.is_dir() or found.suffix.lower() == ".rrd":
                yield from _within(found)


def _within(path: Path) -> Iterator[Path]:
    below = []
    if path.is_dir() and not (path / _SESSION).exists():
        below = [file.parent for file in path.rglob(_SESSION)]
    yield from below or [path]


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
    names = {field.name for field in fields(FleetRow)}
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
    done = run(session, level=job.options.level, threads=1).with_paths(job.session, job.folder)
    written = write_outputs(job.folder, session, done, without=job.options.without)
    return done.calibration, written


def _draw(folder: Path, session: Session, found: Calibration) -> bool:
    """Writes a small picture of the first view that was used; returns whether there is one."""
    from visioncal.present.report.thumbnails import small_picture

    used = {view.view for view in found.views if view.used}
    for view in session.views:
        if view.number in used and view.image and session.images.exists(view.image):
            picture = small_picture(session.images.read(view.image))
            if picture is not None:
                write_atomically(folder / PICTURE, picture)
            return picture is not None
    (folder / PICTURE).unlink(missing_ok=True)
    return False
