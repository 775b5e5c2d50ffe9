"""The robots that come with visioncal, and the files that describe others."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from visioncal.core.documents.jsons import parse_json
from visioncal.core.errors import DataError
from visioncal.core.files import find_described, read_text, read_toml
from visioncal.robot.model import Robot

# Far above any arm's URDF; a larger file is something else.
_MAX_URDF_BYTES = 10_000_000
# How the name of a robot's file ends; a .json is a chain, as a calibration writes it.
ROBOT_SUFFIXES = (".toml", ".urdf", ".json")


def _shipped() -> dict[str, Path]:
    """The robots that come with visioncal, by name."""
    folder = Path(__file__).resolve().parent / "models"
    return {path.stem: path for path in folder.glob("*.toml")}


def robot_names() -> tuple[str, ...]:
    """Lists the names of the robots that come with visioncal."""
    return tuple(sorted(_shipped()))


def read_robot_document(
    name_or_path: str, *, tip: str | None = None, folder: Path | None = None
) -> dict[str, Any]:
    """Reads a robot's description without building its model.

    Args:
        name_or_path: A name among `robot_names()`, or the path of a DH `.toml`, a `.urdf` or the
            `.json` of a corrected arm.
        tip: The frame that poses are of. A DH table or a chain has one end, which gets this name;
            in a URDF it is a link or joint.
        folder: Relative paths start here; the working directory where None.

    Returns:
        What `Robot.from_document` needs, with nothing else; it can be written as JSON.

    Raises:
        DataError: There is no such robot, or its file is too large, no TOML or no JSON.
    """
    path = find_described(
        name_or_path, what="robot", shipped=_shipped(), suffixes=ROBOT_SUFFIXES, folder=folder
    )
    if path.suffix.lower() in (".toml", ".json"):
        is_toml = path.suffix.lower() == ".toml"
        table = read_toml(path, path.name) if is_toml else _parse_json(read_text(path), path.name)
        named = {"name": path.stem, "tip": "flange"} | table
        return named if tip is None else named | {"tip": tip}
    return {
        "schema": 1,
        "name": path.stem,
        "tip": tip or "",
        "urdf": read_text(path, _MAX_URDF_BYTES),
    }


def _parse_json(text: str, label: str) -> dict[str, Any]:
    found = parse_json(text, label)
    if isinstance(found, dict) and "kind" in found:
        return found
    raise DataError(
        f"{label} describes no robot: an object of kind chain is needed.",
        culprits=[label],
        next_step="Write one with visioncal export CALIBRATION --to robot-json.",
    )


def robot_file(document: Mapping[str, Any], named: str = "") -> tuple[str, str]:
    """Writes a robot's description as a file that `load_robot` reads: (file name, content).

    Args:
        document: The description.
        named: The name of the file that it was read from, whose form is kept.
    """
    if "urdf" in document:
        return "robot.urdf", str(document["urdf"])
    if named.lower().endswith(".json"):
        return "robot.json", json.dumps(document, indent=2) + "\n"
    return "robot.toml", tomli_w.dumps(document)


def load_robot(name_or_path: str, tip: str | None = None, folder: Path | None = None) -> Robot:
    """Loads a robot's model; the arguments are those of `read_robot_document`.

    Raises:
        DataError: There is no such robot, or its description is wrong.
    """
    return Robot.from_document(read_robot_document(name_or_path, tip=tip, folder=folder))
