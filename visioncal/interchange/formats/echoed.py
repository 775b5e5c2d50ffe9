"""Poses as ROS prints them (tf_echo, tf2_echo): a translation [m], a quaternion x, y, z, w."""

import re
from pathlib import Path

import numpy as np

from visioncal.core.documents import is_number
from visioncal.core.documents.bounds import read_plain_text
from visioncal.core.errors import DataError
from visioncal.interchange.formats.fields import Fields

_POSE = re.compile(
    r"- Translation: \[([^\[\]]*)\]\s+- Rotation: in Quaternion(?: \(xyzw\))? \[([^\[\]]*)\]"
)
_NAMES = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def echoed_fields(path: Path) -> Fields | None:
    """Takes every pose that was printed; once a second, as the times say, it is no stream.

    Returns:
        The rows; None where the text has none.

    Raises:
        DataError: A pose has not three and four numbers.
    """
    text = read_plain_text(path)
    places, rows = list[str](), list[list[float]]()
    for it in _POSE.finditer(text):
        at = text.count("\n", 0, it.start()) + 1
        places.append(f"{path.name}, line {at}")
        numbers = re.findall(r"[^\s,]+", f"{it[1]},{it[2]}")
        if len(numbers) != len(_NAMES) or not all(map(is_number, numbers)):
            raise DataError(
                f"{places[-1]}: a translation of 3 numbers and a quaternion of 4 are needed.",
                culprits=[places[-1]],
            )
        rows.append([float(number) for number in numbers])
    if not rows:
        return None
    columns = dict(zip(_NAMES, np.array(rows).T, strict=True))
    return Fields(path.stem, path.parent, tuple(places), columns)
