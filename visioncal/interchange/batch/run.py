"""Calibrates many sessions, and puts what became of them into a table and a page."""

import io
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Progress
from visioncal.interchange.batch.cells import write_cells
from visioncal.interchange.batch.jobs import Options, jobs_of
from visioncal.interchange.batch.workers import rows_of
from visioncal.interchange.outputs import CALIBRATION
from visioncal.results import Calibration
from visioncal.results.fleet import (
    FleetRow,
    camera_edge,
    cell_figures,
    with_changes,
    with_outliers,
)
from visioncal.simulation import read_truth

TABLE, PAGE, _CELLS = "batch.parquet", "index.html", "cells"


@dataclass(frozen=True)
class Batch:
    """What became of many sessions.

    Attributes:
        rows: One a session, those first that stand out the most.
        table: The same as a file.
        page: The same to be looked at.
    """

    rows: tuple[FleetRow, ...]
    table: Path
    page: Path

    @property
    def counts(self) -> Counter[str]:
        """How many sessions came to each verdict, failed, or were kept; and how many changed."""
        found = Counter(it.verdict or it.state for it in self.rows)
        found["kept"] = sum(it.state == "kept" for it in self.rows)
        found["changed"] = sum(it.changed is True for it in self.rows)
        found["standing out"] = sum(it.score > 0.0 for it in self.rows)
        return found


def batch(
    sessions: Iterable[Path | str] | Path | str = (),
    out: Path | str = "out",
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    level: str = "auto",
    need_mm: float | None = None,
    need_deg: float | None = None,
    without: Iterable[str] = (),
    against: Path | str | None = None,
    cells: Path | str | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Calibrates many sessions, each into a folder of its own.

    What was done before by the same version, of the same facts and with the same options, is kept:
    what was interrupted goes on where it was. Of a session that cannot be calibrated the row says
    why.

    Args:
        sessions: Folders, recordings, folders with some below them, or globs.
        out: Where the results go, with `batch.parquet` and `index.html`.
        workers: How many work at a time, on one thread each; one a core where None.
        scheduler: The address of a Dask scheduler, whose workers do it; it takes the extra
            `cluster`.
        level: As in `calibrate`.
        need_mm: Likewise.
        need_deg: Likewise.
        without: `report.html` or `recording.rrd`, where they are not wanted.
        against: The folder of an earlier batch, whose results these are compared with.
        cells: A file of cells to simulate in the place of sessions; see `write_cells`. Their
            sessions go into `cells` in the folder.
        progress: Told of each session.

    Returns:
        The rows, and where they are written.

    Raises:
        DataError: There are no sessions, the folder cannot be written, there is no batch in
            `against`, or no scheduler answers.
    """
    folder = Path(out)
    given = [sessions] if isinstance(sessions, Path | str) else list(sessions)
    options = Options(level, need_mm, need_deg, tuple(sorted(without)))
    if cells is not None:
        if given:
            raise DataError("cells are simulated in the place of sessions.", culprits=["--cells"])
        given = [*write_cells(Path(cells), folder / _CELLS, progress)]
    jobs = jobs_of(given, folder, options)
    if against is not None and not Path(against).is_dir():
        raise DataError(f"{against} is no folder of results.", culprits=["--against"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder} cannot be written: {error.strerror}.") from error
    rows = []
    for row in rows_of(jobs, workers, scheduler):
        rows.append(row)
        if progress is not None:
            progress("batch", len(rows), len(jobs))
    if against is not None:
        old, failed = Path(against), {it.name for it in rows if it.state == "failed"}
        rows = with_changes(
            rows,
            lambda name: _result(old / name),
            lambda name: None if name in failed else _result(folder / name),
        )
    if cells is not None:
        rows = [_beside_truth(it, folder) for it in rows]
    found = Batch(tuple(with_outliers(rows)), folder / TABLE, folder / PAGE)
    write_atomically(found.table, _table(found.rows))
    from visioncal.present.report.fleet import fleet_page

    write_atomically(
        found.page, fleet_page(found.rows, cell_figures(rows) if cells is not None else ())
    )
    return found


def _beside_truth(row: FleetRow, folder: Path) -> FleetRow:
    found = _result(folder / row.name)
    if row.state == "failed" or found is None:
        return row
    name = camera_edge(found)
    true = np.asarray(read_truth(row.session).transforms[name])
    return replace(row, error_mm=pose_difference(found.edges[name].matrix, true)[0])


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
    parquet.write_table(pa.Table.from_pylist([asdict(it) for it in rows], schema=schema), buffer)
    return buffer.getvalue()


def _kind(annotation: object) -> str:
    if annotation in (str, int, float, bool):
        return annotation.__name__
    return "State" if "Literal" in str(annotation) else str(annotation)
