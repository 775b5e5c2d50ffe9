"""Reads files as rows of named values, not yet interpreted: tables, documents, arrays, lines."""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.structured import (
    parse_yaml,
    read_xml,
    rows_of_xml,
)
from visioncal.core.documents.tables import TextTable, is_number, read_table
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.documents import (
    CALLED,
    KEYED,
    braced_records,
    halcon_record,
    initialised_record,
    keyed_record,
    literals_in,
    messages_in,
    read_document,
    scripted_record,
)
from visioncal.interchange.formats.fields import (
    POSE_SIZES,
    Fields,
    appearance,
    arrays_in_texts,
    fields_of_records,
    holds_pose,
    is_small,
    joined,
)
from visioncal.interchange.formats.keys import is_image_name
from visioncal.interchange.formats.lines import (
    COUNTED,
    IMAGE,
    PROGRAMS,
    arrays_in,
    blocks_of,
    closed,
    declared_poses,
    pendant_poses,
    placed,
    script_poses,
    tool_note,
)
from visioncal.interchange.formats.row_pairs import paired_rows


def _stacked_matrices(table: TextTable, path: Path) -> Fields | None:
    """Reads 4 x 4 matrices stacked below each other, or side by side in four rows."""
    sides = height, width = len(table.rows), len(table.columns)
    if table.has_header or 4 not in sides or max(sides) < 8 or max(sides) % 4:
        return None
    if not all(is_number(name) for row in table.rows for name in row):
        return None
    numbers = np.array(table.rows, dtype=float).reshape(height, width // 4, 4)
    matrices = numbers.swapaxes(0, 1).reshape(-1, 4, 4)
    if not (matrices[:, 3] == [0, 0, 0, 1]).all():
        return None
    places = tuple(f"{table.label}, matrix {at}" for at in range(1, len(matrices) + 1))
    return Fields(path.stem, path.parent, places, {"matrix": matrices.reshape(-1, 16)})


def _of_joints(table: TextTable, path: Path) -> TextTable:
    """The table; without a header in a file called joints or q, with the joints' names."""
    is_whole = not table.has_header and 5 <= len(table.columns) <= 8
    if is_whole and {"joint", "joints", "q", "qs"} & {*re.split("[^a-z]+", path.stem.lower())}:
        return replace(table, columns=tuple(map("joint_{}".format, table.columns)))
    return table


# Names of numbers in a mapping that are one array.
_JOINED = ("x y z", "x y z w", "qx qy qz qw", "roll pitch yaw", "rx ry rz")


def flattened(record: object, prefix: str = "") -> dict[str, object]:
    """Flattens nested mappings with names joined by points; the parser has bounded the depth.

    Numbers named as in `_JOINED` are also joined into an array, in that order.

    Returns:
        Texts, small arrays, and lists that are no arrays; large arrays and nulls are left out.
    """
    if isinstance(record, Mapping):
        flat: dict[str, object] = _by_joint(record, prefix)
        if (vector := _about_axis(record)) is not None:
            return {prefix.rstrip(".") or "value": vector}
        record = {name: value for name, value in record.items() if not (flat and name in _MESSAGE)}
        plain = {str(name).lower(): value for name, value in record.items()}
        joined = next((names for names in map(str.split, _JOINED) if {*names} == {*plain}), None)
        are_numbers = all(type(value) in (int, float) for value in plain.values())
        if prefix and (joined or (are_numbers and len(plain) in (3, 4))):
            flat |= flattened([plain[name] for name in joined or plain], prefix)
        for name, value in record.items():
            flat |= flattened(value, f"{prefix}{name}.")
        return flat
    name = prefix.rstrip(".") or "value"
    if isinstance(record, str | bool):
        return {name: str(record)}
    try:
        array = np.array(record, dtype=float)
    except (ValueError, TypeError, OverflowError):
        numbers = _in_line(record)
        # A position and a rotation in lists of their own; or a list of several kinds.
        if isinstance(record, list) and len(numbers) in (6, 7, 12, 16):
            return {name: np.array(numbers)}
        if isinstance(record, list) and any(isinstance(part, list | Mapping) for part in record):
            flat = {}
            for at, part in enumerate(record):
                flat |= flattened(part, f"{prefix}{at}.")
            # Lists of numbers of any length are irregular, and not several kinds.
            return {name: record} if numbers else flat
        return {name: record}
    return {name: array} if record is not None and is_small(array) else {}


# Lists of a joint each in a ROS message of joints, beside the joints' names.
_MESSAGE = ("name", "position", "velocity", "effort")


def _by_joint(record: Mapping[str, object], prefix: str) -> dict[str, object]:
    """The angles of a message of joints by their names; empty for any other record."""
    names, angles = record.get("name"), record.get("position")
    if not (isinstance(names, list | tuple) and isinstance(angles, list | tuple | np.ndarray)):
        return {}
    numbers = [each for each in angles if isinstance(each, int | float | np.number)]
    are_words = all(isinstance(name, str) and not is_number(name) for name in names)
    if not (are_words and len(names) == len(numbers) == len(angles) > 1):
        return {}
    pairs = zip(names, numbers, strict=True)
    return {f"{prefix}position.{name}": np.array(float(angle)) for name, angle in pairs}


def _about_axis(record: Mapping[str, object]) -> FloatArray | None:
    """The rotation vector of a mapping of an angle [rad] and an axis; None of any other one."""
    plain = {str(name).lower(): value for name, value in record.items()}
    with suppress(ValueError, TypeError):
        if {*plain} == {"angle", "axis"}:
            axis, angle = (np.array(plain[name], dtype=float) for name in ("axis", "angle"))
            if axis.shape == (3,) and not angle.shape and np.linalg.norm(axis) > 0.0:
                return np.asarray(angle * axis / np.linalg.norm(axis))
    return None


def _named_joints(fields: Fields) -> Fields:
    """Columns `position0` with the word in `name0`, as a ROS message of joints is printed."""
    called = dict[str, str]()
    for name, cells in fields.texts.items():
        match = re.fullmatch(r"(.*\.)?name_?([0-9]+)", name)
        if match and len({*cells}) == 1 and cells[0] and not is_number(cells[0]):
            for of in _MESSAGE[1:]:
                called[f"{match[1] or ''}{of}{match[2]}"] = f"{match[1] or ''}{of}.{cells[0]}"
    return replace(
        fields,
        numbers={called.get(name, name): value for name, value in fields.numbers.items()},
        texts={called.get(name, name): value for name, value in fields.texts.items()},
    )


def _in_line(record: object) -> list[float]:
    """The numbers of nested lists, in order; empty where there is anything else."""
    if not isinstance(record, list):
        return [float(record)] if isinstance(record, int | float) else []
    parts = [_in_line(part) for part in record]
    return [number for part in parts for number in part] if all(parts) else []


DOCUMENTS = (".json", ".yaml", ".yml", ".xml", ".npz", ".npy", ".mat", ".toml", *KEYED)
_NUMBERS = re.compile(rb"[-+.eE\d\s]+")
# Files of makers' controllers, and the forms of their poses.
_MAKERS = {".jbi": "yaskawa", ".pts": "epson", ".dtx": "staubli"}
ENDINGS = (".csv", ".tsv", ".txt", ".log", ".jsonl", *PROGRAMS, *_MAKERS, *DOCUMENTS)


def is_document(path: Path) -> bool:
    """Whether a file is a document, and no text of rows alone, as of MATLAB's `save -ascii`."""
    suffix = path.suffix.lower()
    if suffix == ".mat" and path.is_file():
        with path.open("rb") as file:
            return _NUMBERS.fullmatch(file.read(64)) is None
    return suffix in DOCUMENTS


def read_fields(path: Path, form: str | None = None) -> Fields:
    """Reads a table, a document or arrays as rows of named values; raises DataError.

    `form` is that of a pendant's lines, a name among `POSE_FORMS`; None to recognise it.
    """
    return best_of(joined(read_rows(path, form), path.stem, path.parent))


def read_rows(path: Path, form: str | None = None, document: object = None) -> list[Fields]:
    """All rows of a file, of which a document may have several kinds; see `read_fields`."""
    maker = _MAKERS.get(path.suffix.lower(), "")
    return [replace(each, form=each.form or maker) for each in _rows(path, form, document)]


def _rows(path: Path, form: str | None, document: object) -> list[Fields]:
    if is_document(path):
        return rows_of_document(document or read_document(path), path)
    text = read_plain_text(path)
    if text.lstrip().startswith("<?xml"):
        return rows_of_document(rows_of_xml(read_xml(path)), path)
    # Points that a program declares look like keys and values.
    is_program = path.suffix.lower() in PROGRAMS
    read = (
        scripted_record,
        initialised_record,
        messages_in,
        literals_in,
        lambda text, _: braced_records(text),
        lambda text, _: keyed_record(text),
    )
    for literals in () if is_program else (each(text, path) for each in read):
        with suppress(DataError):
            return rows_of_document(literals, path)
    if declared := () if is_program or "=" not in text else declared_poses(text, path):
        return declared
    moves = None if is_program else script_poses(text, path)
    if lines := moves or pendant_poses(text, path, form if form in POSE_FORMS else None):
        return [replace(lines, notes=(*lines.notes, *tool_note(text, path)))]
    return [_of_lines(text, path)]


def _of_lines(text: str, path: Path) -> Fields:
    """The rows of a table, or of lists over several lines."""
    lines = placed(text, path)
    # Lists over several lines, as OpenCV prints a matrix.
    is_wrapped = text.lstrip().startswith("[") and len(closed(lines)) < len(lines)
    is_wrapped |= COUNTED.match(text) is not None
    if is_wrapped and (blocks := blocks_of(lines, path)):
        return blocks
    try:
        table = _of_joints(read_table(path, text), path)
    except DataError:
        if blocks := blocks_of(lines, path):
            return blocks
        raise
    if len(table.rows) == 4 and len(table.columns) == 4 and not table.has_header:
        raise DataError(
            f"{path} is one 4 x 4 matrix, but must be one row or one file per view.",
            culprits=[str(path)],
            next_step="Convert the folder.",
        )
    if found := _stacked_matrices(table, path) or paired_rows(table, path):
        return found
    records = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    places = [table.place(index) for index in range(len(table.rows))]
    fields = _named_joints(fields_of_records(records, places, path.stem, path.parent))
    # Headings may have as many words as matrices have columns; a picture may stand in a sentence.
    is_odd = 2 * len(fields.numbers) < len(table.columns)
    pictured = IMAGE.search(text.splitlines()[table.lines[0] - 1])
    is_odd |= pictured is not None and not any(map(is_image_name, table.rows[0]))
    blocks = blocks_of(lines, path) if is_odd and not table.has_header else None
    arrays = blocks.numbers.values() if blocks else ()
    return blocks if blocks and any(n[0].size in POSE_SIZES for n in arrays) else fields


def read_record(path: Path, document: object = None) -> dict[str, object]:
    """Content of the file of one view, by name; numbers without a name are its `matrix`."""
    if is_document(path):
        document = document or read_document(path)
    elif called := CALLED.fullmatch(text := read_plain_text(path)):
        document = {"matrix": parse_yaml(called[1], str(path))}
    elif not (document := keyed_record(text) or halcon_record(text, path)):
        try:
            table = read_table(path, text)
        except DataError:
            if arrays := arrays_in(closed(placed(text, path))):
                return {**arrays}
            raise
        rows = [[float(cell) if is_number(cell) else cell for cell in row] for row in table.rows]
        document = rows[0] if len(rows) == 1 else rows
        if table.has_header and len(rows) == 1:
            document = dict(zip(table.columns, rows[0], strict=True))
    return flattened(document if isinstance(document, Mapping) else {"matrix": document})


def fields_of_document(document: object, path: Path) -> Fields:
    """The rows of a document that belong together, those with a pose; raises DataError."""
    return best_of(joined(rows_of_document(document, path), path.stem, path.parent))


def best_of(found: Sequence[Fields]) -> Fields:
    """The rows that hold a pose, of several the ones with most fields."""
    return max(found, key=lambda fields: (holds_pose(fields), len(fields.numbers)))


# A name in a document, rows, and their keys where these are a mapping's.
_Rows: TypeAlias = tuple[str, list[object], tuple[str, ...]]


def rows_of_document(document: object, path: Path) -> list[Fields]:
    """Rows of a document at any depth, of lists and of mappings of records; raises DataError."""
    numbered = _numbered(document) if isinstance(document, Mapping) else {}
    lists = [*_row_lists(document)]
    if len(numbered) > 1:
        counted = _fields_of_rows("", [*numbered.values()], path, (*numbered,))
        records = [each for each in lists if isinstance(each[1][0], Mapping) and not each[2]]
        return [counted, *_fields_of_lists([] if holds_pose(counted) else records, path)]
    if not lists:
        raise DataError(
            f"{path} has no list with one entry per pose"
            f"{', but names and values alone' if document else ': it is empty'}.",
            culprits=[str(path)],
        )
    opened = {name: [*_opened(rows, name)] for name, rows, _ in lists}
    # Lists of rounds are no rows where their own entries are.
    rounds = {name for name, rows, _ in lists if opened[name] and isinstance(rows[0], list)}
    found = _fields_of_lists([each for each in lists if each[0] not in rounds], path)
    has_pose = any(map(holds_pose, found))
    inner = [each for name in opened if name in rounds or not has_pose for each in opened[name]]
    found += _fields_of_lists(inner, path)
    return found


def _fields_of_lists(lists: Sequence[_Rows], path: Path) -> list[Fields]:
    records = [rows for _, rows, _ in lists if isinstance(rows[0], Mapping)]
    return [
        replace(_fields_of_rows(f"{name}." * (records != [rows]), rows, path), stems=keys)
        for name, rows, keys in lists
    ]


def _fields_of_rows(
    prefix: str, rows: Sequence[object], path: Path, views: tuple[int, ...] = ()
) -> Fields:
    flat = [flattened(row, prefix.lstrip(".")) for row in rows]
    places = [f"{path.name}, entry {at}" for at in views or range(len(rows))]
    return fields_of_records(flat, places, path.stem, path.parent, views)


def _row_lists(document: object, name: str = "") -> Iterator[_Rows]:
    """All that may be rows in a document: lists, and mappings of records that are alike, by key."""
    if isinstance(document, list | np.ndarray) and len(document) > 0:
        rows = [*document]
        if len(rows) in (3, 4):
            with suppress(ValueError, TypeError):
                # One matrix.
                square = np.array(rows, dtype=float)
                if square.shape in ((3, 3), (3, 4), (4, 4)) and appearance(square[None]):
                    return
        # A list of one entry is a wrapper, unless there is nothing in it.
        inner = [*_row_lists(rows[0], name)] if len(rows) == 1 else []
        yield from inner or [(name, rows, ())]
    elif isinstance(document, Mapping):
        values = [*document.values()]
        arrays = _arrays_of(values)
        named = all(is_image_name(str(key)) for key in document)
        # Halves of poses by the names of their views: `rotational_vectors: {image0: [..]}`.
        stems = {re.sub("[0-9]+$", "", str(key)) for key in document}
        named |= arrays is not None and arrays[0].size == 3 and len(stems) == 1 < len(document)
        if arrays is not None and len(values) > 2 and (named or appearance(arrays) == "pose"):
            yield name, [{name or "pose": each} for each in arrays], tuple(map(str, document))
            return
        is_counted = len(values) > 1 and all(re.search("[0-9]$", str(key)) for key in document)
        if (
            (len(values) > 2 or is_counted)
            and all(isinstance(value, Mapping) for value in values)
            and set[object].intersection(*({*value} for value in values))
        ):
            yield name, values, tuple(map(str, document))
            if len(values) > 3:
                return
        yield from ((name, records, keys) for records, keys in _numbered_records(document))
        for key, value in document.items():
            yield from _row_lists(value, f"{name}.{key}" if name else str(key))


def _opened(groups: Sequence[object], name: str) -> Iterator[_Rows]:
    """The rows in lists of several groups, each with what stands beside the lists of its group."""
    rows = list[object]()
    if all(isinstance(group, list) for group in groups):
        each = [row for group in groups if isinstance(group, list) for row in group]
        rows = [row for row in each if isinstance(row, list) and str in {*map(type, row)}]
    for group in groups if isinstance(groups[0], Mapping) else ():
        if not isinstance(group, Mapping):
            return
        lists = {key: each for key, each in group.items() if isinstance(each, list)}
        longest = max(map(len, lists.values()), default=0)
        parallel = {key: each for key, each in lists.items() if len(each) == longest > 1}
        rest = {key: each for key, each in group.items() if key not in lists}
        is_inner = any(
            isinstance(cell, list | Mapping) for each in parallel.values() for cell in each
        )
        if not is_inner:
            return
        for cells in zip(*parallel.values(), strict=True):
            rows.append({**rest, **dict(zip(parallel, cells, strict=True))})
    if len(rows) > len(groups):
        yield name, rows, ()


def _arrays_of(values: Sequence[object]) -> FloatArray | None:
    """Lists of numbers, or texts of these, as one array; None where they differ in shape."""
    cells = arrays_in_texts([*values]) if all(isinstance(v, str) and v for v in values) else values
    with suppress(ValueError, TypeError):
        array = np.array(cells, dtype=float)
        return array if array.ndim > 1 else None
    return None


def _numbered_records(
    document: Mapping[str, object],
) -> Iterator[tuple[list[object], tuple[str, ...]]]:
    """Records of one name and numbers of their own that stand beside others, and their keys."""
    found = defaultdict[str, dict[str, Mapping[str, object]]](dict)
    for key, value in document.items():
        match = re.fullmatch(r"(.*?)[0-9]+", str(key))
        if match and isinstance(value, Mapping):
            found[match[1]][str(key)] = value
    for records in found.values():
        if 2 < len(records) < len(document) and set.intersection(*map(set, records.values())):
            yield [*records.values()], tuple(records)


def _is_series(value: object) -> bool:
    """Whether a value is of many poses: matrices, or rows of as many numbers as a pose has."""
    rows = _arrays_of(value) if isinstance(value, list) else None
    if rows is None:
        return False
    is_rows = rows.ndim == 2 and len(rows) > 4 and rows.shape[1] in POSE_SIZES
    return is_rows or rows.shape[1:] in ((4, 4), (3, 4), (3, 3))


def _numbered(document: Mapping[str, object]) -> dict[int, dict[str, object]]:
    """Groups matrices by the numbers at the end of their names, or that are their names."""
    rows: dict[int, dict[str, object]] = defaultdict(dict)
    for name, value in document.items():
        if isinstance(value, Mapping) and all(
            re.fullmatch("[0-9]{1,9}", str(number)) for number in value
        ):
            for at, number in value.items():
                rows[int(at)][name] = number
        match = re.fullmatch(r"(.*?)[_-]?([0-9]{1,9})", str(name))
        # Columns of numbers may have names such as q1; a matrix is a list of lists.
        nested = isinstance(value, list) and bool(value) and isinstance(value[0], list)
        if match and not _is_series(value) and (nested or isinstance(value, np.ndarray)):
            rows[int(match[2])][match[1] or "matrix"] = value
    return dict(sorted(rows.items()))
