"""Files of touches and of CAD points: tables in any form that `convert` reads."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visioncal.conventions import UNITS_M
from visioncal.errors import DataError
from visioncal.files import some_of
from visioncal.formats.columns import foreign_from, read_fields
from visioncal.formats.fields import Fields
from visioncal.formats.wishes import Wishes
from visioncal.frames.touches import TouchRows, touches_of
from visioncal.session import Session
from visioncal.types import FloatArray

_NAMES = ("point", "name", "label", "id")


def read_touches(path: Path, wishes: Wishes) -> TouchRows:
    """Reads touches.

    Args:
        path: A table with the columns of views.csv, `kind` and `point`; of these, only the pose or
            the joints have to be there. Or a session, whose rows have them.
        wishes: How poses and joints are written, where the columns do not say.

    Raises:
        DataError: It cannot be read, or a row is no pose.
    """
    if path.is_dir() or path.suffix.lower() == ".rrd":
        return touches_of(Session.load(path))
    fields = read_fields(path)
    foreign = foreign_from(fields, wishes)
    count = len(fields)
    numbers = foreign.views or tuple(range(count))
    nothing = ("",) * count
    return TouchRows(
        path.name,
        tuple(map(str, numbers)),
        fields.places,
        foreign.robot.poses(),
        foreign.joints_rad,
        foreign.columns.get("kind", nothing),
        foreign.columns.get("point", nothing),
    )


@dataclass(frozen=True, eq=False)
class NominalPoints:
    """Points as a drawing has them, n in all.

    Attributes:
        names: (n,) their names, each once.
        positions: (n, 3) [m] in the drawing's frame.
        sigma_m: (n,) how well each is known [m]; 0 where the drawing is taken as exact.
    """

    names: tuple[str, ...]
    positions: FloatArray
    sigma_m: FloatArray


def read_nominal(path: Path, unit: str | None = None) -> NominalPoints:
    """Reads a table of CAD coordinates.

    Args:
        path: A table with a column `point` (or name) and x_m, y_m, z_m, or the same in another unit
            of `UNITS_M`, or x, y, z with the unit given. A column sigma_m (sigma_mm ...) may say
            how well each is known.
        unit: What x, y, z are in.

    Raises:
        DataError: Columns are missing, a name stands there twice, or a cell is no number.
    """
    fields = read_fields(path)
    names = _names(fields)
    twice = [it for it in dict.fromkeys(names) if names.count(it) > 1]
    if twice:
        raise DataError(
            f"{path.name}: point {some_of(twice)} stands there more than once.", culprits=twice
        )
    suffix, scale = _unit(fields, path, unit)
    positions = np.column_stack([fields.column(f"{axis}{suffix}")[:, 0] for axis in "xyz"])
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise DataError(
            f"{fields.places[bad[0]]}: a coordinate is missing.",
            culprits=[fields.places[it] for it in bad],
        )
    sigma = np.zeros(len(fields))
    if f"sigma{suffix}" in fields.numbers:
        sigma = np.nan_to_num(fields.column(f"sigma{suffix}")[:, 0])
    if (sigma < 0).any():
        place = fields.places[int(np.argmin(sigma))]
        raise DataError(f"{place}: a sigma is negative.", culprits=[place])
    return NominalPoints(names, scale * positions, scale * sigma)


def _names(fields: Fields) -> tuple[str, ...]:
    column = next((it for it in _NAMES if it in fields.texts), None)
    if column is None:
        raise DataError(
            f"{fields.name}: a column {some_of(_NAMES)} is needed, with the name of each point; "
            f"there are {fields.listing()}.",
            culprits=[fields.name],
        )
    names = tuple(it.strip() for it in fields.texts[column])
    if not all(names):
        place = fields.places[names.index("")]
        raise DataError(f"{place}: the point has no name.", culprits=[place])
    return names


def _unit(fields: Fields, path: Path, unit: str | None) -> tuple[str, float]:
    """Finds the columns' suffix and the length of their unit [m]."""
    for name, length in UNITS_M.items():
        if all(f"{axis}_{name}" in fields.numbers for axis in "xyz"):
            return f"_{name}", length
    if not _has(fields, ("x", "y", "z")):
        raise DataError(
            f"{path.name}: columns x_mm, y_mm, z_mm or x_m, y_m, z_m are needed; there are "
            f"{fields.listing()}.",
            culprits=[path.name],
        )
    if unit is None:
        raise DataError(
            f"{path.name}: x, y, z are in no unit that is named.",
            culprits=[path.name],
            next_step="Name the columns x_mm, y_mm, z_mm, or say --cad-unit mm.",
        )
    if unit not in UNITS_M:
        raise DataError(
            f"There is no unit of length named {unit!r}; the names are {some_of(list(UNITS_M))}.",
            culprits=[unit],
        )
    return "", UNITS_M[unit]


def _has(fields: Fields, names: Sequence[str]) -> bool:
    return all(it in fields.numbers for it in names)
