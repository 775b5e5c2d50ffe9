"""Text tables: CSV, TSV or blank-separated, with or without header and comments.

`parse_table` splits the tables of a session, `read_table` those of other programs; `columns.py`
reads and checks their cells.
"""

import csv
import io
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from visioncal.core.documents.values import DECIMAL, read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import MAX_VALUES, too_many

_NUMBER = re.compile(rf"{DECIMAL}|[+-]?(nan|inf)", re.I)
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]+,[0-9]+([eE][+-]?[0-9]+)?")
# Other separators of str.splitlines may be inside a cell.
_LINE_END = re.compile(r"\r\n|\r|\n")
# Excel's declaration of the separator in the first line.
_SEPARATOR = re.compile(r"sep=([;\t,])", re.I)
# Characters of an empty row.
_EMPTY = "; ,\t\r"
_COMMENTS = ("#", "%", "//")
# A row printed as a list, possibly with a name: `pose: [1.0, 2.0]`, `array([1, 2]),`.
_LISTED = re.compile(
    r"(?:[^\W\d][\w .-]*+[:=]\s*+)?(?:[^\W\d][\w.]*+\s*+)?"
    r"(?:\[([^][(){}]*+)\]|\(([^][(){}]*+)\)|\(\[([^][(){}]*+)\]\)|\{([^][(){}]*+)\})\s*+[,;]?"
)


@dataclass(frozen=True)
class TextTable:
    """A table."""

    label: str  # Its file's name, for messages; empty for a table in memory.
    columns: tuple[str, ...]  # Names of the columns by the header, or `1`, `2`, ... without one.
    rows: tuple[tuple[str, ...], ...]  # Cells of the rows.
    lines: Sequence[int]  # The line of each row in the file, or its number in memory.
    has_header: bool = True  # Whether the names come from the file.

    def place(self, row: int) -> str:
        """Location of a row for messages: `poses.csv, line 3`."""
        line = self.lines[row]
        return f"{self.label}, line {line}" if self.label else f"row {line}"


def parse_table(
    text: str,
    label: str,
    most_rows: int = sys.maxsize,
    most_columns: int = sys.maxsize,
    next_step: str = "",
) -> TextTable:
    """Splits a table with a header row; blank lines are skipped.

    Where the header has semicolons or tabs and no comma, they separate the columns, and decimal
    commas are read as points, as many spreadsheets write them. Empty columns at the end are
    dropped. Rows may differ in length; an empty text has no columns.

    Args:
        text: The text.
        label: Its name, for messages.
        most_rows: Largest number of rows.
        most_columns: Largest number of columns.
        next_step: Remedy for a larger table.

    Raises:
        DataError: It is too large, or its quotes do not close.
    """
    header = text.lstrip().partition("\n")[0]
    separator = next((name for name in ";\t" if name in header and "," not in header), ",")
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    for line, cells in _split(text, label, separator):
        if any(cell.strip() for cell in cells):
            rows.append(tuple(cells) if separator == "," else _with_points(cells))
            lines.append(line)
            if len(rows) > most_rows + 1 or len(rows[0]) > most_columns:
                raise DataError(
                    f"{label} has more than {most_rows:,} rows"
                    + (f" or {most_columns:,} columns." if most_columns < sys.maxsize else "."),
                    culprits=[label],
                    next_step=next_step,
                )
    names, *filled = _without_margin(rows) if rows else [()]
    columns = tuple(name.strip() for name in names)
    return TextTable(label, columns, tuple(filled), lines[1:])


def _split(text: str, label: str, separator: str) -> Iterator[tuple[int, list[str]]]:
    """The line in which each row begins, and its cells."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=separator)
    line = 1
    try:
        for cells in reader:
            yield line, cells
            line = reader.line_num + 1
    except csv.Error as error:
        raise DataError(
            f"{label}, line {line}: {error}.",
            culprits=[f"{label}, line {line}"],
            next_step='A field that holds a comma or a "quote" is put in quotes, "" inside.',
        ) from error


def is_number(cell: str) -> bool:
    """Whether a cell is a number, NaN and inf included."""
    return _NUMBER.fullmatch(cell) is not None


def read_table(path: Path) -> TextTable:
    """Reads a table; the separator is a semicolon, a tab, a comma or blanks, in this order.

    Without a header row, a comment right before the first row is the header if it has one word per
    column after any colon; a first line such as `sep=;` declares the separator. With semicolons or
    tabs, decimal commas are read as points. Rows may be lists in brackets, with a name before them.
    Empty rows and empty trailing columns are ignored.

    Raises:
        DataError: It is missing, no text, too large, empty, its rows differ in length, or two
            columns have the same name.
    """
    text, where = read_plain_text(path), str(path)
    if text.count("\n") + text.count("\r") > MAX_VALUES:
        raise too_many(where)
    all_lines = _LINE_END.split(text)
    declared = _SEPARATOR.fullmatch(all_lines[0])
    if declared:
        all_lines[0] = ""
    lines = _without_brackets(
        [
            (at, line)
            for at, line in enumerate(all_lines, start=1)
            if line.strip(_EMPTY) and not line.strip().startswith(_COMMENTS)
        ]
    )
    if not lines:
        raise DataError(f"{where} has no rows.", culprits=[where])
    separator = (
        declared[1] if declared else next((name for name in ";\t," if name in lines[0][1]), " ")
    )
    if sum(line.count(separator) + 1 for _, line in lines) > MAX_VALUES:
        raise too_many(where)
    numbers = [at for at, _ in lines]
    cells = [_cells(line, separator, f"{where}, line {at}") for at, line in lines]
    rows = _without_margin(cells)
    columns = rows[0] if not any(is_number(row) for row in rows[0]) else None
    if columns is not None:
        rows, numbers = rows[1:], numbers[1:]
    else:
        columns = _header_in_comments(all_lines[: numbers[0] - 1], separator, len(rows[0]))
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
    return TextTable(path.name, _unique(named, where), tuple(rows), numbers, columns is not None)


def _without_brackets(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """The content of the brackets, if all lines are lists in brackets; else the lines."""
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
    return _with_points(stripped) if separator in ";\t" else stripped


def _without_margin(rows: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Rows without trailing columns of the first row that are empty in all rows.

    Spreadsheets write them for cells that were cleared. Cells beyond the first row's are kept.
    """
    width = len(rows[0])
    if width and rows[0][-1].strip():
        return [*rows]
    filled = max(
        (at for row in rows for at, name in enumerate(row, start=1) if name.strip()), default=0
    )
    return [row[:filled] + row[max(filled, width) :] for row in rows]


def _with_points(cells: Sequence[str]) -> tuple[str, ...]:
    """Cells with decimal commas replaced by points."""
    return tuple(
        cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells
    )


def _header_in_comments(
    before: Sequence[str], separator: str, width: int
) -> tuple[str, ...] | None:
    comment = next((name.strip() for name in reversed(before) if name.strip()), "")
    if not comment.startswith(_COMMENTS):
        return None
    names = comment.lstrip("#%/ ").rpartition(":")[2]
    words = names.replace(separator, " ").replace(",", " ").split()
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
