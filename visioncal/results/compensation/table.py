"""Tables of targets: read with the columns of views.csv, and written with the corrections."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.documents import TextTable, is_number, read_table
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray
from visioncal.results.compensation.correction import FAR_M, WIDE_RAD, Corrected
from visioncal.robot import Robot
from visioncal.session.columns import POSE, joint_columns

# Columns of a corrected table.
ADDED = ("moved_mm", "moved_deg", "sigma_mm", "off_deg")
# Rounding to four digits leaves a unit quaternion's norm within this of 1.
_NORM_TOLERANCE = 1e-3
_SHOWN = 10


@dataclass(frozen=True, eq=False)
class Targets:
    """The rows of a table of targets, m in all.

    Attributes:
        table: The table itself.
        places: (m,) the rows' lines: `targets.csv, line 3`.
        base_from_tool: (m, 4, 4) the targets, of the flange or of a tool [m].
        q_seed: (m, n) joint seeds [rad or m], NaN in a row without.
    """

    table: TextTable
    places: tuple[str, ...]
    base_from_tool: FloatArray
    q_seed: FloatArray

    def __len__(self) -> int:
        return len(self.places)


def read_targets(path: Path, robot: Robot) -> Targets:
    """Reads a table of targets.

    Args:
        path: A table with x_m ... qw, and optional seeds q1_rad ...; other columns are kept.
        robot: The robot that the joints belong to.

    Raises:
        DataError: It cannot be read, has been corrected already, or rows are no targets in metres
            and radians.
    """
    table = read_table(path)
    _check_columns(table)
    places = tuple(table.place(index) for index in range(len(table.rows)))
    poses = _numbers(table, POSE, needed=True)
    _check_poses(poses, places)
    turns = Rotation.from_quat(poses[:, 3:]).as_matrix()
    return Targets(table, places, compose(turns, poses[:, :3]), _seeds(table, places, robot))


def _check_columns(table: TextTable) -> None:
    name, columns = table.path.name, table.columns
    done = [name for name in ADDED if name in columns]
    if done:
        raise DataError(
            f"{name} has the column {some_of(done)}, which visioncal correct writes: these targets "
            "look corrected, and would be so twice.",
            culprits=done,
            next_step="Correct the targets that they came from, or rename the column.",
        )
    missing = [name for name in POSE if name not in columns]
    if missing:
        other = [column for column in columns if column.lower() in ("x_mm", "y_mm", "z_mm")]
        hint = did_you_mean(missing[0], columns)
        raise DataError(
            f"{name}: the columns {', '.join(missing)} are missing; there are {some_of(columns)}.",
            culprits=missing,
            next_step="Write metres, in x_m, y_m, z_m."
            if other
            else f"{hint} A header row names x_m, y_m, z_m [m] and qx, qy, qz, qw.".strip(),
        )


def _numbers(table: TextTable, names: Sequence[str], *, needed: bool) -> FloatArray:
    """(m, k) numbers of columns; a row may leave all of them empty unless they are needed."""
    at = [table.columns.index(name) for name in names]
    values = np.full((len(table.rows), len(names)), np.nan)
    problems: list[tuple[str, str]] = []
    for row, cells in enumerate(table.rows):
        chosen = [cells[index] for index in at]
        if not needed and not any(chosen):
            continue
        for column, cell in enumerate(chosen):
            value = float(cell) if is_number(cell) else np.nan
            values[row, column] = value
            if not np.isfinite(value):
                words = f"{table.place(row)}: {names[column]} is {cell[:40]!r}"
                problems.append((table.place(row), words))
    if problems:
        more = len(problems) - _SHOWN
        shown = [name for _, name in problems[:_SHOWN]] + ([f"and {more} more"] if more > 0 else [])
        raise DataError(
            f"{'; '.join(shown)}: finite numbers are needed"
            f"{'' if needed else ', or none at all in that row'}.",
            culprits=[name for name, _ in problems],
        )
    return values


def _check_poses(poses: FloatArray, places: Sequence[str]) -> None:
    distances = np.linalg.norm(poses[:, :3], axis=1)
    far = np.flatnonzero(distances > FAR_M).tolist()
    if far:
        raise DataError(
            f"{places[far[0]]}: its position is {distances[far[0]]:.4g} m from the base, and no "
            f"arm reaches {FAR_M:g} m: these look like millimetres.",
            culprits=[places[index] for index in far],
            next_step="Write metres.",
        )
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    off = np.flatnonzero(np.abs(norms - 1.0) > _NORM_TOLERANCE).tolist()
    if off:
        raise DataError(
            f"{places[off[0]]}: the quaternion's norm is {norms[off[0]]:.6g}, but must be 1 to "
            f"within {_NORM_TOLERANCE:g}.",
            culprits=[places[index] for index in off],
            next_step="qx, qy, qz, qw are a unit quaternion, w last.",
        )


def _seeds(table: TextTable, places: Sequence[str], robot: Robot) -> FloatArray:
    names = joint_columns(table.columns)
    wanted = joint_names(robot)
    if not names:
        return np.full((len(places), len(wanted)), np.nan)
    if names != wanted:
        raise DataError(
            f"{table.path.name}: its joints are {', '.join(names)}; {robot.name} has "
            f"{', '.join(wanted)}.",
            culprits=names,
            next_step="Name one for each joint, or none.",
        )
    seeds = _numbers(table, names, needed=False)
    turns = np.where(robot.chain.prismatic, 0.0, np.abs(np.nan_to_num(seeds))).max(axis=1)
    wide = np.flatnonzero(turns > WIDE_RAD).tolist()
    if wide:
        raise DataError(
            f"{places[wide[0]]}: a joint stands at {turns[wide[0]]:.4g} rad, more than two turns: "
            "these look like degrees.",
            culprits=[places[index] for index in wide],
            next_step="Write radians.",
        )
    return seeds


def joint_names(robot: Robot) -> tuple[str, ...]:
    """Column names of a robot's joints."""
    return tuple(f"q{index}_rad" for index in range(1, robot.joint_count + 1))


def columns_to_send(
    targets: Targets, corrected: Corrected, base_from_tool: FloatArray, sigma_mm: FloatArray
) -> dict[str, FloatArray]:
    """Corrected values of all targets, (m,) by column name.

    Args:
        targets: The rows as they were read.
        corrected: The corrected commands.
        base_from_tool: (m, 4, 4) corrected Cartesian targets, of the flange or the tool [m].
        sigma_mm: (m,) predicted sigma of each [mm]; NaN where there is none.
    """
    names = tuple(f"q{index}_rad" for index in range(1, corrected.q.shape[1] + 1))
    turns = Rotation.from_matrix(base_from_tool[:, :3, :3]).as_quat(canonical=True)
    correction = invert(targets.base_from_tool) @ base_from_tool
    columns: dict[str, FloatArray] = {
        **dict(zip(POSE, np.column_stack([base_from_tool[:, :3, 3], turns]).T, strict=True)),
        **dict(zip(names, corrected.q.T, strict=True)),
        "moved_mm": 1e3 * np.linalg.norm(correction[:, :3, 3], axis=1),
        "moved_deg": np.rad2deg(rotation_angle(correction)),
    }
    if np.isfinite(sigma_mm).all():
        columns["sigma_mm"] = sigma_mm
    if len(names) < 6:
        columns["off_deg"] = np.rad2deg(corrected.off_rad)
    return columns


def table_to_send(targets: Targets, columns: Mapping[str, FloatArray], rows: IntArray) -> str:
    """Formats rows, by index, as CSV with all their columns, corrected values in place."""
    own = targets.table.columns
    names = [*own, *(column for column in columns if column not in own)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        cells = dict(zip(own, targets.table.rows[row], strict=True))
        cells |= {name: written(name, float(numbers[row])) for name, numbers in columns.items()}
        writer.writerow([cells[name] for name in names])
    return text.getvalue()


def written(name: str, value: float) -> str:
    """Formats a number with significant digits: 0.1 nm of a position, 1e-12 of a quaternion."""
    digits = 4 if name in ADDED else 12 if name in POSE[3:] else 10
    return f"{value:.{digits}f}"
