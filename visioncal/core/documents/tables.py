"""Tables as text: CSV, TSV or blanks between, with or without a header, with comments."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from visioncal.core.documents.values import MAX_VALUES, read_plain_text, too_many
from visioncal.core.errors import DataError

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(nan|inf)", re.I)
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]+,[0-9]+([eE][+-]?[0-9]+)?")
# What else str.splitlines splits at may stand inside a cell.
_LINE_END = re.compile(r"\r\n|\r|\n")
# Excel writes the separator itself into the first line, for itself.
_SEPARATOR = re.compile(r"sep=([;\t,])", re.I)
# All that an empty row has.
_EMPTY = "; ,\t\r"
_COMMENTS = ("#", "%", "//")
# A row as programs print a list, with its name before it: `pose: [1.0, 2.0]`, `array([1, 2]),`.
_LISTED = re.compile(
    r"(?:[^\W\d][\w .-]*+[:=]\s*+)?(?:[^\W\d][\w.]*+\s*+)?"
    r"(?:\[([^][(){}]*+)\]|\(([^][(){}]*+)\)|\(\[([^][(){}]*+)\]\)|\{([^][(){}]*+)\})\s*+[,;]?"
)


@dataclass(frozen=True)
class TextTable:
    """A table.

    Attributes:
        path: Its file.
        columns: The names of the columns: as the header has them, or `1`, `2`, ... without one.
        has_header: Whether the names come from the file.
        rows: The rows' cells, without surrounding blanks.
        lines: The line of each row in the file.
    """

    path: Path
    columns: tuple[str, ...]
    has_header: bool
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    def place(self, row: int) -> str:
        """Words where a row stands: `poses.csv, line 3`."""
        return f"{self.path.name}, line {self.lines[row]}"


def is_number(cell: str) -> bool:
    """Tells whether a cell is a number; NaN and inf count."""
    return _NUMBER.fullmatch(cell) is not None


def read_table(path: Path) -> TextTable:
    """Reads a table; the separator is a semicolon, a tab, a comma or blanks, in this order.

    A comment that has as many words as the table has columns, right before the first row, is the
    header where there is no other, whatever stands before a colon in it; a first line such as
    `sep=;` names the separator. Between semicolons or tabs a decimal comma is read as a point. Rows
    may be lists in brackets, with a name before them. Empty rows, and empty columns behind all
    others, are left aside.

    Raises:
        DataError: It is missing, no text, too large, empty, its rows differ in length, or two
            columns have one name.
    """
    text, where = read_plain_text(path), str(path)
    if text.count("\n") + text.count("\r") > MAX_VALUES:
        raise too_many(where)
    every = _LINE_END.split(text)
    said = _SEPARATOR.fullmatch(every[0])
    if said:
        every[0] = ""
    lines = _without_brackets(
        [
            (at, line)
            for at, line in enumerate(every, start=1)
            if line.strip(_EMPTY) and not line.strip().startswith(_COMMENTS)
        ]
    )
    if not lines:
        raise DataError(f"{where} has no rows.", culprits=[where])
    separator = said[1] if said else next((name for name in ";\t," if name in lines[0][1]), " ")
    if sum(line.count(separator) + 1 for _, line in lines) > MAX_VALUES:
        raise too_many(where)
    numbers = [at for at, _ in lines]
    cells = [_cells(line, separator, f"{where}, line {at}") for at, line in lines]
    rows = without_margin(cells)
    columns = rows[0] if not any(is_number(row) for row in rows[0]) else None
    if columns is not None:
        rows, numbers = rows[1:], numbers[1:]
    else:
        columns = _header_in_comments(every[: numbers[0] - 1], separator, len(rows[0]))
    if not rows:
        raise DataError(f"{where} has a header and no rows.", culprits=[where])
    width = len(columns or rows[0])
    for at, row in zip(numbers, rows, strict=True):
        if len(row) != width:
            raise DataError(
                f"{where}, line {at}: {len(row)} cells; {width} are needed, as in the first row.",
                culprits=[f"{where}, line {at}"],
                next_step="Where commas are decimal, separate the columns by semicolons or tabs.",
            )
    named = tuple(columns or (str(at) for at in range(1, width + 1)))
    return TextTable(path, _unique(named, where), columns is not None, tuple(rows), tuple(numbers))


def _without_brackets(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Takes what stands in the brackets of lines that are all lists of one kind."""
    listed = [_LISTED.fullmatch(line.strip()) for _, line in lines]
    inside = [next(filter(None, match.groups()), "") for match in listed if match]
    return list(zip((at for at, _ in lines), inside, strict=True)) if all(listed) else lines


def _cells(line: str, separator: str, where: str) -> tuple[str, ...]:
    if separator == " ":
        return tuple(line.split())
    try:
        (cells,) = csv.reader(io.StringIO(line), delimiter=separator, skipinitialspace=True)
    except (csv.Error, ValueError) as error:
        raise DataError(f"{where}: {error}.", culprits=[where]) from error
    stripped = tuple(cell.strip() for cell in cells)
    return with_points(stripped) if separator in ";\t" else stripped


def without_margin(rows: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Rows without the first one's columns that are empty in all, behind those that are not.

    Spreadsheets write them where cells were filled once. A single row's cells beyond are kept.
    """
    filled = max(
        (at for row in rows for at, name in enumerate(row, start=1) if name.strip()), default=0
    )
    return [row[:filled] + row[max(filled, len(rows[0])) :] for row in rows]


def with_points(cells: Sequence[str]) -> tuple[str, ...]:
    """Cells that commas do not separate, with decimal commas as points."""
    return tuple(
        cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells
    )


def separator_of(header: str) -> str:
    """The separator of a table whose columns have names without blanks: a comma where it has any.

    Spreadsheets in languages with a decimal comma write semicolons.
    """
    return next((name for name in ";\t" if name in header and "," not in header), ",")


def _header_in_comments(
    before: Sequence[str], separator: str, width: int
) -> tuple[str, ...] | None:
    comment = next((name.strip() for name in reversed(before) if name.strip()), "")
    if not comment.startswith(_COMMENTS):
        return None
    said = comment.lstrip("#%/ ").rpartition(":")[2]
    words = said.replace(separator, " ").replace(",", " ").split()
    fits = len(words) == width and not any(is_number(word) for word in words)
    return tuple(words) if fits else None


def _unique(columns: tuple[str, ...], where: str) -> tuple[str, ...]:
    named = tuple(name or f"column_{at}" for at, name in enumerate(columns, start=1))
    twice = [a for a, b in pairwise(sorted(named)) if a == b]
    if twice:
        raise DataError(
            f"{where}: two columns are named {twice[0][:60]!r}.",
            culprits=[where],
            next_step="Give every column a name of its own.",
        )
    return named
