"""Poses that HALCON has written, a file each: `f 0`, `r` with a rotation, `t` with a place [m]."""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.documents import is_number
from visioncal.core.documents.bounds import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray

_LINE = re.compile(r"^[ \t]*([frt])[ \t]+(\S.*)$", re.MULTILINE)
# How the rotation is written, by the code of the representation (create_pose): turns about x, y, z
# in the order of the letters' turns, or a vector as long as the tangent of half the angle.
_EULER = {0: "XYZ", 2: "xyz"}
_RODRIGUEZ = 4


def halcon_pose(path: Path) -> FloatArray | None:
    """Reads the (4, 4) pose of one file.

    Returns:
        It; None where the file is none of HALCON's.

    Raises:
        DataError: A number is missing, or the pose is in a representation that is not read.
    """
    lines = {it[1]: it[2].split() for it in _LINE.finditer(read_plain_text(path))}
    if lines.keys() != {"f", "r", "t"}:
        return None
    counts = {name: len(words) for name, words in lines.items()}
    if counts != {"f": 1, "r": 3, "t": 3} or not all(
        is_number(it) for them in lines.values() for it in them
    ):
        raise DataError(f"{path}: f, r and t hold 1, 3 and 3 numbers.", culprits=[str(path)])
    (code,), turns, position = (np.array(lines[it], dtype=float) for it in "frt")
    if code == _RODRIGUEZ:
        half = np.arctan(np.linalg.norm(turns))
        rotation = Rotation.from_rotvec(2.0 * half * turns / max(float(np.tan(half)), 1e-300))
    elif code in _EULER:
        rotation = Rotation.from_euler(_EULER[int(code)], turns, degrees=True)
    else:
        raise DataError(
            f"{path}: the pose is of type {code:g}; {_RODRIGUEZ} and {[*_EULER]} are read.",
            culprits=[str(path)],
            next_step="Write it with convert_pose_type as 'Rp+T', 'gba', 'point'.",
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose
