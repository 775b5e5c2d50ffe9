"""Descriptions of cells: a TOML file, or the name of a cell that comes with visioncal.

The keys are the fields of `NetworkOptions` and of its parts; `[targets.NAME]` are its boards.
"""

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from visioncal.core.codec import read, reading
from visioncal.core.documents.toml import find_described, parse_toml
from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.core.number_format import did_you_mean
from visioncal.session.document import NAME
from visioncal.simulation.arms import Payload
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

_FOLDER = Path(__file__).with_name("cells")
# Tables of a file by name, and lists of tables, with the type of their entries.
_NAMED: Mapping[str, type] = {
    "robots": RobotAt,
    "cameras": CameraAt,
    "targets": BoardAt,
    "instruments": InstrumentAt,
    "points": PointAt,
}
_LISTED: Mapping[str, type] = {"moved": Moved, "sweeps": Swept, "payloads": Payload}
# Ranges of numbers; others are of 0 or more, but for lists and for those that may be negative.
_RANGES = {"scale": (0.5, 2.0), "bow_m": (-0.05, 0.05), "share_seen": (1e-6, 1.0)}
_SIGNED = ("tilt_rad", "turn_rad", "shift_m", "camera_minus_robot_s")


def read_cell(name_or_path: str) -> NetworkOptions:
    """Reads the description of a cell.

    Args:
        name_or_path: A name among `SIMULATED_CELLS`, or the path of a `.toml`.

    Raises:
        DataError: There is no such cell, or a field is unknown, missing, of another type or out of
            range.
    """
    shipped = {path.stem: path for path in _FOLDER.glob("*.toml")}
    path = find_described(
        name_or_path, what="cell", shipped=shipped, suffixes=(".toml",), folder=None
    )
    document = parse_toml(read_text(path), path.name)
    with reading(path.name, "a cell", "See the README of simulation for its keys."):
        content = {key: value for key, value in document.items() if key not in _NAMED}
        _check(NetworkOptions, content, "", (*_NAMED,))
        for key, kind in _NAMED.items():
            rows = document.get(key, {})
            if not (isinstance(rows, dict) and all(isinstance(row, dict) for row in rows.values())):
                raise DataError(
                    f"{key} is {rows!r:.60}, but must be tables [{key}.NAME].", culprits=[key]
                )
            for name, row in rows.items():
                if not NAME.fullmatch(name) or name == CELL:
                    raise DataError(
                        f"{key}.{name[:40]} must be a name of letters, digits and _ after a "
                        f"letter, and not {CELL!r}.",
                        culprits=[f"{key}.{name[:40]}"],
                    )
                _check(kind, row, f"{key}.{name}.")
            named = [{"name": name, **row} for name, row in rows.items()]
            content["boards" if key == "targets" else key] = named
        if not content["robots"]:
            raise DataError(
                "robots is missing, but must have a table [robots.NAME] for each robot.",
                culprits=["robots"],
            )
        if content["points"] and not content["instruments"]:
            raise DataError(
                "there are points and no instrument that reads them.",
                culprits=["points"],
                next_step="Add a table [instruments.NAME], or leave the points out.",
            )
        return read(NetworkOptions, content, "")


def _check(kind: type, row: Mapping[str, Any], path: str, tables: tuple[str, ...] = ()) -> None:
    """Checks that the keys of a table are known, and the ranges of its numbers."""
    known = [*dict.fromkeys((*(field.name for field in fields(kind)), *tables))]
    known = [name for name in known if name not in ("boards", "name")]
    for key, value in row.items():
        if key not in known:
            raise DataError(
                f"{path}{key} is not known; the fields are {', '.join(known)}.",
                culprits=[f"{path}{key}"],
                next_step=did_you_mean(key, known),
            )
        if key in _LISTED:
            for number, part in enumerate(value, start=1):
                _check(_LISTED[key], part, f"{path}{key} {number}.")
        numbers = value if isinstance(value, list) else [value]
        least = -math.inf if numbers is value or key in _SIGNED else 0.0
        low, high = _RANGES.get(key, (least, math.inf))
        for number in numbers:
            is_number = isinstance(number, int | float)
            if is_number and not (math.isfinite(number) and low <= number <= high):
                raise DataError(
                    f"{path}{key} is {value}, but must be a number from {low:g} to {high:g}.",
                    culprits=[f"{path}{key}"],
                )
