"""Poses as programs print them.

Matrices of four lines each, under a line that says what they are; and translation [m] and
quaternion x, y, z, w of ROS (tf_echo, tf2_echo).
"""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np

from visioncal.core.documents import is_number
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.interchange.formats.fields import Fields

_BETWEEN = re.compile(r"[\s,;\[\]()]+")
_POSE = re.compile(
    r"- Translation: \[([^\[\]]*)\]\s+- Rotation: in Quaternion(?: \(xyzw\))? \[([^\[\]]*)\]"
)
_NAMES = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def printed_fields(path: Path) -> Fields | None:
    """Takes the 4 x 4 matrices of a text, those under one heading as one field.

    Returns:
        The rows; None where the text has fewer than two matrices, or no heading.

    Raises:
        DataError: Headings have different numbers of matrices under them.
    """
    found: dict[str, list[tuple[int, list[list[float]]]]] = defaultdict(list)
    heading, begins = "", 0
    rows: list[list[float]] = []
    for at, line in enumerate(read_plain_text(path).splitlines(), start=1):
        words = [part for part in _BETWEEN.split(line) if part]
        if len(words) == 4 and all(map(is_number, words)):
            begins = begins if rows else at
            rows.append([float(word) for word in words])
        elif words:
            heading, rows = _plain(line), []
        if len(rows) == 4:
            if rows[3] == [0.0, 0.0, 0.0, 1.0]:
                found[heading].append((begins, rows))
            rows = []
    if sum(map(len, found.values())) < 2 or not any(found):
        return None
    counts = {name: len(them) for name, them in found.items()}
    if len(set(counts.values())) > 1:
        listed = some_of([f"{count} under {name!r}" for name, count in counts.items()])
        raise DataError(
            f"{path}: matrices cannot be paired: {listed}; as many of each are needed.",
            culprits=[*counts],
            next_step="Remove those of views of which another is missing.",
        )
    first = next(iter(found.values()))
    places = tuple(f"{path.name}, line {at}" for at, _ in first)
    numbers = {
        name or "matrix": np.array([group for _, group in them]).reshape(-1, 16)
        for name, them in found.items()
    }
    return Fields(path.stem, path.parent, places, numbers)


def _plain(line: str) -> str:
    """A heading without what differs from one to the next: `Pose 3:` is `Pose`."""
    words = re.findall(r"[^\W\d_]+(?:[^\W_]*[^\W\d_])?", line)
    return " ".join(words)[:80]


def echoed_fields(path: Path) -> Fields | None:
    """Takes every pose that was printed; once a second, as the times say, it is no stream.

    Returns:
        The rows; None where the text has none.

    Raises:
        DataError: A pose has not three and four numbers.
    """
    text = read_plain_text(path)
    places, rows = list[str](), list[list[float]]()
    for match in _POSE.finditer(text):
        at = text.count("\n", 0, match.start()) + 1
        places.append(f"{path.name}, line {at}")
        numbers = re.findall(r"[^\s,]+", f"{match[1]},{match[2]}")
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
