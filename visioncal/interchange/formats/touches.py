"""Reads touches and CAD points from tables in any form that `convert` reads."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from visioncal.core.conventions import POSE_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray
from visioncal.frames.touches import NominalPoints, TouchRows, touches_of
from visioncal.interchange.formats.columns import foreign_from, view_numbers
from visioncal.interchange.formats.fields import Fields, named_by, without_unit
from visioncal.interchange.formats.foreign import ImportOptions, PoseImportOptions
from visioncal.interchange.formats.pose_forms import check_radians, poses_from
from visioncal.interchange.formats.pose_words import words_of
from visioncal.interchange.formats.poses import columns_named, pose_names
from visioncal.interchange.formats.reading import best_of, read_fields
from visioncal.interchange.formats.sources import describe, rows_in
from visioncal.interchange.formats.unread import point_pairs
from visioncal.session import Session
from visioncal.session.columns import POSE, joint_columns

_NAMES = ("point", "name", "label", "id")
_AXES = ("x", "y", "z")


def read_touches(
    path: Path, requested: ImportOptions, robot: str | None = None, *, positions: bool = False
) -> TouchRows:
    """Reads touches.

    Args:
        path: A table with the columns of views.csv, `kind` and `point`, of which only the pose or
            the joints are required; a folder of such tables, or a session, whose rows have them.
        requested: Convention of poses and joints, where the columns do not show it.
        robot: Which robot of a cell is meant, where a session or a column `robot` has several.
        positions: Whether a table without rotations is accepted: x_m, y_m, z_m, or x, y, z with the
            unit given.

    Raises:
        DataError: It cannot be read, or a row is no pose.
    """
    if is_session(path):
        return touches_of(Session.load(path), robot)
    given, joints_rad, written = requested.robot, None, None
    fields = _of_robot(_read(path, given.form or given.usual), robot)
    named = pose_names(fields, given.names, "robot", (), by_shape=False)
    if positions and (not named or (given.names and len(named) == 3)):
        maker = POSE_FORMS.get(given.form or "")
        unit = given.unit or (maker.unit if maker else None)
        poses = np.full((len(fields), 4, 4), np.nan)
        poses[:, :3, 3], _ = _coordinates(fields, given.names, unit, "--robot-unit")
    else:
        has_joints = bool(requested.joints or joint_columns(tuple(fields.numbers)))
        if not named and not has_joints and columns_named(fields, _AXES):
            raise DataError(
                f"{path.name} has positions without rotations, and a tip beside the flange needs "
                "both.",
                culprits=[path.name],
                next_step="Add the rotations, or name all of them with --robot-"
                f"{named_by(fields.places[0])}; or, for a fixture, say --tool none where the "
                "positions are of the tip itself.",
            )
        foreign = foreign_from(fields, requested)
        check_radians(foreign.robot, given, "robot", guesses=False)
        written, joints_rad = foreign.robot, foreign.joints_rad
        poses = written.poses()
    numbers = fields.views or view_numbers(fields) or range(len(fields))
    texts = {name.lower(): cells for name, cells in fields.texts.items()}
    kinds, points = (texts.get(name, ("",) * len(fields)) for name in ("kind", "point"))
    labels = tuple(map(str, numbers))
    places, notes = fields.places, fields.notes
    return TouchRows(path.name, labels, places, poses, joints_rad, kinds, points, written, notes)


def is_session(path: Path) -> bool:
    """Whether touches are a session's rows: a recording, or a folder but of tables alone."""
    return path.suffix.lower() == ".rrd" or (path.is_dir() and not _tables_in(path))


def _tables_in(folder: Path, form: str | None = None) -> list[Fields]:
    """Rows of the tables in a folder that is no session and has no images, as of a touch each."""
    if any(file for at in ("", "*/") for file in folder.glob(f"{at}session.toml")):
        return []
    source = describe(folder, form)
    return [] if source.images else rows_in(source)


def _read(path: Path, form: str | None = None) -> Fields:
    return best_of(_tables_in(path, form)) if path.is_dir() else read_fields(path, form)


def read_point_pairs(path: Path) -> tuple[TouchRows, NominalPoints] | None:
    """Reads a robot's points and a camera's of one source; None of others, as of poses.

    Raises:
        DataError: It cannot be read, or no rigid motion maps the pairs.
    """
    source = describe(path)
    pairs = point_pairs(source)
    if pairs is None or any("qw" in rows.numbers for rows in rows_in(source)):
        return None
    if not pairs.agree:
        raise DataError(
            f"{path.name} has no pairs of points of robot and camera that agree.",
            culprits=[str(path)],
            next_step="Name the touches first, and the drawing's table with --cad.",
        )
    robot_points, camera_points = pairs.points
    labels = tuple(map(str, range(len(robot_points))))
    poses = np.full((len(robot_points), 4, 4), np.nan)
    poses[:, :3, 3] = robot_points
    kinds = ("point",) * len(robot_points)
    rows = TouchRows(path.name, labels, pairs.places, poses, None, kinds, labels)
    return rows, NominalPoints(path.name, labels, camera_points, np.zeros(len(camera_points)))


def read_typed(path: Path, given: PoseImportOptions) -> tuple[tuple[str, ...], PoseNumbers] | None:
    """Columns of poses in a maker's form, and the poses; None where there are none.

    Raises:
        DataError: The table cannot be read, or its poses are in another form.
    """
    fields = read_fields(path, given.form or given.usual)
    # A robot moves to these: their names must say what they are.
    names = pose_names(fields, (), "robot", (), by_shape=False)
    words = {word for name in names for word in words_of(name)}
    # A real part that was lost, or has another name, would turn it elsewhere.
    is_known = not {"qx", "qy", "qz"} <= words or bool({"qw", "w"} & words)
    is_ours = not names or names == POSE or not is_known
    return None if is_ours else (names, poses_from(fields, names, given, "robot")[0])


def robots_of(path: Path) -> tuple[str, ...]:
    """Names of the robots in a table or session of touches, in their order; may be empty.

    Raises:
        DataError: A session cannot be read.
    """
    if is_session(path):
        return tuple(filter(None, Session.load(path).robots))
    with suppress(DataError):
        return tuple(filter(None, dict.fromkeys(_read(path).texts.get("robot", ()))))
    # A pendant's lines name none, whosever form they are in.
    return ()


def _of_robot(fields: Fields, robot: str | None) -> Fields:
    """The rows of one robot, where a column names robots."""
    robots = fields.texts.get("robot", ())
    names = list(dict.fromkeys(robots))
    if len(names) < 2:
        return fields
    if robot not in names:
        raise DataError(
            f"{fields.name} has touches of several robots ({some_of(names)}), and "
            f"{'none is chosen' if robot is None else f'none of {robot!r}'}.",
            culprits=["--robot"],
            next_step=did_you_mean(robot or "", names) or f"Name one: --robot {names[0]}.",
        )
    return fields.rows([at for at, name in enumerate(robots) if name == robot])


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
            f"{path.name} has rotations (qx to qw), as touched poses have; a drawing has one place "
            "per point.",
            culprits=[str(path)],
            next_step="Name the touches first, and the drawing's table with --cad.",
        )
    column = next((name for name in _NAMES if name in fields.texts), None)
    if column is None:
        also = "" if columns_named(fields, _AXES) else ", and x_mm, y_mm, z_mm"
        raise DataError(
            f"{fields.name} must have a column {some_of(_NAMES)}, with the name of each point"
            f"{also}, but has {fields.listing()}.",
            culprits=[fields.name],
        )
    names = tuple(text.strip() for text in fields.texts[column])
    positions, length_m = _coordinates(fields, (), unit, "--cad-unit")
    sigmas_m = np.zeros(len(fields))
    for column in fields.numbers:
        plain, unit = without_unit(column)
        if plain.lower() == "sigma":
            sigmas_m = UNITS_M.get(unit, length_m) * np.nan_to_num(fields.column(column)[:, 0])
    twice = {name for name in names if names.count(name) > 1}
    for place, name, position, sigma_m in zip(
        fields.places, names, positions, sigmas_m, strict=True
    ):
        fault = "" if name else "the point has no name"
        fault = f"point {name} stands there more than once" if name in twice else fault
        fault = fault if np.isfinite(position).all() else "a coordinate is missing"
        fault = fault if sigma_m >= 0.0 else "the sigma is negative"
        if fault:
            raise DataError(f"{place}: {fault}.", culprits=[place])
    return NominalPoints(path.name, names, positions, sigmas_m)


def _coordinates(
    fields: Fields, given: Sequence[str], unit: str | None, option: str
) -> tuple[FloatArray, float]:
    """Positions (n, 3) [m], NaN where a cell is empty, and the length of their unit [m]."""
    names = tuple(map(fields.find, given)) or columns_named(fields, _AXES)
    if not names:
        raise DataError(
            f"{fields.name} must have columns x_mm, y_mm, z_mm or x_m, y_m, z_m, but has "
            f"{fields.listing()}.",
            culprits=[fields.name],
        )
    named = {without_unit(name)[1] for name in names}
    unit = unit or (named.pop() if len(named) == 1 else "")
    if not unit:
        raise DataError(
            f"{fields.name}: {', '.join(names)} are in no unit that is named.",
            culprits=[fields.name],
            next_step=f"Name the columns x_mm, y_mm, z_mm, or say {option} mm.",
        )
    length_m = UNITS_M[PoseImportOptions(unit=unit).reading(Reading()).unit]
    return length_m * np.column_stack([fields.column(name)[:, 0] for name in names]), length_m
