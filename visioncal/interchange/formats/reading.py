"""Reads files as rows of named values, not yet interpreted: tables, documents, arrays, lines."""

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.documents.jsons import read_arrays, read_json
from visioncal.core.documents.pendants import is_marked_pose, read_pose
from visioncal.core.documents.structured import read_opencv, read_yaml
from visioncal.core.documents.tables import TextTable, is_number, read_table
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
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
    # Error messages of fields whose rows differ in shape, by name.
    shape_errors: Mapping[str, str] = field(default_factory=dict)
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
    return Fields(name, folder, tuple(places), numbers, texts, views, ragged)


def flattened(record: object, prefix: str = "") -> dict[str, object]:
    """Flattens nested mappings with names joined by points; the parser has bounded the depth.

    Numbers named x, y, z, or x, y, z, w, are also joined into an array.

    Returns:
        Texts, small arrays, and lists that are no arrays; large arrays and nulls are left out.
    """
    if isinstance(record, Mapping):
        flat: dict[str, object] = {}
        if prefix and [*record] in (["x", "y", "z"], ["x", "y", "z", "w"], ["w", "x", "y", "z"]):
            flat |= flattened([record[name] for name in "xyzw"[: len(record)]], prefix)
        for name, value in record.items():
            flat |= flattened(value, f"{prefix}{name}.")
        return flat
    name = prefix.rstrip(".") or "value"
    if isinstance(record, str | bool):
        return {name: str(record)}
    try:
        array = np.array(record, dtype=float)
    except (ValueError, TypeError, OverflowError):
        return {name: record}
    return {name: array} if record is not None and array.size <= _MOST_NUMBERS else {}


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
ENDINGS = (".csv", ".tsv", ".txt", ".log", *DOCUMENTS)
# Field names of a pose by its number of values.
_NAMES = {6: ("x", "y", "z", "rx", "ry", "rz"), 7: ("x", "y", "z", "q1", "q2", "q3", "q4")}
_IMAGE = re.compile(r"[^\s,;\"']+\.(?:png|jpe?g|tiff?|bmp)(?![\w.])", re.IGNORECASE)
_COMMENTS = ("#", "%", "//", "!")


def read_fields(path: Path, form: str | None = None) -> Fields:
    """Reads a table, JSON, YAML, .npz or .npy as rows of named values; raises DataError.

    `form` is that of a pendant's lines, a name among `POSE_FORMS`; None to recognise it.
    """
    if path.suffix.lower() in DOCUMENTS:
        return fields_of_document(read_document(path), path)
    if lines := _pendant(path, form if form in POSE_FORMS else None):
        return lines
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
    return read_opencv(path) if suffix == ".xml" else read_yaml(path)


def fields_of_document(document: object, path: Path) -> Fields:
    """Rows from a list of records, from lists of one length in a mapping, or a mapping of records.

    Raises:
        DataError: It holds no rows.
    """
    views: tuple[int, ...] = ()
    # Names with numbers (`robot_0`, `board_0`, `robot_1`, ...) are rows as well.
    if isinstance(document, Mapping):
        numbered = _numbered(document)
        lists = {k: v for k, v in document.items() if isinstance(v, list) and v}
        lists = {k: v for k, v in lists.items() if isinstance(v[0], Mapping)} or lists
        if len(numbered) > 1:
            document, views = list(numbered.values()), tuple(numbered)
        elif lists:
            counts = Counter(map(len, lists.values()))
            count = max(counts, key=lambda length: (counts[length], length))
            columns = {k: v for k, v in document.items() if isinstance(v, list) and len(v) == count}
            only = len(columns) == 1 and isinstance(next(iter(columns.values()))[0], Mapping)
            rows = [{k: v[at] for k, v in columns.items()} for at in range(count)]
            document = next(iter(columns.values())) if only else rows
        elif all(isinstance(value, Mapping) for value in document.values()):
            document = list(document.values())
    if not isinstance(document, list) or not document:
        raise DataError(
            f"{path} holds no rows; a list with one entry a pose is needed.", culprits=[str(path)]
        )
    places = [f"{path.name}, entry {at}" for at in views or range(len(document))]
    records = [flattened(value) for value in document]
    return fields_of_records(records, places, path.stem, path.parent, views)


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


def _pendant(path: Path, form: str | None) -> Fields | None:
    """Lines with poses in a maker's notation, with names of images; None where there are none."""
    lines = [
        (f"{path.name}, line {at}", line)
        for at, line in enumerate(read_plain_text(path).splitlines(), start=1)
        if line.strip() and not line.strip().startswith(_COMMENTS)
    ]
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
