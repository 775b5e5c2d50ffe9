"""Calibrates many sessions, and writes their results into a table and a page."""

import io
import json
import logging
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing.context import BaseContext
from pathlib import Path
from threading import Thread
from typing import Literal

from visioncal.core.arguments import typed
from visioncal.core.codec import read, write
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.errors import DataError, VisioncalError, check_names
from visioncal.core.extras import client_library
from visioncal.core.files import check_own, named_errors, natural, read_text, write_atomically
from visioncal.core.threads import one_blas_thread, safe_path
from visioncal.core.types import Progress
from visioncal.core.verdict import need_options
from visioncal.core.version import __version__
from visioncal.interchange.outputs import CALIBRATION, RECORDING, REPORT, Written, write_outputs
from visioncal.results import Calibration
from visioncal.results.history import Entry, entries_of
from visioncal.session import Session

ROW = "row.json"
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


@dataclass(frozen=True, kw_only=True)
class Row:
    """The outcome of one session of a batch."""

    name: str  # Name of the session and of its result's folder.
    session: str  # Path of the session.
    # `done`, `kept` of an earlier run, or `failed`.
    state: Literal["done", "kept", "failed"]
    entry: Entry | None = None  # The entry of its result; None where there is none.
    failure: str = ""  # Why there is no result.
    error: str = ""  # Class of the error.
    next_step: str = ""  # Remedy of the error.
    seconds: float | None = None  # Duration of the calibration [s].
    has_report: bool = False  # Whether its folder has a report.

    @property
    def verdict(self) -> str:
        """`good`, `check` or `bad`; empty without a result."""
        return "" if self.entry is None else self.entry.status

    @property
    def words(self) -> str:
        """The verdict's first sentence, or why there is no result."""
        return self.failure if self.entry is None else self.entry.reason


def jobs_of(sessions: Iterable[Path | str], out: Path, options: Options) -> list[Job]:
    """One job a session, in their natural order; raises DataError.

    Sessions are folders, recordings, folders of sessions, or globs.

    Returns:
        The jobs, named by their paths below the folder that all sessions share.
    """
    by_argument = {str(session): [*_sessions_of(str(session))] for session in sessions}
    check_names(*(str(path) for found in by_argument.values() for path in found))
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
    path, is_glob = Path(given), bool({*given} & {*"*?["}) and not Path(given).exists()
    below = str(path.relative_to(path.anchor))
    for found in Path(path.anchor).glob(below) if is_glob else [path]:
        is_session = not found.is_dir() or (found / _SESSION).exists()
        inner = [] if is_session else [file.parent for file in found.rglob(_SESSION)]
        # Other files beside sessions, such as truths and notes, are skipped.
        if not is_glob or found.is_dir() or found.suffix.lower() == ".rrd":
            yield from inner or [found]


def work(job: Job) -> Row:
    """Calibrates one session into its folder, on one thread.

    Returns:
        The row of its result, or of its error.
    """
    begin = time.perf_counter()
    try:
        with one_blas_thread():
            session = _session(job)
            calibration, written = _calibrated(job, session)
            entry = next(entries_of(calibration))
            row = Row(
                name=job.name,
                session=str(job.session),
                state="done",
                entry=replace(entry, source=str(job.session), out=str(job.folder)),
                has_report=job.folder / REPORT in written.files,
            )
            # Written last: it marks the session as done.
            document = {**_made_by(job, session), "row": write(Row, row)}
            write_atomically(job.folder / ROW, json.dumps(document, indent=1))
    except VisioncalError as error:
        row = failed_row(job, type(error).__name__, error.message, error.next_step)
    except Exception as error:  # noqa: BLE001 - a bug in one of a thousand ends no batch
        row = failed_row(job, type(error).__name__, str(error), "Report this with the session.")
    return replace(row, seconds=time.perf_counter() - begin)


def failed_row(job: Job, error: str, words: str, next_step: str) -> Row:
    """The row of a session without a result: the error's class, its words, and what to do."""
    return Row(
        name=job.name,
        session=str(job.session),
        state="failed",
        failure=words,
        error=error,
        next_step=next_step,
    )


def kept_row(job: Job) -> Row | None:
    """The row of an earlier run with the same inputs; None where there is none."""
    try:
        document = parse_stored(read_text(job.folder / ROW), ROW)
        made_by = _made_by(job, _session(job))
        row = read(Row, document.get("row"), "row")
    except VisioncalError:
        return None
    is_same = {key: document.get(key) for key in made_by} == made_by
    if not is_same or row.entry is None or not (job.folder / CALIBRATION).exists():
        return None
    return replace(row, name=job.name, session=str(job.session), state="kept")


def _session(job: Job) -> Session:
    return Session.load(job.session).needing(job.options.need_mm, job.options.need_deg)


def _made_by(job: Job, session: Session) -> dict[str, object]:
    """All that a result depends on."""
    return {
        "session_sha256": session.digest(),
        "visioncal": __version__,
        # Neither need nor forms are part of the digest, which is of the recorded facts.
        "forms": [robot.form for robot in session.robots.values()],
        "need": None if session.need is None else list(map(str, asdict(session.need).values())),
        "options": asdict(job.options) | {"without": list(job.options.without)},
    }


def _calibrated(job: Job, session: Session) -> tuple[Calibration, Written]:
    """Calibrates on one thread, and writes the outputs of `visioncal calibrate`."""
    # Imported late, since a finished batch needs none of it.
    from visioncal.calibration.run import run
    from visioncal.vision.detection import ONE_OPENCV_THREAD

    with ONE_OPENCV_THREAD.held():
        pictures = RECORDING not in job.options.without
        result = run(session, level=job.options.level, threads=1, pictures=pictures)
    need = need_options(job.options.need_mm, job.options.need_deg)
    result = result.with_paths(job.session, job.folder, need)
    written = write_outputs(job.folder, session, result, without=job.options.without)
    return result.calibration, written


TABLE, PAGE = "batch.parquet", "index.html"


@dataclass(frozen=True)
class Batch:
    """Results of many sessions."""

    rows: tuple[Row, ...]  # One a session, the worst first.
    table: Path
    page: Path

    @property
    def counts(self) -> Counter[str]:
        """Numbers of sessions by verdict or failure, and of kept ones."""
        counts = Counter(row.verdict or row.state for row in self.rows)
        counts["kept"] = sum(row.state == "kept" for row in self.rows)
        return counts

    @property
    def is_cut_short(self) -> bool:
        """Whether the cluster's scheduler went away before all sessions were calibrated."""
        return any(row.error == LOST for row in self.rows)


@typed
def batch(
    sessions: Iterable[Path | str] | Path | str,
    out: Path | str = "out",
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    level: str = "auto",
    need_mm: float | None = None,
    need_deg: float | None = None,
    without: Iterable[str] = (),
    progress: Progress | None = None,
) -> Batch:
    """Calibrates many sessions, each into a folder of its own.

    Results of the same version, facts and options are kept, so that an interrupted batch continues.
    For a session that cannot be calibrated the row says why.

    Args:
        sessions: Folders, recordings, folders of sessions, or globs.
        out: Folder for the results, with `batch.parquet` and `index.html`.
        workers: Number of processes of one thread each; None for one a core. They import the
            calling script, which therefore calls this below `if __name__ == "__main__":`.
        scheduler: The address of a Dask scheduler whose workers are used; needs the extra
            `cluster`.
        level: As in `calibrate`.
        need_mm: As in `calibrate`.
        need_deg: As in `calibrate`.
        without: `report.html` or `recording.rrd`, to leave out.
        progress: Called after each session.

    Returns:
        The rows, and their files.

    Raises:
        DataError: There are no sessions, the folder cannot be written, or no scheduler answers.
    """
    folder = Path(out)
    given = [sessions] if isinstance(sessions, Path | str) else list(sessions)
    options = Options(level, need_mm, need_deg, tuple(sorted(without)))
    jobs = jobs_of(given, folder, options)
    check_own(folder / PAGE)
    with named_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    # Reported before the first result, which may take minutes.
    progress = progress or (lambda *_: None)
    progress("batch", 0, len(jobs))
    for row in _rows(jobs, workers, scheduler):
        rows.append(row)
        progress("batch", len(rows), len(jobs))
    # Those without a result first, then by their verdicts and names.
    order = ("", "bad", "check", "good")
    ordered = sorted(rows, key=lambda row: (order.index(row.verdict), row.name))
    results = Batch(tuple(ordered), folder / TABLE, folder / PAGE)
    import pyarrow as pa
    from pyarrow import parquet

    facts = [
        {**vars(row), **({} if row.entry is None else row.entry.columns), "session": row.session}
        for row in results.rows
    ]
    names = dict.fromkeys(name for fact in facts for name in fact if name != "entry")
    table = pa.table({name: [fact.get(name) for fact in facts] for name in names})
    buffer = io.BytesIO()
    parquet.write_table(table, buffer)
    write_atomically(results.table, buffer.getvalue())
    from visioncal.present.report.fleet import FleetRow, fleet_page

    # The page is that of a history of one day.
    shown = [
        FleetRow(row.name, failure=f"{row.failure} {row.next_step}")
        if row.entry is None
        else FleetRow(
            row.name, (row.entry,), link=f"{row.name}/{REPORT if row.has_report else CALIBRATION}"
        )
        for row in results.rows
    ]
    page = fleet_page(shown, "Batch", f"{len(rows)} sessions", TABLE)
    write_atomically(results.page, page)
    return results


def _rows(jobs: Sequence[Job], workers: int | None, scheduler: str | None) -> Iterator[Row]:
    """Rows of earlier results, and then those of the other sessions, as they finish."""
    waiting = []
    for job in jobs:
        row = kept_row(job)
        if row is None:
            waiting.append(job)
        else:
            yield row
    yield from rows_of(waiting, workers, scheduler)


# Errors of rows: the process died, and the scheduler went away.
DIED, LOST = "WorkerDied", "SchedulerLost"


def rows_of(
    jobs: Sequence[Job], workers: int | None = None, scheduler: str | None = None
) -> Iterator[Row]:
    """The rows of all jobs, in the order in which they finish; see `batch`.

    If a local process dies, the jobs that were running are run again, each in a pool of its own:
    a session on which it dies again has a row that says so, and all others go on. If a scheduler
    goes away, the remaining rows say so.

    Raises:
        DataError: The scheduler does not answer.
        DriverError: A scheduler is named without the extra.
    """
    waiting, count = [*reversed(jobs)], min(workers or os.cpu_count() or 1, len(jobs))
    while waiting:
        # A cluster has a queue of its own; a pool gets no more than it runs: what it has, ran.
        most, engine = (len(jobs), _cluster(scheduler)) if scheduler else (count, _pool(count))
        running: dict[Future[Row], Job] = {}
        with engine as executor:
            try:
                while waiting or running:
                    while waiting and len(running) < most:
                        running[executor.submit(work, waiting[-1])] = waiting[-1]
                        waiting.pop()
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        yield _row(future, running[future], scheduler)
                        del running[future]
            except BrokenExecutor:
                done = [future for future in running if future.exception() is None]
                yield from (future.result() for future in done)
                suspects = [job for future, job in running.items() if future not in done]
            else:
                return
        for job in suspects:
            yield _row_alone(job)


def _row(future: Future[Row], job: Job, scheduler: str | None) -> Row:
    """The row of a finished job; raises BrokenExecutor where the pool's processes ended."""
    try:
        return future.result()
    except BrokenExecutor:
        raise
    except CancelledError:
        return failed_row(
            job,
            LOST,
            f"the scheduler at {scheduler} went away before the session was calibrated.",
            "Start it and the same command again: what is finished is kept.",
        )
    except Exception as error:  # noqa: BLE001 - `work` raises nothing: Dask reports a death
        return failed_row(job, DIED, f"its worker died: {error}.", _MEMORY)


_MEMORY = (
    "It may need more memory: calibrate it by itself. A script that calls batch does so below "
    'if __name__ == "__main__":, since each worker imports it.'
)


def _row_alone(job: Job) -> Row:
    with _pool(1) as executor:
        try:
            return executor.submit(work, job).result()
        except BrokenExecutor:
            words = "its worker died twice, once with no other session beside it."
            return failed_row(job, DIED, words, _MEMORY)


@contextmanager
def _pool(count: int) -> Iterator[Executor]:
    context: BaseContext
    if "forkserver" in multiprocessing.get_all_start_methods():
        # Forks of a server that has imported the calibration: no worker waits for imports, and none
        # inherits the caller's threads and locks.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(
            [work.__module__, "visioncal.calibration.run", "visioncal.present.report.page"]
        )
    else:
        context = multiprocessing.get_context("spawn")
    with safe_path():
        executor = ProcessPoolExecutor(count, context, initializer=_end_with_parent)
        try:
            yield executor
        finally:
            executor.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """Ends this process if the batch is killed: the pool's queue would keep it waiting forever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    Thread(target=watch, daemon=True).start()


@contextmanager
def _cluster(scheduler: str | None) -> Iterator[Executor]:
    distributed = client_library("distributed", "cluster")
    # It prints tracebacks where a scheduler goes away, which rows say.
    log = logging.getLogger("distributed.client")
    log_level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        # Seconds that the scheduler has for an answer.
        client = distributed.Client(scheduler, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise DataError(
            f"no scheduler answers at {scheduler}: {error}", culprits=["--scheduler"]
        ) from error
    try:
        yield client.get_executor(pure=False)
    finally:
        client.close()
        log.setLevel(log_level)
