"""Calibrates many sessions, and writes their results into a table and a page.

Alternatively it simulates cells: all combinations of given parameters.
"""

import io
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.choices import SIMULATED_ARMS
from visioncal.core.errors import DataError
from visioncal.core.files import read_toml, write_atomically
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Progress
from visioncal.interchange.batch.work import Options, jobs_of
from visioncal.interchange.batch.workers import rows_of
from visioncal.interchange.outputs import CALIBRATION
from visioncal.results import Calibration
from visioncal.results.fleet import FleetRow, camera_edge, cell_figures, with_changes, with_outliers
from visioncal.simulation import CAMERAS, CellOptions, read_truth, simulate, write_session
from visioncal.simulation.options import TARGETS

TABLE, PAGE, _CELLS = "batch.parquet", "index.html", "cells"
# Numeric keys: the field of `CellOptions` and the unit.
_NUMBERS: Mapping[str, tuple[str, float]] = {
    "robot_sigma_mm": ("robot_sigma_m", 1e-3),
    "robot_sigma_mrad": ("robot_sigma_rad", 1e-3),
    "arm_sigma_mm": ("dh_sigma_m", 1e-3),
    "arm_sigma_mrad": ("dh_sigma_rad", 1e-3),
    "pixel_sigma_px": ("pixel_sigma_px", 1.0),
}
# Keys with named values: the field of `CellOptions` and the values by name.
_NAMES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "robot": ("robot", {arm: arm for arm in SIMULATED_ARMS}),
    "mount": ("mount", {name: name for name in ("eye-in-hand", "eye-to-hand")}),
    "camera": ("camera", CAMERAS),
    "board": ("target", TARGETS),
}
_SEEDS, _MOST_SEEDS, _MOST_VIEWS = 10, 10_000, 10_000


@dataclass(frozen=True)
class Batch:
    """Results of many sessions.

    Attributes:
        rows: One a session, the strongest outliers first.
    """

    rows: tuple[FleetRow, ...]
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


@typed
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

    Results of the same version, facts and options are kept, so that an interrupted batch continues.
    For a session that cannot be calibrated the row says why.

    Args:
        sessions: Folders, recordings, folders of sessions, or globs.
        out: Folder for the results, with `batch.parquet` and `index.html`.
        workers: Number of parallel workers of one thread each; None for one a core.
        scheduler: The address of a Dask scheduler whose workers are used; needs the extra
            `cluster`.
        level: As in `calibrate`.
        need_mm: As in `calibrate`.
        need_deg: As in `calibrate`.
        without: `report.html` or `recording.rrd`, to leave out.
        against: The folder of an earlier batch to compare with.
        cells: A file of cells to simulate instead of sessions; see `write_cells`. Their sessions go
            into `cells` in the folder.
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
        earlier, failed = Path(against), {row.name for row in rows if row.state == "failed"}
        rows = with_changes(
            rows,
            lambda name: _result(earlier / name),
            lambda name: None if name in failed else _result(folder / name),
        )
    if cells is not None:
        rows = [_with_error(row, folder) for row in rows]
    results = Batch(tuple(with_outliers(rows)), folder / TABLE, folder / PAGE)
    write_atomically(results.table, _table(results.rows))
    from visioncal.present.report.fleet import fleet_page

    write_atomically(
        results.page, fleet_page(results.rows, cell_figures(rows) if cells is not None else ())
    )
    return results


def _with_error(row: FleetRow, folder: Path) -> FleetRow:
    calibration = _result(folder / row.name)
    if row.state == "failed" or calibration is None:
        return row
    name = camera_edge(calibration)
    truth = np.asarray(read_truth(row.session).transforms[name])
    return replace(row, error_mm=pose_difference(calibration.edges[name].matrix, truth)[0])


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


def write_cells(file: Path, folder: Path, progress: Progress | None = None) -> list[Path]:
    """Simulates all combinations of varied parameters, each with several seeds.

    Args:
        file: A TOML file with a list of values for each key, and the number of `seeds`.
        folder: Folder for the sessions, without images, each with its truth beside it; existing
            ones are kept.
        progress: Called after each.

    Returns:
        The sessions' folders.

    Raises:
        DataError: The file cannot be read, or a key or value in it is unknown.
    """
    document = read_toml(file, str(file))
    seeds = document.pop("seeds", _SEEDS)
    if type(seeds) is not int or not 0 < seeds <= _MOST_SEEDS:
        raise DataError(
            f"{file}: seeds is {seeds!r}; 1 to {_MOST_SEEDS} is needed.", culprits=[str(file)]
        )
    varied = {key: value if isinstance(value, list) else [value] for key, value in document.items()}
    fields = {key: [_field(file, key, value) for value in values] for key, values in varied.items()}
    cells = []
    for indices in product(*(range(len(group)) for group in varied.values())):
        chosen = dict(zip(varied, indices, strict=True))
        words = "-".join(f"{key}_{varied[key][at]}" for key, at in chosen.items()) or "cell"
        options = replace(CellOptions(), **dict(fields[key][at] for key, at in chosen.items()))
        cells += [
            (folder / words / f"seed_{seed:04d}", replace(options, seed=seed))
            for seed in range(seeds)
        ]
    for at, (path, options) in enumerate(cells):
        if not path.exists():
            write_session(simulate(options), path, images=False)
        if progress is not None:
            progress("cells", at + 1, len(cells))
    return [path for path, _ in cells]


def _field(file: Path, key: str, value: object) -> tuple[str, Any]:
    """The field of `CellOptions` that a key sets, and its value."""
    if key == "views":
        if type(value) is int and 3 <= value <= _MOST_VIEWS:
            return key, value
        raise DataError(
            f"{file}: views has {value!r}; 3 to {_MOST_VIEWS} is needed.", culprits=[str(file)]
        )
    if key in _NUMBERS:
        field, unit = _NUMBERS[key]
        if isinstance(value, int | float) and 0.0 <= value <= 100.0:
            return field, unit * value
        raise DataError(
            f"{file}: {key} has {value!r}; a number from 0 to 100 is needed.", culprits=[str(file)]
        )
    if key in _NAMES:
        field, values = _NAMES[key]
        if value in values:
            return field, values[str(value)]
        raise DataError(
            f"{file}: {key} has {value!r}; known are {', '.join(values)}.",
            culprits=[key],
            next_step=did_you_mean(str(value), values) or f"Write one of these in {file}, {key}.",
        )
    keys = ("views", *_NUMBERS, *_NAMES, "seeds")
    raise DataError(
        f"{file}: {key} is nothing that is varied; known are {', '.join(keys)}.",
        culprits=[key],
        next_step=did_you_mean(key, keys) or f"Write one of these in {file}.",
    )
