"""Tables of targets: read with the columns of views.csv, and written with the corrections."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.conventions import PoseForm, PoseNumbers, Reading, write_pose
from visioncal.core.documents.columns import Column, TableReader
from visioncal.core.documents.pendants import rotation_names
from visioncal.core.documents.tables import TextTable, csv_text, read_table
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray
from visioncal.results.compensation.correction import Corrected
from visioncal.robot import Robot
from visioncal.session.columns import POSE, QUATERNION, joint_columns

# Columns of a corrected table.
ADDED = ("moved_mm", "moved_deg", "sigma_mm", "off_deg")


@dataclass(frozen=True, eq=False)
class Targets:
    """The rows of a table of targets, m in all."""

    table: TextTable  # The table itself.
    places: tuple[str, ...]  # (m,) the rows' lines: `targets.csv, line 3`.
    base_from_tool: FloatArray  # (m, 4, 4) the targets, of the flange or of a tool [m].
    q_seed: FloatArray  # (m, n) joint seeds [rad or m], NaN in a row without.
    names: tuple[str, ...]  # The columns of the targets' poses.
    reading: Reading  # How they are written there.

    def __len__(self) -> int:
        return len(self.places)


def read_targets(
    path: Path, robot: Robot, typed: tuple[tuple[str, ...], PoseNumbers] | None = None
) -> Targets:
    """Reads a table of targets.

    Args:
        path: A table with x_m ... qw, and optional seeds q1_rad ...; other columns are kept.
        robot: The robot that the joints belong to.
        typed: The columns of poses in another form, and these poses; None for x_m ... qw.

    Raises:
        DataError: It cannot be read, has been corrected already, or rows are no targets in metres
            and radians.
    """
    table = read_table(path)
    name, columns = table.label, table.columns
    done = [name for name in ADDED if name in columns]
    if done:
        raise DataError(
            f"{name} has the column {some_of(done)}, which visioncal correct writes: these targets "
            "look corrected, and would be so twice.",
            culprits=done,
            next_step="Correct the targets that they came from, or rename the column.",
        )
    names = POSE if typed is None else typed[0]
    missing = [name for name in names if name not in columns]
    if missing:
        hint = did_you_mean(missing[0], columns)
        raise DataError(
            f"{name}: the columns {', '.join(missing)} are missing; there are {some_of(columns)}.",
            culprits=missing,
            next_step=f"{hint} A header row names x_m, y_m, z_m [m] and qx, qy, qz, qw; or a "
            "maker's numbers, as X, Y, Z, A, B, C with --robot-form kuka.".strip(),
        )
    joints, wanted = joint_columns(columns), joint_names(robot)
    if joints not in ((), wanted):
        raise DataError(
            f"{name}: its joints are {', '.join(joints)}; {robot.name} has {', '.join(wanted)}.",
            culprits=joints,
            next_step="Name one for each joint, or none.",
        )
    reader = TableReader(table)
    poses = reader.numbers(*(Column(name, is_needed=True) for name in names))
    joints = joint_columns(table.columns)
    seeds = np.full((len(poses), robot.joint_count), np.nan)
    if joints:
        seeds = reader.numbers(*map(Column, joints))
        reader.complete(joints)
    reader.check()
    places = tuple(map(table.place, range(len(poses))))
    if typed is not None:
        return Targets(table, places, typed[1].poses(), seeds, names, typed[1].reading)
    reader.unit(QUATERNION)
    reader.check()
    _check_metres(path, poses[:, :3], places, columns)
    rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
    return Targets(table, places, compose(rotations, poses[:, :3]), seeds, POSE, Reading())


def _check_metres(
    path: Path, positions: FloatArray, places: Sequence[str], columns: Sequence[str]
) -> None:
    """Refuses positions (m, 3) beyond any arm's reach; raises DataError."""
    extents_m = np.abs(positions).max(axis=1, initial=0.0)
    far = np.flatnonzero(extents_m >= FAR_M).tolist()
    if not far:
        return
    fields = "; ".join(f"${list(columns).index(name) + 1} /= 1000" for name in POSE[:3])
    metres = path.with_name(f"{path.stem}_m.csv")
    raise DataError(
        f"{places[far[0]]}: these are millimetres, most likely: its position is "
        f"{extents_m[far[0]]:.4g} m from the base, and no arm reaches {FAR_M:g} m.",
        culprits=[places[row] for row in far],
        next_step=f"Positions are in metres: awk -F, -v OFS=, 'NR > 1 {{ {fields} }} 1' "
        f"{quote(str(path))} > {quote(str(metres))}, and correct those.",
    )


def joint_names(robot: Robot) -> tuple[str, ...]:
    """Column names of a robot's joints."""
    return tuple(f"q{index}_rad" for index in range(1, robot.joint_count + 1))


def columns_to_send(
    targets: Targets,
    corrected: Corrected,
    base_from_tool: FloatArray,
    sigma_mm: FloatArray,
    form: PoseForm | None = None,
) -> dict[str, FloatArray]:
    """Corrected values of all targets, (m,) by column name.

    Args:
        targets: The rows as they were read.
        corrected: The corrected commands.
        base_from_tool: (m, 4, 4) corrected Cartesian targets, of the flange or the tool [m].
        sigma_mm: (m,) predicted sigma of each [mm]; NaN where there is none.
        form: In which poses that are not in a maker's form are written, too.
    """
    sent = PoseNumbers.written(base_from_tool, targets.reading, targets.places)
    poses = dict(zip(targets.names, np.hstack([sent.positions, sent.rotations]).T, strict=True))
    if form is not None and targets.names == POSE:
        numbers = np.array([write_pose(pose, form) for pose in base_from_tool]).T
        names = (f"{form.name}_{name}" for name in (*"xyz", *rotation_names(form)))
        poses |= dict(zip(names, numbers, strict=True))
    joints = tuple(f"q{index}_rad" for index in range(1, corrected.q.shape[1] + 1))
    correction = invert(targets.base_from_tool) @ base_from_tool
    columns: dict[str, FloatArray] = {
        **poses,
        **dict(zip(joints, corrected.q.T, strict=True)),
        "moved_mm": 1e3 * np.linalg.norm(correction[:, :3, 3], axis=1),
        "moved_deg": np.rad2deg(rotation_angle(correction)),
    }
    if np.isfinite(sigma_mm).all():
        columns["sigma_mm"] = sigma_mm
    if len(joints) < 6:
        columns["off_deg"] = np.rad2deg(corrected.off_rad)
    return columns


def table_to_send(targets: Targets, columns: Mapping[str, FloatArray], rows: IntArray) -> str:
    """Formats rows, by index, as CSV with all their columns, corrected values in place."""
    table_columns = targets.table.columns
    names = [*table_columns, *(column for column in columns if column not in table_columns)]
    lines = [names]
    for row in rows:
        cells = dict(zip(table_columns, targets.table.rows[row], strict=True))
        cells |= {name: written(name, float(numbers[row])) for name, numbers in columns.items()}
        lines.append([cells[name] for name in names])
    return csv_text(lines, inert=True)


def written(name: str, value: float) -> str:
    """Formats a number with significant digits: 0.1 nm of a position, 1e-12 of a quaternion."""
    digits = 4 if name in ADDED else 12 if name in POSE[3:] else 10
    return f"{value:.{digits}f}"
