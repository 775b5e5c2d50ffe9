"""Reads files as rows of named values: tables, documents, arrays, and poses in texts.

Poses in texts are printed by programs, shown by pendants, or taught in robot programs.

Printed poses are matrices of four lines each, below a heading; or ROS's translation [m] and
quaternion x, y, z, w (tf_echo, tf2_echo).
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from visioncal.core.conventions import write_pose
from visioncal.core.documents import is_number, read_json, read_table
from visioncal.core.documents.arrays import read_npy, read_npz
from visioncal.core.documents.pendants import is_marked_pose, read_pose
from visioncal.core.documents.structured import read_opencv, read_yaml
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.interchange.formats.fields import (
    Fields,
    fields_of_arrays,
    fields_of_records,
    fields_of_table,
    flattened,
)

_SEPARATORS = re.compile(r"[\s,;\[\]()]+")
_POSE = re.compile(
    r"- Translation: \[([^\[\]]*)\]\s+- Rotation: in Quaternion(?: \(xyzw\))? \[([^\[\]]*)\]"
)
_POSE_NAMES = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")

# Programs of FANUC, KUKA, ABB and Universal Robots.
_PROGRAMS = (".ls", ".dat", ".src", ".mod", ".modx", ".script", ".urscript")
DOCUMENTS = (".json", ".yaml", ".yml", ".xml")
ENDINGS = (".csv", ".tsv", ".txt", ".log", ".npz", ".npy", *DOCUMENTS, *_PROGRAMS)
# Field names of a pose by its number of values.
_NAMES = {6: ("x", "y", "z", "rx", "ry", "rz"), 7: ("x", "y", "z", "q1", "q2", "q3", "q4")}
_IMAGE = re.compile(r"[^\s,;\"']+\.(?:png|jpe?g|tiff?|bmp)(?![\w.])", re.IGNORECASE)
_COMMENTS = ("#", "%", "//", "!")
_PROGRAM_COMMENTS = ("#", "!", ";", "&")
_STATEMENT = re.compile(r"(?:[^\n{}]++|\{[^{}]*+\})++")
# Poses other than of the flange or the tool at a stop.
_NOT_A_STOP = re.compile(r"tooldata|wobjdata|set_tcp|TOOL_DATA|BASE_DATA|\bFRAME\b|offs\s*\(", re.I)


def read_fields(path: Path) -> Fields:
    """Reads a table, JSON, YAML, .npz or .npy as rows of named values.

    Raises:
        DataError: It cannot be read, or holds no rows.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return fields_of_arrays(read_npz(path), path)
    if suffix == ".npy":
        return fields_of_arrays({"value": read_npy(path)}, path)
    if suffix in DOCUMENTS:
        return _fields_of_document(read_document(path), path)
    if suffix in _PROGRAMS:
        return _program(path)
    lines = _pendant(path) or _echoed(path) or _printed(path)
    if lines is not None:
        return lines
    table = read_table(path)
    if len(table.rows) == 4 and len(table.columns) == 4 and not table.has_header:
        raise DataError(
            f"{path} is one 4 x 4 matrix; a file a view in a folder, or a row a view, is needed.",
            culprits=[str(path)],
            next_step="Convert the folder.",
        )
    return fields_of_table(table, path)


def read_document(path: Path) -> object:
    """Reads JSON, YAML or OpenCV's XML.

    Raises:
        DataError: It cannot be read.
    """
    if path.suffix.lower() == ".json":
        return read_json(path)
    return read_opencv(path) if path.suffix.lower() == ".xml" else read_yaml(path)


def _fields_of_document(document: object, path: Path) -> Fields:
    """Rows from a list of records, the longest such lists in a mapping, or a mapping of lists."""
    # Names with numbers (`robot_0`, `board_0`, `robot_1`, ...) are rows as well.
    if isinstance(document, Mapping):
        numbered = _numbered(document)
        if len(numbered) > 1:
            places = [f"{path.name}, {index}" for index in numbered]
            rows = [flattened(mapping) for mapping in numbered.values()]
            return fields_of_records(rows, places, path.stem, path.parent, tuple(numbered))
        lists = [value for value in document.values() if isinstance(value, list) and value]
        tables = [value for value in lists if isinstance(value[0], Mapping)]
        if (
            not tables
            and document
            and all(isinstance(value, Mapping) for value in document.values())
        ):
            document = list(document.values())
        elif lists:
            count = max(len(table) for table in tables or lists)
            columns = {k: v for k, v in document.items() if isinstance(v, list) and len(v) == count}
            rows = [{k: v[at] for k, v in columns.items()} for at in range(count)]
            document = next(iter(columns.values())) if tables and len(columns) == 1 else rows
    if not isinstance(document, list) or not document:
        raise DataError(
            f"{path} holds no rows; a list with one entry a pose is needed.", culprits=[str(path)]
        )
    places = [f"{path.name}, entry {at}" for at in range(len(document))]
    records = [flattened(value) for value in document]
    return fields_of_records(records, places, path.stem, path.parent)


def _numbered(document: Mapping[str, object]) -> dict[int, dict[str, object]]:
    """Groups matrices by the numbers at the end of their names, or that are their names."""
    rows: dict[int, dict[str, object]] = defaultdict(dict)
    for name, value in document.items():
        if isinstance(value, Mapping) and all(
            re.fullmatch("[0-9]{1,9}", str(number)) for number in value
        ):
            for at, number in value.items():
                rows[int(at)][name] = number
        match = re.fullmatch(r"(.*?)[_-]?([0-9]{1,9})", name)
        # Columns of numbers may have names such as q1; a matrix is a list of lists.
        nested = isinstance(value, list) and bool(value) and isinstance(value[0], list)
        if match and (nested or isinstance(value, np.ndarray)):
            rows[int(match[2])][match[1] or "matrix"] = value
    return dict(sorted(rows.items()))


def _printed(path: Path) -> Fields | None:
    """Reads the 4 x 4 matrices of a text, a field for each heading.

    None where the text has fewer than two matrices, or no heading.
    """
    by_heading: dict[str, list[tuple[int, list[list[float]]]]] = defaultdict(list)
    heading, first_line = "", 0
    rows: list[list[float]] = []
    for at, line in enumerate(read_plain_text(path).splitlines(), start=1):
        words = [part for part in _SEPARATORS.split(line) if part]
        if len(words) == 4 and all(map(is_number, words)):
            first_line = first_line if rows else at
            rows.append([float(word) for word in words])
        elif words:
            # A heading without its numbering: `Pose 3:` is `Pose`.
            named = re.findall(r"[^\W\d_]+(?:[^\W_]*[^\W\d_])?", line)
            heading, rows = " ".join(named)[:80], []
        if len(rows) == 4:
            if rows[3] == [0.0, 0.0, 0.0, 1.0]:
                by_heading[heading].append((first_line, rows))
            rows = []
    if sum(map(len, by_heading.values())) < 2 or not any(by_heading):
        return None
    counts = {name: len(matrices) for name, matrices in by_heading.items()}
    if len(set(counts.values())) > 1:
        listed = some_of([f"{count} under {name!r}" for name, count in counts.items()])
        raise DataError(
            f"{path}: matrices cannot be paired: {listed}; as many of each are needed.",
            culprits=[*counts],
            next_step="Remove those of views of which another is missing.",
        )
    first = next(iter(by_heading.values()))
    places = tuple(f"{path.name}, line {at}" for at, _ in first)
    numbers = {
        name or "matrix": np.array([matrix for _, matrix in matrices]).reshape(-1, 16)
        for name, matrices in by_heading.items()
    }
    return Fields(path.stem, path.parent, places, numbers)


def _echoed(path: Path) -> Fields | None:
    """Reads every pose printed by tf_echo; their times, once a second, are ignored."""
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


def _pendant(path: Path) -> Fields | None:
    """Reads lines with poses in a maker's notation, each with the name of its image if it has one.

    None where neither of the first two lines holds such a pose.
    """
    lines = [
        (at, line)
        for at, line in enumerate(read_plain_text(path).splitlines(), start=1)
        if line.strip() and not line.strip().startswith(_COMMENTS)
    ]
    # The first line may be a header.
    first = next((at for at, (_, line) in enumerate(lines[:2]) if is_marked_pose(line)), None)
    return None if first is None else _fields_of_lines(path, lines[first:])


def _program(path: Path) -> Fields:
    """Reads the taught poses of a robot program; its tools, bases and joint targets are skipped."""
    text = read_plain_text(path)
    # FANUC writes a position in several lines, between braces.
    lines = [
        (text.count("\n", 0, match.start()) + 1, match[0].replace("\n", " "))
        for match in _STATEMENT.finditer(text)
        if not match[0].lstrip().startswith(_PROGRAM_COMMENTS)
        and _NOT_A_STOP.search(match[0]) is None
    ]
    poses = [line for line in lines if is_marked_pose(line[1])]
    if not poses:
        raise DataError(f"{path} has no taught poses that are known.", culprits=[str(path)])
    return _fields_of_lines(path, poses)


def _fields_of_lines(path: Path, lines: Sequence[tuple[int, str]]) -> Fields:
    places = tuple(f"{path.name}, line {at}" for at, _ in lines)
    texts = [line for _, line in lines]
    images = tuple(match[0] if (match := _IMAGE.search(text)) else "" for text in texts)
    poses = [
        read_pose(_IMAGE.sub(" ", text), place) for text, place in zip(texts, places, strict=True)
    ]
    form = poses[0].form
    others = [place for place, pose in zip(places, poses, strict=True) if pose.form != form]
    if others:
        raise DataError(
            f"{some_of(others)}: another maker's form than {form.words}, as {places[0]} has.",
            culprits=others,
            next_step="Put the poses of one robot into a file of their own.",
        )
    numbers = np.array([write_pose(pose.pose, form) for pose in poses])
    columns = dict(zip(_NAMES[numbers.shape[1]], numbers.T, strict=True))
    named = {"image": images} if any(images) else {}
    return Fields(path.stem, path.parent, places, columns, named, form=form.name)
