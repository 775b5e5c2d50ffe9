"""Poses as pendants show them and as robots' programs have them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visioncal.core.conventions import write_pose
from visioncal.core.documents.pendants import PendantPose, is_marked_pose, read_pose
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.interchange.formats.fields import Fields

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
