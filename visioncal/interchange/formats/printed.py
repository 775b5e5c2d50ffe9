"""Poses as programs print them, as pendants show them and as robots' programs have them.

Matrices of four lines each, under a line that says what they are; and translation [m] and
quaternion x, y, z, w of ROS (tf_echo, tf2_echo).
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visioncal.core.conventions import write_pose
from visioncal.core.documents import is_number
from visioncal.core.documents.pendants import PendantPose, is_marked_pose, read_pose
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.interchange.formats.fields import Fields

_BETWEEN = re.compile(r"[\s,;\[\]()]+")
_POSE = re.compile(
    r"- Translation: \[([^\[\]]*)\]\s+- Rotation: in Quaternion(?: \(xyzw\))? \[([^\[\]]*)\]"
)
_POSE_NAMES = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")

# Programs of FANUC, KUKA, ABB and Universal Robots.
PROGRAMS = (".ls", ".dat", ".src", ".mod", ".modx", ".script", ".urscript")
# Names under which poses are looked for, by how many numbers they have.
_NAMES = {6: ("x", "y", "z", "rx", "ry", "rz"), 7: ("x", "y", "z", "q1", "q2", "q3", "q4")}
_IMAGE = re.compile(r"[^\s,;\"']+\.(?:png|jpe?g|tiff?|bmp)(?![\w.])", re.IGNORECASE)
_COMMENTS = ("#", "%", "//", "!")
_REMARKS = ("#", "!", ";", "&")
_STATEMENT = re.compile(r"(?:[^\n{}]++|\{[^{}]*+\})++")
# Poses of something else than the flange or the tool at a stop.
_NO_STOP = re.compile(r"tooldata|wobjdata|set_tcp|TOOL_DATA|BASE_DATA|\bFRAME\b|offs\s*\(", re.I)


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
        if len(numbers) != len(_POSE_NAMES) or not all(map(is_number, numbers)):
            raise DataError(
                f"{places[-1]}: a translation of 3 numbers and a quaternion of 4 are needed.",
                culprits=[places[-1]],
            )
        rows.append([float(number) for number in numbers])
    if not rows:
        return None
    columns = dict(zip(_POSE_NAMES, np.array(rows).T, strict=True))
    return Fields(path.stem, path.parent, tuple(places), columns)


def pendant_fields(path: Path) -> Fields | None:
    """Takes the lines of a text file that hold poses, each with its image where it names one.

    Returns:
        The rows; None where the first lines hold no pose with a maker's marks.

    Raises:
        DataError: A line has no pose, or another maker's than the first.
    """
    lines = [
        (at, line)
        for at, line in enumerate(read_plain_text(path).splitlines(), start=1)
        if line.strip() and not line.strip().startswith(_COMMENTS)
    ]
    # A header may stand first.
    first = next((at for at, (_, line) in enumerate(lines[:2]) if is_marked_pose(line)), None)
    return None if first is None else _fields_of_lines(path, lines[first:])


def program_fields(path: Path) -> Fields:
    """Takes the taught poses of a robot's program; tools, bases and joints of it are left aside.

    Raises:
        DataError: There are none, or they are in several forms.
    """
    text = read_plain_text(path)
    # FANUC writes a position in several lines, between braces.
    lines = [
        (text.count("\n", 0, match.start()) + 1, match[0].replace("\n", " "))
        for match in _STATEMENT.finditer(text)
        if not match[0].lstrip().startswith(_REMARKS) and _NO_STOP.search(match[0]) is None
    ]
    poses = [line for line in lines if is_marked_pose(line[1])]
    if not poses:
        raise DataError(f"{path} has no taught poses that are known.", culprits=[str(path)])
    return _fields_of_lines(path, poses)


def _fields_of_lines(path: Path, lines: Sequence[tuple[int, str]]) -> Fields:
    places = tuple(f"{path.name}, line {at}" for at, _ in lines)
    texts = [line for _, line in lines]
    images = tuple(found[0] if (found := _IMAGE.search(text)) else "" for text in texts)
    poses = [
        read_pose(_IMAGE.sub(" ", text), place) for text, place in zip(texts, places, strict=True)
    ]
    form = poses[0].form
    _check_one_form(poses, places)
    numbers = np.array([write_pose(pose.pose, form) for pose in poses])
    columns = dict(zip(_NAMES[numbers.shape[1]], numbers.T, strict=True))
    named = {"image": images} if any(images) else {}
    return Fields(path.stem, path.parent, places, columns, named, form=form.name)


def _check_one_form(poses: list[PendantPose], places: tuple[str, ...]) -> None:
    form = poses[0].form
    others = [place for place, pose in zip(places, poses, strict=True) if pose.form != form]
    if others:
        raise DataError(
            f"{some_of(others)}: another maker's form than {form.words}, as {places[0]} has.",
            culprits=others,
            next_step="Put the poses of one robot into a file of their own.",
        )
