"""Reads touches and CAD points from tables in any form that `convert` reads."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visioncal.core.conventions import POSE_FORMS, UNITS_M
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray
from visioncal.frames.touches import NominalPoints, TouchRows, touches_of
from visioncal.interchange.formats.columns import foreign_from, view_numbers
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.poses import check_radians, pose_names
from visioncal.interchange.formats.reading import Fields, read_fields, unnamed_columns
from visioncal.session import Session
from visioncal.session.columns import joint_columns

_NAMES = ("point", "name", "label", "id")


def read_touches(
    path: Path, requested: ImportOptions, robot: str | None = None, *, positions: bool = False
) -> TouchRows:
    """Reads touches.

    Args:
        path: A table with the columns of views.csv, `kind` and `point`, of which only the pose or
            the joints are required; or a session, whose rows have them.
        requested: Convention of poses and joints, where the columns do not show it.
        robot: Which robot of a cell is meant, where a session or a column `robot` has several.
        positions: Whether a table without rotations is accepted: x_m, y_m, z_m, or x, y, z with the
            unit given.

    Raises:
        DataError: It cannot be read, or a row is no pose.
    """
    if path.is_dir() or path.suffix.lower() == ".rrd":
        return touches_of(Session.load(path), robot)
    fields = _of_robot(read_fields(path), robot)
    unnamed = unnamed_columns(fields)["robot"]
    named = pose_names(fields, requested.robot.names, unnamed, "robot", ())
    if positions and (not named or (requested.robot.names and len(named) == 3)):
        form = POSE_FORMS.get(requested.robot.form or "")
        unit = requested.robot.unit or (form.unit if form else None)
        poses = np.full((len(fields), 4, 4), np.nan)
        poses[:, :3, 3] = _coordinates(
            fields, *_axes(fields, unit, "--robot-unit", requested.robot.names)
        )
        return _rows_of(fields, path, poses, None)
    joints = requested.joints or joint_columns(tuple(fields.numbers))
    lower = {number.lower() for number in fields.numbers}
    suffixes = ("", *(f"_{unit}" for unit in UNITS_M))
    has_axes = any(lower >= {f"{axis}{suffix}" for axis in "xyz"} for suffix in suffixes)
    if not named and not joints and has_axes:
        raise DataError(
            f"{path.name} has positions without rotations, and a tip beside the flange needs both.",
            culprits=[path.name],
            next_step="Add the rotations, or name all columns with --robot-columns; or, for a "
            "fixture, say --tool none where the positions are of the tip itself.",
        )
    foreign = foreign_from(fields, requested)
    check_radians(foreign.robot, requested.robot, "robot", guesses=False)
    return _rows_of(fields, path, foreign.robot.poses(), foreign.joints_rad)


def robots_of(path: Path) -> tuple[str, ...]:
    """Names of the robots in a table or session of touches, in their order; may be empty.

    Raises:
        DataError: It cannot be read.
    """
    if path.is_dir() or path.suffix.lower() == ".rrd":
        return tuple(filter(None, Session.load(path).robots))
    return tuple(filter(None, dict.fromkeys(read_fields(path).texts.get("robot", ()))))


def _of_robot(fields: Fields, robot: str | None) -> Fields:
    """The rows of one robot, where a column names robots."""
    robots = fields.texts.get("robot", ())
    names = list(dict.fromkeys(robots))
    if len(names) < 2:
        return fields
    if robot is None:
        raise DataError(
            f"{fields.name} has touches of several robots ({some_of(names)}), and which is meant "
            "is not said.",
            culprits=["--robot"],
            next_step=f"Name one: --robot {names[0]}.",
        )
    if robot not in names:
        raise DataError(
            f"{fields.name} has no touches of robot {robot!r}: its robots are {some_of(names)}.",
            culprits=["--robot"],
            next_step=did_you_mean(robot, names),
        )
    return fields.rows([at for at, name in enumerate(robots) if name == robot])


def _rows_of(
    fields: Fields, path: Path, poses: FloatArray, joints_rad: FloatArray | None
) -> TouchRows:
    count = len(fields)
    numbers = fields.views or view_numbers(fields) or tuple(range(count))
    texts = {name.lower(): cells for name, cells in fields.texts.items()}
    empty = ("",) * count
    return TouchRows(
        path.name,
        tuple(map(str, numbers)),
        fields.places,
        poses,
        joints_rad,
        texts.get("kind", empty),
        texts.get("point", empty),
    )


def read_nominal(path: Path, unit: str | None = None) -> NominalPoints:
    """Reads a table of CAD coordinates.

    Args:
        path: A table with a column `point` (or name) and x_m, y_m, z_m, or the same in another unit
            of `UNITS_M`, or x, y, z with the unit given. An optional column sigma_m (sigma_mm ...)
            has each point's standard deviation.
        unit: The unit of x, y, z.

    Raises:
        DataError: Columns are missing, a name occurs twice, or a cell is no number.
    """
    fields = read_fields(path)
    if "qw" in fields.numbers:
        raise DataError(
            f"{path.name} has rotations (qx to qw), as touched poses have; a drawing has a place a "
            "point.",
            culprits=[str(path)],
            next_step="Name the touches first, and the drawing's table with --cad.",
        )
    column = next((name for name in _NAMES if name in fields.texts), None)
    if column is None:
        raise DataError(
            f"{fields.name}: a column {some_of(_NAMES)} is needed, with the name of each point; "
            f"there are {fields.listing()}.",
            culprits=[fields.name],
        )
    names = tuple(text.strip() for text in fields.texts[column])
    if not all(names):
        place = fields.places[names.index("")]
        raise DataError(f"{place}: the point has no name.", culprits=[place])
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise DataError(
            f"{path.name}: point {some_of(twice)} stands there more than once.", culprits=twice
        )
    columns, length_m = _axes(fields, unit, "--cad-unit")
    positions = _coordinates(fields, columns, length_m)
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise DataError(
            f"{fields.places[bad[0]]}: a coordinate is missing.",
            culprits=[fields.places[index] for index in bad],
        )
    units = {f"sigma_{name}": length for name, length in UNITS_M.items()} | {"sigma": length_m}
    column = next((name for name in units if name in fields.numbers), None)
    sigmas_m = np.zeros(len(fields))
    if column is not None:
        sigmas_m = units[column] * np.nan_to_num(fields.column(column)[:, 0])
    if (sigmas_m < 0).any():
        place = fields.places[int(np.argmin(sigmas_m))]
        raise DataError(f"{place}: {column} is negative.", culprits=[place])
    return NominalPoints(path.name, names, positions, sigmas_m)


def _axes(
    fields: Fields, unit: str | None, option: str, given: Sequence[str] = ()
) -> tuple[tuple[str, ...], float]:
    """Finds the columns of x, y, z, and the length of their unit [m]."""
    if unit is not None and unit not in UNITS_M:
        raise DataError(
            f"There is no unit of length named {unit!r}; the names are {some_of(list(UNITS_M))}.",
            culprits=[unit],
        )
    columns = {text.lower(): text for text in (*fields.texts, *fields.numbers)}
    for name, length in UNITS_M.items():
        names = given or [f"{axis}_{name}" for axis in "xyz"]
        if all(column.lower() in columns and column.endswith(f"_{name}") for column in names):
            # An explicit unit overrides those in the columns' names.
            return tuple(columns[name.lower()] for name in names), UNITS_M[unit] if unit else length
    unitless = tuple(given) or tuple(columns.get(axis, "") for axis in "xyz")
    if not all(unitless):
        raise DataError(
            f"{fields.name}: columns x_mm, y_mm, z_mm or x_m, y_m, z_m are needed; there are "
            f"{fields.listing()}.",
            culprits=[fields.name],
        )
    if unit is None:
        raise DataError(
            f"{fields.name}: {', '.join(unitless)} are in no unit that is named.",
            culprits=[fields.name],
            next_step=f"Name the columns x_mm, y_mm, z_mm, or say {option} mm.",
        )
    return unitless, UNITS_M[unit]


def _coordinates(fields: Fields, columns: Sequence[str], length_m: float) -> FloatArray:
    """Reads three columns in a unit of given length: (n, 3) [m]; NaN where a cell is empty."""
    return length_m * np.column_stack([fields.column(column)[:, 0] for column in columns])
