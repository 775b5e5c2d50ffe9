"""Rows of named values from tables, JSON or arrays, not yet interpreted."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from visioncal.core.documents import TextTable, is_number
from visioncal.core.documents.arrays import Array
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray

_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")
_TIME_NAMES = ("stamp_s", "t", "time", "timestamp", "stamp", "time_s", "#timestamp")
# Layout of a table without a header by its number of columns: (times, robot pose, camera pose),
# each pose a position with a quaternion or a matrix by rows.
_LAYOUTS = {6: (0, 6, 0), 7: (0, 7, 0), 8: (1, 7, 0), 14: (0, 7, 7), 16: (0, 16, 0)}
_LAYOUTS |= {15: (1, 7, 7), 17: (1, 16, 0), 32: (0, 16, 16), 33: (1, 16, 16)}
_MOST_LISTED = 40
_NORM_TOLERANCE = 0.01
_MOST_DEG = 360.5
# Row counts are whole and below this; seconds of an epoch are not.
_LARGEST_COUNT = 1e6
# Labels of alternating rows of robot and camera poses.
_LABELS = {
    "robot_pose": ("robot", "hand", "gripper", "flange", "tcp", "tool", "ee", "arm", "base"),
    "camera_pose": ("camera", "cam", "eye", "target", "board", "marker", "tag", "object"),
}
# A pose with its covariance has fewer numbers; lists of corners and images have more.
_MOST_NUMBERS = 200


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
            self,
            places=tuple(self.places[index] for index in chosen),
            numbers={name: number[list(chosen)] for name, number in self.numbers.items()},
            texts={name: tuple(text[at] for at in chosen) for name, text in self.texts.items()},
            views=tuple(self.views[index] for index in chosen) if self.views else (),
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
        """The numbers of a field, (n, k).

        Raises:
            DataError: There is no such field, or it holds text.
        """
        full = self.find(name)
        if full in self.shape_errors:
            raise DataError(self.shape_errors[full], culprits=[full])
        if full not in self.numbers:
            cells = zip(self.places, self.texts[full], strict=True)
            odd = ((place, word) for place, word in cells if word and not is_number(word))
            # JSON may also have numbers in quotes.
            place, text = next(odd, (self.places[0], self.texts[full][0]))
            step = "Correct the cell, or leave the whole pose of that row empty."
            if _DECIMAL_COMMA.fullmatch(text):
                step = (
                    "Save the table with semicolons or tabs: with these, decimal commas are read."
                )
            raise DataError(
                f"{place}: {full} holds {text[:40]!r}; a number is needed.",
                culprits=[place],
                next_step=step,
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
        return some_of(words, _MOST_LISTED)


def fields_of_table(table: TextTable, path: Path) -> Fields:
    """Reads the columns of a table; a column of numbers in all filled cells becomes numeric.

    Stacked or adjacent 4 x 4 matrices give a row each, and so do alternating rows of robot and
    camera poses.
    """
    if matrices := _stacked_matrices(table, path) or _alternating_rows(table, path):
        return matrices
    columns = list(zip(*table.rows, strict=True))
    texts = dict(zip(table.columns, columns, strict=True))
    numbers = {
        name: np.array([float(cell) if cell else np.nan for cell in cells])
        for name, cells in texts.items()
        if any(cells) and all(not cell or is_number(cell) for cell in cells)
    }
    places = tuple(table.place(index) for index in range(len(table.rows)))
    return Fields(path.stem, path.parent, places, numbers, texts)


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


def _alternating_rows(table: TextTable, path: Path) -> Fields | None:
    """Reads alternating rows whose first cell labels them as robot or camera."""
    labels = [row[0] for row in table.rows]
    cells = [row[1:] for row in table.rows]
    pair = labels[:2]
    if len(set(pair)) < 2 or len(labels) < 4 or labels != pair * (len(labels) // 2):
        return None
    if is_number(pair[0]) or not all(is_number(name) for row in cells for name in row):
        return None
    arrays = np.array(cells, dtype=float)
    offsets = {
        next((name for name, words in _LABELS.items() if label.lower() in words), label): at
        for at, label in enumerate(pair)
    }
    poses = {name: arrays[at::2] for name, at in offsets.items()}
    places = tuple(table.place(at) for at in range(0, len(labels), 2))
    return Fields(path.stem, path.parent, places, poses)


def fields_of_records(
    records: Sequence[Mapping[str, object]],
    places: Sequence[str],
    name: str,
    folder: Path,
    views: tuple[int, ...] = (),
) -> Fields:
    """Fields of n records as `flattened` returns them; a value missing in a row is NaN."""
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, tuple[str, ...]] = {}
    ragged: dict[str, str] = {}
    for key in dict.fromkeys(name for record in records for name in record):
        values = [record.get(key) for record in records]
        if any(isinstance(value, str) for value in values):
            texts[key] = tuple("" if value is None else str(value) for value in values)
            continue
        if bad := [at for at, value in enumerate(values) if isinstance(value, list)]:
            ragged[key] = (
                f"{places[bad[0]]}: {key} is no regular list or matrix of numbers: its lists "
                "differ in length, or hold something else."
            )
            continue
        arrays = [value if isinstance(value, np.ndarray) else None for value in values]
        shapes = Counter(array.shape for array in arrays if array is not None)
        if not shapes:
            continue
        shape = shapes.most_common(1)[0][0]
        odd = [at for at, array in enumerate(arrays) if array is not None and array.shape != shape]
        if odd:
            ragged[key] = (
                f"{places[odd[0]]}: {key} has the shape {shapes.most_common()[-1][0]}; most rows "
                f"have {shape}."
            )
            continue
        rows = [np.full(shape, np.nan) if array is None else array for array in arrays]
        numbers[key] = np.array(rows).reshape(len(rows), *shape)
        if not shape:
            texts[key] = _cells(numbers[key])
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


def fields_of_arrays(arrays: Mapping[str, Array], path: Path) -> Fields:
    """Fields of arrays whose first axis counts the rows; others are left out.

    Raises:
        DataError: There is no array with rows.
    """
    lengths = Counter(len(array) for array in arrays.values() if array.ndim > 1)
    lengths = lengths or Counter(len(array) for array in arrays.values() if array.ndim == 1)
    if not lengths:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items()) or "nothing"
        raise DataError(
            f"{path} holds {shapes}; arrays with one row a pose are needed.", culprits=[str(path)]
        )
    rows = lengths.most_common(1)[0][0]
    fitting = {
        name: array
        for name, array in arrays.items()
        if array.ndim and len(array) == rows and array.size <= _MOST_NUMBERS * max(rows, 1)
    }
    numbers = {
        name: array.astype(float) for name, array in fitting.items() if array.dtype.kind in "fiub"
    }
    texts = {name: _cells(number) for name, number in numbers.items() if number.ndim == 1}
    texts |= {
        name: tuple(
            value.decode("latin-1") if isinstance(value, bytes) else str(value) for value in array
        )
        for name, array in fitting.items()
        if array.dtype.kind in "US" and array.ndim == 1
    }
    places = tuple(f"{path.name}, row {at}" for at in range(rows))
    return Fields(path.stem, path.parent, places, numbers, texts)


def _cells(numbers: FloatArray) -> tuple[str, ...]:
    """Writes (n,) numbers as cells of a table; whole numbers without a decimal point."""
    return tuple(
        "" if np.isnan(number) else str(int(number)) if number % 1 == 0 else repr(number)
        for number in numbers.tolist()
    )


def unnamed_columns(fields: Fields) -> Mapping[str, tuple[str, ...]]:
    """Interprets the columns of a table without a header by their number.

    Returns:
        The columns of `time`, `robot` and `camera`; all empty for a table with a header or another
        number of columns.
    """
    names = [str(at) for at in range(1, len(fields.texts) + 1)]
    if not names or list(fields.texts) != names:
        return {"time": (), "robot": (), "camera": ()}
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
    if robot == 6 and set(pose) <= set(fields.numbers):
        first, last = np.abs([fields.numbers[name] for name in pose]).reshape(2, -1)
        if np.nanmax(first) <= _MOST_DEG < np.nanmax(last):
            # The last three are too large for angles, and the first three are not.
            pose = pose[3:] + pose[:3]
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
        # Numbers that count rows, possibly with gaps, are no times.
        if (numbers % 1 != 0).any() or numbers.max(initial=0.0) >= _LARGEST_COUNT:
            return name
    named = (
        name
        for name, numbers in fields.numbers.items()
        if name.lower() in _TIME_NAMES and name not in taken and numbers.size == len(fields)
    )
    return next(named, "")
