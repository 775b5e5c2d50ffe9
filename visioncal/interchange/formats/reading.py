"""Reads files as rows of named values, not yet interpreted: tables, documents, arrays, lines."""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, write_pose
from visioncal.core.documents.jsons import read_arrays, read_json
from visioncal.core.documents.pendants import is_marked_pose, read_pose
from visioncal.core.documents.structured import parse_yaml, read_opencv, read_yaml
from visioncal.core.documents.tables import TextTable, is_number, read_table
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import check_values
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray, chosen_rows

_TIME_NAMES = ("stamp_s", "t", "time", "timestamp", "stamp", "time_s", "#timestamp")
# Layout of a table without a header by its number of columns: (times, robot pose, camera pose),
# each pose a position with a quaternion or a matrix by rows.
_LAYOUTS = {6: (0, 6, 0), 7: (0, 7, 0), 8: (1, 7, 0), 14: (0, 7, 7), 16: (0, 16, 0)}
_LAYOUTS |= {15: (1, 7, 7), 17: (1, 16, 0), 32: (0, 16, 16), 33: (1, 16, 16)}
_NORM_TOLERANCE = 0.01
# A pose with its covariance has fewer numbers; lists of corners and images have more.
_MOST_NUMBERS = 200


def named_by(place: str) -> str:
    """What the option that names fields is called after: the `columns` of a table, else a `key`."""
    return "columns" if ", line " in place else "key"


@dataclass(frozen=True, eq=False)
class Fields:
    """Named values of n rows."""

    name: str  # Name of the recording.
    folder: Path  # What the names of images are relative to.
    places: tuple[str, ...]  # (n,) place of each row in the source, for messages.
    numbers: Mapping[str, FloatArray]  # (n, ...) arrays by name; NaN where a row has none.
    # (n,) texts by name, of every column of a table and of single numbers.
    texts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    views: tuple[int, ...] = ()  # (n,) the rows' numbers, where their files' names have them.
    stems: tuple[str, ...] = ()  # (n,) names of the rows' files without their ending.
    # Error messages of fields whose rows differ in shape, by name.
    shape_errors: Mapping[str, str] = field(default_factory=dict)
    is_joined: bool = False  # Whether the rows are of several files.
    form: str = ""  # A name among `POSE_FORMS` where the rows state the form of the robot's poses.

    def __len__(self) -> int:
        return len(self.places)

    def rows(self, chosen: Sequence[int]) -> Self:
        """The same values for some rows only."""
        return replace(
            chosen_rows(self, list(chosen)),
            numbers={name: number[list(chosen)] for name, number in self.numbers.items()},
            texts={name: tuple(text[at] for at in chosen) for name, text in self.texts.items()},
        )

    def find(self, name: str) -> str:
        """Full name of a field, which may be given without the prefix before its last point.

        Raises:
            DataError: There is no such field; the message lists the existing ones.
        """
        names = list(dict.fromkeys([*self.numbers, *self.texts, *self.shape_errors]))
        if name in names:
            return name
        matches = [word for word in names if word.endswith(f".{name}")]
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise DataError(
                f"{self.name}: {name!r} may be {some_of(matches)}; the full name is needed.",
                culprits=matches,
            )
        raise DataError(
            f"{self.name} has no column or key {name!r}; it has {self.listing()}.",
            culprits=[name],
            next_step=did_you_mean(name, names),
        )

    def column(self, name: str) -> FloatArray:
        """The numbers of a field, (n, k); raises DataError."""
        full = self.find(name)
        if full in self.shape_errors:
            raise DataError(self.shape_errors[full], culprits=[full])
        if full not in self.numbers:
            cells = zip(self.places, self.texts[full], strict=True)
            odd = ((place, word) for place, word in cells if word and not is_number(word))
            place, text = next(odd, (self.places[0], ""))
            raise DataError(
                f"{place}: {full} holds {text[:40]!r}; a number is needed.",
                culprits=[place],
                next_step=f"Correct the cell, or delete {place}; or leave the whole pose of that "
                "row empty.",
            )
        return self.numbers[full].reshape(len(self), -1)

    def listing(self) -> str:
        """Lists the fields with their numbers of values a row, for messages."""
        names = list(dict.fromkeys([*self.numbers, *self.texts]))
        words = [
            f"{name} ({int(np.prod(self.numbers[name].shape[1:]))})"
            if name in self.numbers and self.numbers[name].ndim > 1
            else name
            for name in names
        ]
        return some_of(words, 40)


def _stacked_matrices(table: TextTable, path: Path) -> Fields | None:
    """Reads 4 x 4 matrices stacked below each other, or side by side in four rows."""
    height, width = len(table.rows), len(table.columns)
    count = height * width // 16
    if table.has_header or count < 2 or 4 not in (height, width) or (height + width) % 4:
        return None
    if not all(is_number(name) for row in table.rows for name in row):
        return None
    numbers = np.array(table.rows, dtype=float)
    matrices = (
        numbers.reshape(4, count, 4).swapaxes(0, 1) if height == 4 else numbers.reshape(-1, 4, 4)
    )
    if not (matrices[:, 3] == [0, 0, 0, 1]).all():
        return None
    places = tuple(f"{table.label}, matrix {at}" for at in range(1, count + 1))
    rows = {"matrix": matrices.reshape(count, 16)}
    return Fields(path.stem, path.parent, places, rows)


def fields_of_records(
    records: Sequence[Mapping[str, object]],
    places: Sequence[str],
    name: str,
    folder: Path,
    views: tuple[int, ...] = (),
) -> Fields:
    """Fields of n records of texts and arrays, as `flattened` returns them.

    Texts that are numbers in all filled rows are numbers, too; a value missing in a row is NaN.
    """
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, tuple[str, ...]] = {}
    ragged: dict[str, str] = {}
    for key in dict.fromkeys(name for record in records for name in record):
        values = [record.get(key) for record in records]
        arrays = sum(isinstance(value, np.ndarray) and value.ndim > 0 for value in values)
        if 2 * arrays > len(values):
            # A word where others have numbers says that there were none.
            values = [None if isinstance(value, str) else value for value in values]
        if any(isinstance(value, str) for value in values):
            cells = texts[key] = tuple("" if value is None else str(value) for value in values)
            if any(cells) and all(not cell or is_number(cell) for cell in cells):
                numbers[key] = np.array([float(cell) if cell else np.nan for cell in cells])
            continue
        shapes = Counter(value.shape for value in values if isinstance(value, np.ndarray))
        shape = shapes.most_common(1)[0][0] if shapes else ()
        for place, value in zip(places, values, strict=True):
            if value is not None and getattr(value, "shape", None) != shape:
                ragged[key] = (
                    f"{place}: {key} is no regular list or matrix of numbers of the shape {shape}, "
                    "as most rows have."
                )
                break
        else:
            empty = np.full(shape, np.nan)
            numbers[key] = np.array([empty if value is None else value for value in values], float)
            if not shape:
                # As cells of a table: whole numbers without a decimal point.
                texts[key] = tuple(
                    "" if np.isnan(each) else str(int(each)) if each % 1 == 0 else repr(each)
                    for each in numbers[key].tolist()
                )
    return Fields(name, folder, tuple(places), numbers, texts, views, shape_errors=ragged)


# Names of numbers in a mapping that are one array.
_JOINED = ("x y z", "x y z w", "qx qy qz qw", "roll pitch yaw", "rx ry rz")


def flattened(record: object, prefix: str = "") -> dict[str, object]:
    """Flattens nested mappings with names joined by points; the parser has bounded the depth.

    Numbers named as in `_JOINED` are also joined into an array, in that order.

    Returns:
        Texts, small arrays, and lists that are no arrays; large arrays and nulls are left out.
    """
    if isinstance(record, Mapping):
        flat: dict[str, object] = {}
        plain = {str(name).lower(): value for name, value in record.items()}
        joined = next((names for names in map(str.split, _JOINED) if {*names} == {*plain}), None)
        if prefix and joined:
            flat |= flattened([plain[name] for name in joined], prefix)
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
            return flat if any(not isinstance(part, list) for part in record) else {name: record}
        return {name: record}
    return {name: array} if record is not None and array.size <= _MOST_NUMBERS else {}


def _in_line(record: object) -> list[float]:
    """The numbers of nested lists, in order; empty where there is anything else."""
    if not isinstance(record, list):
        return [float(record)] if isinstance(record, int | float) else []
    parts = [_in_line(part) for part in record]
    return [number for part in parts for number in part] if all(parts) else []


def appearance(numbers: FloatArray) -> str:
    """What (n, ...) numbers look like: a `pose`, a `rotation`, a `quaternion`; else empty."""
    flat = numbers.reshape(len(numbers), -1)
    flat = flat[np.isfinite(flat).all(axis=1)]
    size, matrix = flat.shape[1], ROTATION_FORMS["matrix"]
    if not len(flat) or size not in (4, 7, 9, 12, 16):
        return ""
    if size in (4, 7):
        norms = np.linalg.norm(flat[:, -4:], axis=1)
        is_unit = bool((np.abs(norms - 1.0) < _NORM_TOLERANCE).all())
        return ("quaternion" if size == 4 else "pose") * is_unit
    rotations = flat if size == 9 else split_matrices(flat)[1]
    is_rotation = bool(np.isfinite(matrix.read(rotations)).all())
    return ("rotation" if size == 9 else "pose") * is_rotation


def holds_pose(fields: Fields) -> bool:
    """Whether numbers of a row look like a pose or a rotation, whatever they are called."""
    return any(appearance(numbers) for numbers in fields.numbers.values())


def split_matrices(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Splits (n, 16) or (n, 12) numbers of matrices into (n, 3) positions and (n, 9) rotations."""
    last = np.array([0.0, 0, 0, 1])
    if flat.shape[1] == 12:
        matrices = flat.reshape(-1, 3, 4)
        after_position = ROTATION_FORMS["matrix"].read(flat[:, 3:])
        upper_rows = ROTATION_FORMS["matrix"].read(matrices[:, :, :3].reshape(-1, 9))
        if (
            np.isfinite(after_position).all(axis=(1, 2)).sum()
            > np.isfinite(upper_rows).all(axis=(1, 2)).sum()
        ):
            return flat[:, :3].copy(), flat[:, 3:].copy()
    else:
        square = flat.reshape(-1, 4, 4)
        by_columns = (square[:, :, 3] == last).all(axis=1) & ~(square[:, 3] == last).all(axis=1)
        matrices = np.where(by_columns[:, None, None], np.swapaxes(square, 1, 2), square)
        wrong = np.isfinite(matrices).all(axis=(1, 2)) & (
            np.abs(matrices[:, 3] - last).max(axis=1) > 1e-6
        )
        # A matrix with another last row is no rigid transform: its zeroed rotation is refused
        # later.
        matrices = np.where(wrong[:, None, None], 0.0, matrices)
    return matrices[:, :3, 3].copy(), matrices[:, :3, :3].reshape(-1, 9).copy()


def unnamed_columns(fields: Fields) -> Mapping[str, tuple[str, ...]]:
    """Interprets the columns of a table without a header by their number.

    Returns:
        The columns of `time`, `robot` and `camera`; all empty for a table with a header or another
        number of columns.
    """
    names = [str(at) for at in range(1, len(fields.texts) + 1)]
    if not names or list(fields.texts) != names:
        return {"time": (), "robot": (), "camera": ()}
    # Names of images are no part of a pose.
    names = [name for name in names if not all(map(_IMAGE.fullmatch, fields.texts[name]))]
    time, robot, camera = _LAYOUTS.get(len(names), (0, 0, 0))
    is_numeric = set(names) == set(fields.numbers)
    if is_numeric and len(names) == 12:
        numbers = np.stack([fields.numbers[name] for name in names], axis=1)
        lengths = np.linalg.norm(numbers.reshape(-1, 3, 4)[..., :3], axis=2)
        if (np.abs(lengths - 1.0) < _NORM_TOLERANCE).all():
            # The upper three rows of matrices, not two poses.
            robot = 12
    if is_numeric and len(names) == 7:
        last = np.stack([fields.numbers[name] for name in names[3:]])
        if (np.abs(np.linalg.norm(last, axis=0) - 1.0) > _NORM_TOLERANCE).all():
            # A number or a time, and a position with three angles.
            time, robot = 1, 6
    pose = names[time : time + robot]
    return {
        "time": tuple(names[:time]),
        "robot": tuple(pose),
        "camera": tuple(names[time + robot :]) if camera else (),
    }


def stamp_name(fields: Fields, taken: Collection[str]) -> str:
    """Finds the field of times, one number a row and not `taken`; else empty."""
    unnamed = unnamed_columns(fields)
    # In a table without a header, the poses follow the times.
    for name in unnamed["time"] if set(unnamed["robot"]) <= set(taken) else ():
        numbers = fields.column(name)[:, 0]
        # Numbers that count rows, possibly with gaps, are no times; those of an epoch are larger.
        if (numbers % 1 != 0).any() or numbers.max(initial=0.0) >= 1e6:
            return name
    named = (
        name
        for name, numbers in fields.numbers.items()
        if name.lower() in _TIME_NAMES and name not in taken and numbers.size == len(fields)
    )
    return next(named, "")


DOCUMENTS = (".json", ".yaml", ".yml", ".xml", ".npz", ".npy")
# Robots' programs, of which the poses alone are read.
_PROGRAMS = (".dat", ".src", ".ls", ".mod", ".script")
ENDINGS = (".csv", ".tsv", ".txt", ".log", ".jsonl", *_PROGRAMS, *DOCUMENTS)
# Field names of a pose by its number of values.
_NAMES = {6: ("x", "y", "z", "rx", "ry", "rz"), 7: ("x", "y", "z", "q1", "q2", "q3", "q4")}
_IMAGE = re.compile(r"[^\s,;\"']+\.(?:png|jpe?g|tiff?|bmp)(?![\w.])", re.IGNORECASE)
# Words of JSON, and the same of Python.
_NAMES_OF = {"true": "True", "false": "False", "null": "None", "NaN": "None"}
_PYTHON = re.compile(rf"\b(?:{'|'.join(_NAMES_OF)})\b")
# What a program declares beside targets.
_FRAMES = re.compile("tool|wobj|load|base", re.IGNORECASE)
_COMMENTS = ("#", "%", "//", "!")


def read_fields(path: Path, form: str | None = None) -> Fields:
    """Reads a table, JSON, YAML, .npz or .npy as rows of named values; raises DataError.

    `form` is that of a pendant's lines, a name among `POSE_FORMS`; None to recognise it.
    """
    if path.suffix.lower() in DOCUMENTS:
        return fields_of_document(read_document(path), path)
    if literals := _literals(path):
        return fields_of_document(literals, path)
    if lines := _pendant(path, form if form in POSE_FORMS else None):
        return lines
    if path.suffix.lower() in _PROGRAMS:
        raise DataError(f"{path} holds no poses of a robot.", culprits=[str(path)])
    table = read_table(path)
    if len(table.rows) == 4 and len(table.columns) == 4 and not table.has_header:
        raise DataError(
            f"{path} is one 4 x 4 matrix; a file a view in a folder, or a row a view, is needed.",
            culprits=[str(path)],
            next_step="Convert the folder.",
        )
    if matrices := _stacked_matrices(table, path):
        return matrices
    records = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    places = [table.place(index) for index in range(len(table.rows))]
    return fields_of_records(records, places, path.stem, path.parent)


def read_document(path: Path) -> object:
    """Reads JSON, YAML, OpenCV's XML, or arrays as lists, without large ones; raises DataError."""
    suffix = path.suffix.lower()
    if suffix in (".npz", ".npy"):
        arrays = {
            name: np.char.decode(array, "latin-1") if array.dtype.kind == "S" else array
            for name, array in read_arrays(path).items()
            if array.ndim and array.size <= _MOST_NUMBERS * max(len(array), 1)
        }
        return {name: array.tolist() for name, array in arrays.items()}
    if suffix == ".json":
        return read_json(path)
    if suffix == ".xml":
        return read_opencv(path)
    parts = re.split(r"^---.*$", read_plain_text(path), flags=re.MULTILINE)
    several = [part for part in parts if part.strip() and not part.startswith("%")]
    # As programs write that print one message after the other.
    return [parse_yaml(part, str(path)) for part in several] if several[1:] else read_yaml(path)


def fields_of_document(document: object, path: Path) -> Fields:
    """Rows of a document, at any depth: lists of one length, or a mapping of records.

    Of several lengths the first in which a pose is found is taken, lists of records before others.

    Raises:
        DataError: It holds no rows.
    """
    found: dict[int, dict[str, list[object]]] = defaultdict(dict)
    numbered = _numbered(document) if isinstance(document, Mapping) else {}
    if len(numbered) > 1:
        found[len(numbered)][""] = [*numbered.values()]
    else:
        for name, rows in _row_lists(document):
            found[len(rows)][name] = rows
    if not found:
        raise DataError(
            f"{path} holds no rows; a list with one entry a pose is needed.", culprits=[str(path)]
        )
    views = tuple(numbered) if len(numbered) > 1 else ()

    def rank(lists: Mapping[str, list[object]]) -> tuple[bool, int, int]:
        rows = [*lists.values()]
        return any(isinstance(each[0], Mapping) for each in rows), len(rows), len(rows[0])

    several = [
        _fields_of_lists(lists, path, views)
        for lists in sorted(found.values(), key=rank, reverse=True)
    ]
    return next((fields for fields in several if holds_pose(fields)), several[0])


def _fields_of_lists(
    lists: Mapping[str, list[object]], path: Path, views: tuple[int, ...]
) -> Fields:
    count = len(next(iter(lists.values())))
    records = [name for name, rows in lists.items() if isinstance(rows[0], Mapping)]
    flat: list[dict[str, object]] = [{} for _ in range(count)]
    for name, rows in lists.items():
        prefix = "" if not name or records == [name] else f"{name}."
        for at, row in enumerate(rows):
            flat[at] |= flattened(row, prefix)
    places = [f"{path.name}, entry {at}" for at in views or range(count)]
    return fields_of_records(flat, places, path.stem, path.parent, views)


def _row_lists(document: object, name: str = "") -> Iterator[tuple[str, list[object]]]:
    """All that may be rows in a document: its lists, and mappings of records that are alike."""
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
        yield from inner or [(name, rows)]
    elif isinstance(document, Mapping):
        values = [*document.values()]
        if all(isinstance(value, Mapping) for value in values) and (
            len(values) > 2 or all(re.search("[0-9]$", str(key)) for key in document)
        ):
            shared = set[object].intersection(*({*value} for value in values)) if values else set()
            if shared:
                yield name, values
                return
        for key, value in document.items():
            yield from _row_lists(value, f"{name}.{key}" if name else str(key))


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
        if match and (nested or isinstance(value, np.ndarray)):
            rows[int(match[2])][match[1] or "matrix"] = value
    return dict(sorted(rows.items()))


def _literals(path: Path) -> list[object]:
    """Records of JSON or of Python, one a line; empty where a line is none."""
    lines = [line for line in read_plain_text(path).splitlines() if line.strip()]
    if not lines or not all(line.lstrip().startswith("{") for line in lines):
        return []
    records = list[object]()
    with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
        for line in lines:
            records.append(_listed(ast.literal_eval(_PYTHON.sub(lambda m: _NAMES_OF[m[0]], line))))
    check_values(records, str(path))
    return records if len(records) == len(lines) else []


def _listed(value: object) -> object:
    """A value with lists in the place of tuples."""
    if isinstance(value, Mapping):
        return {str(key): _listed(part) for key, part in value.items()}
    return [_listed(part) for part in value] if isinstance(value, list | tuple) else value


def _pendant(path: Path, form: str | None) -> Fields | None:
    """Lines with poses in a maker's notation, with names of images; None where there are none."""
    text = read_plain_text(path)
    is_program = path.suffix.lower() in _PROGRAMS
    if is_program:
        # FANUC writes a pose in several lines.
        text = re.sub(r"\{[^{}]*\}", lambda block: " ".join(block[0].split()), text)
    lines = [
        (f"{path.name}, line {at}", line)
        for at, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.strip().startswith(_COMMENTS)
    ]
    if is_program:
        lines = [each for each in lines if is_marked_pose(each[1]) and not _FRAMES.search(each[1])]
    # The first line may be a header.
    first = next((at for at, (_, line) in enumerate(lines[:2]) if is_marked_pose(line)), None)
    if first is None:
        return None
    records, forms = [], dict[str, str]()
    for place, line in lines[first:]:
        pose, image = read_pose(_IMAGE.sub(" ", line), place, form), _IMAGE.search(line)
        forms.setdefault(pose.form.name, place)
        numbers = write_pose(pose.pose, pose.form)
        record = dict(zip(_NAMES[len(numbers)], numbers, strict=True))
        records.append(record | ({"image": image[0]} if image else {}))
    if len(forms) > 1:
        raise DataError(
            f"{path}: poses in the forms of several makers: {', '.join(forms)}.",
            culprits=[*forms.values()],
            next_step="Put the poses of one robot into a file of their own.",
        )
    places = [place for place, _ in lines[first:]]
    fields = fields_of_records(records, places, path.stem, path.parent)
    return replace(fields, form=next(iter(forms)))
