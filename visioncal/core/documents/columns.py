"""Columns declared as data, read and checked with all problems of their table in one error."""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from visioncal.core.documents.tables import THOUSANDS, TextTable, is_number
from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_COMPARED, NORM_TOLERANCE
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import READ_AGAIN

_INTEGER = re.compile(r"[+-]?[0-9]+")
# A number with a decimal comma, which parts it between commas.
_PARTED = re.compile(r"\s*[+-]?[0-9]+,[0-9]+\s*")
_DIGITS = re.compile(r"\s*[+-]?[0-9]*(e[+-]?[0-9]+)?\s*", re.IGNORECASE)
# Lines of a message at most.
_SHOWN = 10

_OTHER_FORM = f"Rotation vectors or Euler angles? The images show which. {READ_AGAIN}"

_T = TypeVar("_T")


@dataclass(frozen=True)
class Column:
    """A column of numbers: its name, the range of its values, and the message for one beyond."""

    name: str
    least: float = -math.inf
    most: float = math.inf
    words: Callable[[float], str] = "{:g} is out of its range".format
    is_needed: bool = False

    def fault(self, value: float) -> str:
        """Message for a value out of the range; empty for others."""
        return self.words(value) if value < self.least or value > self.most else ""


@dataclass(frozen=True)
class TableProblem:
    """Problem of a table, with its place."""

    place: str
    words: str
    step: str = ""  # Remedy other than correcting the table.


class NumberChecks:
    """Checks of numeric columns, (n,) each with NaN where empty, which collect their problems."""

    def __init__(
        self, count: int, place: Callable[[int], str], values: Mapping[str, FloatArray]
    ) -> None:
        self.count, self.place, self.values = count, place, dict(values)
        self._problems: list[tuple[int, TableProblem]] = []
        self._wrong: set[int] = set()

    def report(self, row: int, column: str, words: str, step: str = "") -> None:
        """Adds a problem of a row, by its index, and of a column; empty for the whole row."""
        place = self.place(row) + (f", column {column}" if column else "")
        self._problems.append((row, TableProblem(place, words, step)))
        self._wrong.add(row)

    def is_sound(self, row: int) -> bool:
        """Whether no row has a problem so far."""
        return row not in self._wrong

    def filled(self, row: int, name: str) -> bool:
        """Whether a row has a number in a column."""
        return name in self.values and not math.isnan(self.values[name][row])

    def within(self, column: Column) -> None:
        """Checks the range of a column."""
        values = self.values[column.name]
        for row in np.flatnonzero((values < column.least) | (values > column.most)).tolist():
            self.report(row, column.name, column.words(float(values[row])))

    def complete(self, *groups: Sequence[str], first_only: Sequence[str] = ()) -> None:
        """Checks that sound rows fill all columns of each group or none.

        Of the group `first_only`, its first columns alone are allowed.
        """
        wrong = np.isin(np.arange(self.count), list(self._wrong))
        for group in (*groups, first_only):
            names = [name for name in group if name in self.values]
            if not names:
                continue
            is_filled = np.isfinite([self.values[name] for name in names]).T
            is_ragged = (
                is_filled[:, 1:] > is_filled[:, :-1]
                if group is first_only
                else is_filled != is_filled[:, :1]
            )
            # Three numbers of a rotation stand in the columns of a quaternion.
            filled = [bool(column.any()) for column in is_filled.T]
            is_other = names[-1] == "qw" and all(filled[:-1]) and not filled[-1]
            for row in np.flatnonzero(is_ragged.any(axis=1) & ~wrong).tolist():
                words = "some are empty and others filled; a row fills all of them or none"
                step = _OTHER_FORM if is_other else ""
                self.report(row, f"{names[0]} ... {names[-1]}", words, step)

    def unit(self, names: Sequence[str]) -> None:
        """Checks that quaternions, in four columns, are of unit length."""
        if not all(name in self.values for name in names):
            return
        numbers = np.array([self.values[name] for name in names])
        # hypot does not overflow.
        norms = np.hypot.reduce(numbers)
        wrong = np.flatnonzero(np.abs(norms - 1.0) > NORM_TOLERANCE).tolist()
        for row in wrong:
            self.report(
                row,
                f"{names[0]} ... {names[-1]}",
                f"the quaternion's norm is {norms[row]:.6g}, but must be 1 to within "
                f"{NORM_TOLERANCE:g}",
                _unit_step(names, numbers, norms),
            )

    def check(self, next_step: str = "") -> None:
        """Raises one DataError for all problems, by rows, if there are any.

        `next_step` replaces the general remedy, to correct the table.
        """
        if self._problems:
            ordered = sorted(self._problems, key=lambda problem: problem[0])
            raise problems_error([problem for _, problem in ordered], next_step)


class TableReader(NumberChecks):
    """Reader of a table's columns.

    Rows with another number of cells than the header are problems, and are left out: row indices
    and arrays are of the `count` others.
    """

    def __init__(self, table: TextTable) -> None:
        width = len(table.columns)
        repeated = {at for at, cells in enumerate(table.rows) if _stripped(cells) == table.columns}
        self._rows = [
            at for at, cells in enumerate(table.rows) if len(cells) == width and at not in repeated
        ]
        super().__init__(len(self._rows), lambda row: table.place(self._rows[row]), {})
        cells = list(zip(*(table.rows[at] for at in self._rows), strict=True)) or [()] * width
        self.cells: Mapping[str, tuple[str, ...]] = dict(zip(table.columns, cells, strict=True))
        following = 0
        for at, row in enumerate(table.rows):
            is_read = len(row) == width and at not in repeated
            following += is_read
            if not is_read:
                words = "it repeats the header" if at in repeated else self._length_words(row)
                # Before the problems of the next row that is read.
                self._problems.append((following, TableProblem(table.place(at), words)))

    def _length_words(self, row: Sequence[str]) -> str:
        """Words on a row that is longer or shorter than the header, the likeliest cause first."""
        words = f"it has {len(row)} fields, but the header has {len(self.cells)} columns"
        if row[0].lstrip().startswith(("#", "//")):
            return f"it is a comment, and a table has none; {words}"
        # A number with decimals is then two fields.
        if len(row) > 1.5 * len(self.cells) and all(map(_DIGITS.fullmatch, row)):
            return (
                f"its decimals are behind commas, which separate columns, too; {words}: write "
                "points, or put semicolons between the columns"
            )
        return f"{words}{self._parted_words(row)}"

    def _parted_words(self, row: Sequence[str]) -> str:
        """Words on a number whose decimal comma parts a row that is too long; empty without one."""
        for cells, whole, decimals in zip(self.cells.values(), row, row[1:], strict=False):
            is_decimal = any("." in cell for cell in cells)
            if (
                len(row) > len(self.cells)
                and is_decimal
                and _PARTED.fullmatch(f"{whole},{decimals}")
            ):
                number = f"{whole.strip()},{decimals.strip()}"
                return f"; {number} is two fields: write {number.replace(',', '.')}"
        return ""

    def texts(self, name: str) -> list[str]:
        """(count,) cells of a column, without surrounding blanks; empty where there is none."""
        cells = self.cells.get(name)
        return [""] * self.count if cells is None else [cell.strip() for cell in cells]

    def read(self, name: str, convert: Callable[[str], _T], needed: str = "") -> list[_T | None]:
        """(count,) converted cells; None where one is empty, or `convert` raises a DataError.

        `needed` names what every row has to have; empty where rows may be without.
        """
        values: list[_T | None] = []
        # Numbers of views and corners recur by the thousand.
        known: dict[str, _T | None] = {"": None}
        for row, cell in enumerate(self.texts(name)):
            value = known.get(cell)
            if cell not in known:
                try:
                    value = known[cell] = convert(cell)
                except DataError as error:
                    self.report(row, name, error.message.rstrip("."), error.next_step)
            if not cell and needed:
                self.report(row, name, f"it is empty, but must be {needed}")
            values.append(value)
        return values

    def whole(self, name: str) -> IntArray:
        """(count,) whole numbers of a column that every row fills; 0 where one is wrong."""
        read = self.read(name, as_whole, "a whole number")
        return np.array([value or 0 for value in read], dtype=np.int64)

    def numbers(self, *columns: Column) -> FloatArray:
        """(count, k) finite numbers of columns within their ranges; NaN where empty or wrong."""
        for column in columns:
            read = self.read(column.name, as_number, "a number" if column.is_needed else "")
            self.values[column.name] = np.array(
                [math.nan if value is None else value for value in read], dtype=float
            )
            self.within(column)
        return np.array([self.values[column.name] for column in columns]).T.reshape(
            self.count, len(columns)
        )


def _stripped(cells: Sequence[str]) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in cells)


def _unit_step(names: Sequence[str], numbers: FloatArray, norms: FloatArray) -> str:
    """The remedy of quaternions (4, n) of another unit or form, with their norms (n,); or empty."""
    known = np.isfinite(norms)
    # Squares of the largest numbers overflow, and no unit is so small.
    squares = np.clip(numbers[:, known], -1e100, 1e100) ** 2
    choices = [[0, 1, 2, 3], [0], [1], [2], [3]] if known.sum() >= FEWEST_COMPARED else []
    for chosen in choices:
        # The other components are a part of a quaternion's square.
        rest = np.maximum(1.0 - np.delete(squares, chosen, axis=0).sum(axis=0), 0.0)
        chosen_squares = squares[chosen].sum(axis=0)
        factor = float(np.sqrt(chosen_squares.sum() / max(rest.sum(), NORM_TOLERANCE)))
        away = np.abs(chosen_squares / max(factor, NORM_TOLERANCE) ** 2 - rest).max()
        if rest.max() > 10.0 * NORM_TOLERANCE and away < 2.0 * NORM_TOLERANCE:
            which = ", ".join(names[at] for at in chosen)
            return f"Divide {which} by {factor:.6g} in all rows: then all norms are 1."
    for decimals in (1, 2):
        off = np.abs(numbers[:, known] - np.round(numbers[:, known], decimals)).max(initial=0.0)
        # Each of four numbers is off by half of its last digit, at most.
        if off < 1e-9 and np.abs(norms[known] - 1.0).max(initial=0.0) < 10.0**-decimals:
            return (
                f"They are rounded to {'one decimal' if decimals == 1 else 'two decimals'}, by "
                f"which a pose turns by up to {np.rad2deg(10.0**-decimals):.2g} deg: write the "
                "robot's poses with six."
            )
    # Poses by the camera are read in one form alone.
    if names[3] != "qw" or norms.max(initial=0.0, where=known) <= 1.5:
        return ""
    if np.nan_to_num(numbers[3]).any():
        return (
            f"Where {', '.join(names[:3])} are a rotation vector or Euler angles, empty column "
            f"{names[3]} in all rows: convert --guess then finds which."
        )
    return _OTHER_FORM


def as_number(cell: str) -> float:
    """Reads a finite number; raises DataError."""
    # float() alone also accepts 1_000 and digits of other scripts.
    value = float(cell) if is_number(cell) else math.nan
    if "," in cell and THOUSANDS.fullmatch(cell):
        raise DataError(
            f"{cell!r} may have a decimal comma or separated thousands",
            next_step=f"Write {cell.replace(',', '.')} or {cell.replace(',', '')}, in all rows.",
        )
    if not math.isfinite(value):
        raise DataError(f"{cell[:60]!r} must be a finite number, such as -1234.5 or 1e-3")
    return value


def as_whole(cell: str) -> int:
    """Reads a whole number, also as `3.0`, which some programs write; raises DataError."""
    cell = cell.removesuffix(".0")
    if not _INTEGER.fullmatch(cell) or len(cell) > 18:
        raise DataError(f"{cell[:60]!r} must be a whole number")
    return int(cell)


def problems_error(problems: Sequence[TableProblem], next_step: str = "") -> DataError:
    """Error that lists the problems of a table, of many the first of each column."""
    steps = {problem.step for problem in problems}
    each = len(problems) <= _SHOWN and steps == {""}
    groups: dict[str, list[TableProblem]] = defaultdict(list)
    for problem in problems:
        groups[problem.place if each else problem.place.partition(", column ")[2]].append(problem)
    shown = list(groups.values())[:_SHOWN]
    where = problems[0].place.partition(", column ")[0]
    step = "" if len(problems) > 1 else f"Correct it, or delete {where}."
    lines = [
        f"{alike[0].place}: {alike[0].words}."
        + (f" And {len(alike) - 1} more, up to {alike[-1].place}." if len(alike) > 1 else "")
        for alike in shown
    ]
    return DataError(
        "\n".join(lines),
        culprits=[alike[0].place for alike in shown],
        next_step=(steps.pop() if len(steps) == 1 else "") or next_step or step,
    )
