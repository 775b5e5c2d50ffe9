"""Built-in robots, and files that describe robots."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from visioncal.core.documents.jsons import parse_json
from visioncal.core.documents.toml import find_described, read_toml
from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.robot.model import Robot

# Suffixes of robot files; a .json is a chain, as a calibration writes it.
ROBOT_SUFFIXES = (".toml", ".urdf", ".json")


def _shipped() -> dict[str, Path]:
    """Files of the built-in robots, by name."""
    folder = Path(__file__).resolve().parent / "models"
    return {path.stem: path for path in folder.glob("*.toml")}


def robot_names() -> tuple[str, ...]:
    """Names of the built-in robots."""
    return tuple(sorted(_shipped()))


def read_robot_document(
    name_or_path: str, *, tip: str | None = None, folder: Path | None = None
) -> dict[str, Any]:
    """Reads a robot's description without building its model.

    Args:
        name_or_path: A name among `robot_names()`, or the path of a DH `.toml`, a `.urdf` or the
            `.json` of a corrected arm.
        tip: The frame of reported poses: a link or joint of a URDF, or the name that the end of a
            DH table or chain gets.
        folder: Relative paths start here; the working directory where None.

    Returns:
        A self-contained document for `Robot.from_document`, which can be written as JSON.

    Raises:
        DataError: There is no such robot, or its file is too large or malformed.
    """
    path = find_described(
        name_or_path, what="robot", shipped=_shipped(), suffixes=ROBOT_SUFFIXES, folder=folder
    )
    if path.suffix.lower() in (".toml", ".json"):
        is_toml = path.suffix.lower() == ".toml"
        table = read_toml(path, path.name) if is_toml else parse_json(read_text(path), path.name)
        if not isinstance(table, dict) or not (is_toml or "kind" in table):
            raise DataError(
                f"{path.name} describes no robot: it must be an object of kind chain.",
                culprits=[path.name],
                next_step="Write one with visioncal export CALIBRATION --to robot-json.",
            )
        named = {"name": path.stem, "tip": "flange"} | table
        return named if tip is None else named | {"tip": tip}
    return {
        "schema": 1,
        "name": path.stem,
        "tip": tip or "",
        # Bytes, far above the size of any arm's URDF.
        "urdf": read_text(path, 10_000_000),
    }


def robot_file(document: Mapping[str, Any], named: str = "") -> tuple[str, str]:
    """Writes a robot's description as a file that `load_robot` reads: (file name, content).

    The format is that of the file `named`, from which it was read.
    """
    if "urdf" in document:
        return "robot.urdf", str(document["urdf"])
    if named.lower().endswith(".json"):
        return "robot.json", json.dumps(document, indent=2) + "\n"
    return "robot.toml", tomli_w.dumps(document)


def load_robot(name_or_path: str, tip: str | None = None, folder: Path | None = None) -> Robot:
    """Loads a robot's model; the arguments are those of `read_robot_document`; raises DataError."""
    return Robot.from_document(read_robot_document(name_or_path, tip=tip, folder=folder))
