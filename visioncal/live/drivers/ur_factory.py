"""The maker's calibration of a UR: the arm's own table of joints instead of the data sheet's."""

import configparser
import re
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.core.types import FloatArray
from visioncal.live.drivers.ur_primary import JointTable, read_joint_table
from visioncal.robot import read_robot_document

_SECTION = "mounting"
_JOINTS = 6
# The columns of a table, and their keys in a robot's description and in the controller's file.
_COLUMNS = {
    "theta_rad": ("theta_offset_rad", "delta_theta"),
    "a_m": ("a_m", "delta_a"),
    "d_m": ("d_m", "delta_d"),
    "alpha_rad": ("alpha_rad", "delta_alpha"),
}


def read_factory_dh(host: str) -> JointTable:
    """Reads the maker's calibration from a running controller.

    Args:
        host: The controller's address.

    Raises:
        DriverError: The controller cannot be reached, or does not report it.
    """
    return read_joint_table(host)


def read_factory_file(path: Path, model: str) -> JointTable:
    """Reads the maker's calibration from a controller's file, `/root/.urcontrol/calibration.conf`.

    The file says how the arm departs from the data sheet.

    Args:
        path: The file.
        model: The arm, a name among `robot_names()`, as `ur10e`.

    Raises:
        DataError: The file is missing or holds something else.
    """
    parser = configparser.ConfigParser(inline_comment_prefixes=("#",))
    try:
        parser.read_string(read_text(path))
        section = parser[_SECTION]
        deltas = {name: _numbers(section[key]) for name, (_, key) in _COLUMNS.items()}
        checksum = tuple(int(it) for it in _numbers(section.get("joint_checksum", "[]")))
    except (configparser.Error, KeyError, ValueError) as error:
        raise DataError(
            f"{path} is no calibration of a UR: {error}.",
            culprits=[str(path)],
            next_step="Copy /root/.urcontrol/calibration.conf from the controller.",
        ) from error
    short = [name for name, values in deltas.items() if len(values) != _JOINTS]
    if short:
        keys = ", ".join(_COLUMNS[it][1] for it in short)
        raise DataError(
            f"{path}: {keys} must have {_JOINTS} numbers each.", culprits=[f"{path}: {keys}"]
        )
    nominal = _nominal(model)
    built = {name: nominal[name] + deltas[name] for name in _COLUMNS}
    return JointTable(**built, checksum=checksum)


def factory_document(table: JointTable, model: str) -> dict[str, Any]:
    """Puts the maker's calibration into a robot's description.

    Args:
        table: The calibration.
        model: The arm, a name among `robot_names()`, whose names, limits and bodies stay.

    Returns:
        The description, as `visioncal.robot.robot_file` writes and `Robot.from_document` reads it.

    Raises:
        DataError: There is no such robot.
    """
    document = read_robot_document(model)
    rows = [dict(row) for row in document["joint"]]
    for place, row in enumerate(rows):
        for name, (key, _) in _COLUMNS.items():
            row[key] = float(getattr(table, name)[place])
    checksum = " ".join(f"{it:08x}" for it in table.checksum)
    source = f"the maker's calibration {checksum}".strip()
    return document | {"name": f"{document['name']} as built", "source": source, "joint": rows}


def _nominal(model: str) -> dict[str, FloatArray]:
    rows = read_robot_document(model)["joint"]
    return {name: np.array([row[key] for row in rows]) for name, (key, _) in _COLUMNS.items()}


def _numbers(text: str) -> FloatArray:
    """Reads a list as the controller writes it: `[ 1.0e-5, 2, ...]`; checksums are hexadecimal."""
    words = re.findall(r"[^\s,\[\]]+", text)
    return np.array([int(it, 16) if it.lower().startswith("0x") else float(it) for it in words])
