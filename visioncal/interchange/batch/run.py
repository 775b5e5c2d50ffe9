"""Calibrates many sessions, and writes their results into a table and a page."""

import io
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.types import Progress
from visioncal.interchange.batch.executors import LOST, rows_of
from visioncal.interchange.batch.work import Job, Options, jobs_of, kept_row
from visioncal.interchange.outputs import CALIBRATION
from visioncal.results import Calibration
from visioncal.results.fleet import FleetRow, with_changes, with_outliers

TABLE, PAGE = "batch.parquet", "index.html"


@dataclass(frozen=True)
class Batch:
    """Results of many sessions."""

    rows: tuple[FleetRow, ...]  # One a session, the strongest outliers first.
    table: Path
    page: Path

    @property
    def counts(self) -> Counter[str]:
        """Numbers of sessions by verdict or failure, and of kept, changed and outlying ones."""
        counts = Counter(row.verdict or row.state for row in self.rows)
        counts["kept"] = sum(row.state == "kept" for row in self.rows)
        counts["changed"] = sum(row.changed is True for row in self.rows)
        counts["standing out"] = sum(row.score > 0.0 for row in self.rows)
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
    against: Path | str | None = None,
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
        against: The folder of an earlier batch to compare with.
        progress: Called after each session.

    Returns:
        The rows, and their files.

    Raises:
        DataError: There are no sessions, the folder cannot be written, there is no batch in
            `against`, or no scheduler answers.
    """
    folder = Path(out)
    given = [sessions] if isinstance(sessions, Path | str) else list(sessions)
    options = Options(level, need_mm, need_deg, tuple(sorted(without)))
    jobs = jobs_of(given, folder, options)
    if against is not None and not Path(against).is_dir():
        raise DataError(f"{against} is no folder of results.", culprits=["--against"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder} cannot be written: {error.strerror}.") from error
    rows: list[FleetRow] = []
    # Reported before the first result, which may take minutes.
    progress = progress or (lambda *_: None)
    progress("batch", 0, len(jobs))
    for row in _rows(jobs, workers, scheduler):
        rows.append(row)
        progress("batch", len(rows), len(jobs))
    if against is not None:
        earlier, failed = Path(against), {row.name for row in rows if row.state == "failed"}
        rows = with_changes(
            rows,
            lambda name: _result(earlier / name),
            lambda name: None if name in failed else _result(folder / name),
        )
    results = Batch(tuple(with_outliers(rows)), folder / TABLE, folder / PAGE)
    write_atomically(results.table, _table(results.rows))
    from visioncal.present.report.fleet import fleet_page

    write_atomically(results.page, fleet_page(results.rows))
    return results


def _rows(jobs: Sequence[Job], workers: int | None, scheduler: str | None) -> Iterator[FleetRow]:
    """Rows of earlier results, and then those of the other sessions, as they finish."""
    waiting = []
    for job in jobs:
        row = kept_row(job)
        if row is None:
            waiting.append(job)
        else:
            yield row
    yield from rows_of(waiting, workers, scheduler)


def _result(folder: Path) -> Calibration | None:
    try:
        return Calibration.load(folder / CALIBRATION)
    except DataError:
        return None


def _table(rows: Iterable[FleetRow]) -> bytes:
    """The rows as Parquet."""
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {
        "str": pa.string(),
        "State": pa.string(),
        "bool": pa.bool_(),
        "bool | None": pa.bool_(),
        "int | None": pa.int64(),
        "float": pa.float64(),
        "float | None": pa.float64(),
    }
    names = {name: _kind(kind) for name, kind in FleetRow.__annotations__.items()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in names.items()])
    buffer = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist([asdict(row) for row in rows], schema=schema), buffer)
    return buffer.getvalue()


def _kind(annotation: object) -> str:
    if annotation in (str, int, float, bool):
        return annotation.__name__
    return "State" if "Literal" in str(annotation) else str(annotation)
