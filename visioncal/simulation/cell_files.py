"""Descriptions of cells: a TOML file, or the name of a cell that comes with visioncal.

The keys are the fields of `NetworkOptions` and of its parts; `[targets.NAME]` are its boards.
"""

from pathlib import Path

from visioncal.core.codec import read, reading
from visioncal.core.documents.toml import find_described, parse_toml
from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.simulation.layout import NetworkOptions

_FOLDER = Path(__file__).with_name("cells")


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
        options = read(NetworkOptions, {"cameras": {}, "targets": {}, **document}, "")
        if not document.get("robots"):
            raise DataError(
                "robots is missing, but must have a table [robots.NAME] for each robot.",
                culprits=["robots"],
            )
        if options.points and not options.instruments:
            raise DataError(
                "there are points and no instrument that reads them.",
                culprits=["points"],
                next_step="Add a table [instruments.NAME], or leave the points out.",
            )
        return options
