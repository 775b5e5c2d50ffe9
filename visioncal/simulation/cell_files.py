"""Descriptions of cells: a TOML file, or the name of a cell that comes with visioncal.

The keys are the fields of `NetworkOptions` and of its parts; `[targets.NAME]` are its boards.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, get_args, get_type_hints

from visioncal.core.choices import SIMULATED_ARMS
from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, find_described, parse_toml, read_text
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Camera, Target
from visioncal.session.document import NAME
from visioncal.simulation.arms import Payload
from visioncal.simulation.boards import TARGETS
from visioncal.simulation.layout import (
    CELL,
    BoardAt,
    CameraAt,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
    Swept,
)
from visioncal.simulation.optics import CAMERAS

Thing: TypeAlias = (
    RobotAt | CameraAt | BoardAt | InstrumentAt | PointAt | Moved | Swept | Payload | NetworkOptions
)
_T = TypeVar("_T", bound=Thing)

_FOLDER = Path(__file__).with_name("cells")
# Named tables of a file: type of their entries, and field of the options.
_KINDS: Mapping[str, tuple[type[Thing], str]] = {
    "robots": (RobotAt, "robots"),
    "cameras": (CameraAt, "cameras"),
    "targets": (BoardAt, "boards"),
    "instruments": (InstrumentAt, "instruments"),
    "points": (PointAt, "points"),
}
_TABLES = (*_KINDS, "moved", "sweeps")
# Largest bow of a board [m].
_MOST_BOW_M = 0.05
# Largest integer.
_MOST = 1_000_000
# Numbers that may be negative.
_SIGNED = ("tilt_rad", "turn_rad", "shift_m", "bow_m", "camera_minus_robot_s")
# Number of joints of every simulated arm.
_JOINTS = 6


def cell_names() -> tuple[str, ...]:
    """Names of the cells that come with visioncal."""
    return tuple(sorted(_shipped()))


def read_cell(name_or_path: str) -> NetworkOptions:
    """Reads the description of a cell.

    Args:
        name_or_path: A name from `cell_names`, or the path of a `.toml`.

    Raises:
        DataError: There is no such cell, or a field is unknown, missing, of another type or out of
            range.
    """
    path = find_described(
        name_or_path, what="cell", shipped=_shipped(), suffixes=(".toml",), folder=None
    )
    document = parse_toml(read_text(path), path.name)
    options = {key: value for key, value in document.items() if key not in _TABLES}
    robots = tuple(_table(document, "robots", path.name))
    if not robots:
        raise DataError(
            f"{path.name}: robots is missing; a table [robots.NAME] for each robot is needed.",
            culprits=[f"{path.name}: robots"],
        )
    reader = _Reader(path.name, (CELL, *robots))
    things: dict[str, tuple[Thing, ...]] = {
        target: tuple(
            reader.read(kind, row, f"{key}.{name}", name=name)
            for name, row in _table(document, key, path.name).items()
        )
        for key, (kind, target) in _KINDS.items()
    }
    if things["points"] and not things["instruments"]:
        raise DataError(
            f"{path.name}: there are points and no instrument that reads them.",
            culprits=[f"{path.name}: points"],
            next_step="Add a table [instruments.NAME], or leave the points out.",
        )
    table = DocumentTable(document, path.name)
    moved = reader.listed(Moved, table, "moved")
    sweeps = reader.listed(Swept, table, "sweeps")
    return reader.read(NetworkOptions, options, "", moved=moved, sweeps=sweeps, **things)


def _shipped() -> dict[str, Path]:
    return {path.stem: path for path in _FOLDER.glob("*.toml")}


def _table(document: Mapping[str, Any], key: str, label: str) -> Mapping[str, Any]:
    content = document.get(key, {})
    if not isinstance(content, dict):
        raise DocumentTable(document, label).refuse(key, content, f"a table [{key}.NAME] for each")
    for name in content:
        if not NAME.fullmatch(name) or name == CELL:
            raise DataError(
                f"{label}: {key}.{name[:40]} is no name: letters, digits and _ after a letter are "
                f"needed, and not {CELL!r}.",
                culprits=[f"{label}: {key}.{name[:40]}"],
            )
    return content


@dataclass(frozen=True)
class _Reader:
    """Reads tables by the types of the fields they fill."""

    file: str  # Name of the file, for messages.
    carriers: tuple[str, ...]  # Possible values of `on`: the cell, and the robots.

    def read(self, kind: type[_T], row: object, path: str, **given: object) -> _T:
        """One table as a dataclass object."""
        label = f"{self.file}, {path}" if path else self.file
        if not isinstance(row, dict):
            raise DocumentTable({path: row}, self.file).refuse(path, row, "a table")
        types = {name: kind for name, kind in get_type_hints(kind).items() if name not in given}
        unknown = sorted(row.keys() - types.keys())
        if unknown:
            known = [*types, *([] if path else _TABLES)]
            raise DataError(
                f"{label}: {unknown[0]} is not known; the fields are {', '.join(known)}.",
                culprits=[f"{label}: {unknown[0]}"],
                next_step=did_you_mean(unknown[0], known),
            )
        needed = {
            field.name
            for field in fields(kind)
            if field.default is MISSING and field.default_factory is MISSING
        }
        table = DocumentTable(row, label)
        values: dict[str, Any] = {
            key: self._value(table, key, hint, kind, path)
            for key, hint in types.items()
            if key in row or key in needed
        }
        return kind(**values | given)

    def listed(
        self, kind: type[_T], table: DocumentTable, key: str, path: str = ""
    ) -> tuple[_T, ...]:
        """A list of tables as dataclass objects."""
        rows, path = table.content.get(key, []), f"{path}.{key}".lstrip(".")
        if not isinstance(rows, list):
            raise table.refuse(key, rows, f"a table [[{path}]] for each")
        return tuple(
            self.read(kind, row, f"{path} {number}") for number, row in enumerate(rows, start=1)
        )

    def _value(self, table: DocumentTable, key: str, hint: object, kind: type, path: str) -> object:
        if hint in (Camera, Target):
            named: Mapping[str, object] = CAMERAS if hint is Camera else TARGETS
            return named[table.choice(key, tuple(named))]
        if key == "robot":
            return table.choice(key, self.carriers[1:] if kind is Swept else SIMULATED_ARMS)
        if key == "on":
            return table.choice(key, self.carriers)
        if hint is bool:
            return table.flag(key, False)
        if hint is str:
            return table.text(key)
        if hint is float:
            return _number(table, key)
        if int in (hint, *get_args(hint)):
            return table.integer(key, 1 if key == "stops" else 0, _MOST)
        if hint == tuple[Payload, ...]:
            return self.listed(Payload, table, key, path)
        if hint == tuple[float, ...]:
            return tuple(table.numbers(key, _JOINTS))
        return tuple(table.numbers(key, 3))


def _number(table: DocumentTable, key: str) -> float:
    """A number, checked against the range of its field."""
    value = table.number(key, positive=key in ("scale", "function_length_rad"))
    if key == "scale" and not 0.5 <= value <= 2.0:
        raise table.refuse(key, value, "a number from 0.5 to 2")
    if key == "bow_m" and abs(value) > _MOST_BOW_M:
        raise table.refuse(key, value, f"a number from -{_MOST_BOW_M} to {_MOST_BOW_M}")
    if key == "share_seen" and not 0.0 < value <= 1.0:
        raise table.refuse(key, value, "a share above 0, up to 1,")
    if key not in _SIGNED and value < 0.0:
        raise table.refuse(key, value, "a number of 0 or more")
    return value
