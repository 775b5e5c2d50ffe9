"""Text tables: CSV, TSV or blank-separated, with or without header and comments.

`parse_table` splits the tables of a session, `read_table` those of other programs; `columns.py`
reads and checks their cells.
"""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from visioncal.core.choices import UNITS_M
from visioncal.core.documents.toml import MAX_VALUES, too_many
from visioncal.core.documents.values import DECIMAL, DECIMAL_COMMA, read_plain_text
from visioncal.core.errors import DataError

_NUMBER = re.compile(rf"{DECIMAL}|[+-]?(nan|inf)", re.I)
_DECIMAL_COMMA = re.compile(DECIMAL_COMMA)
# A number with one comma that may separate its thousands.
THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2},[0-9]{3}")
# Excel's declaration of the separator in the first line.
_SEPARATOR = re.compile(r"sep=([;\t,])\s*", re.I)
# Characters of an empty row.
_EMPTY = "; ,\t\r\n"
_COMMENTS = ("#", "%", "//")
# A row printed as a list, possibly with a name: `pose: [1.0, 2.0]`, `array([1, 2]),`.
_LISTED = re.compile(r"[^\[\](){}]*+[\[({]++([^\[\](){}]*+)[\])}]++\s*+[,;]?\s*+")
# The unit of a column in a row below the header.
_UNIT = re.compile(rf"(?:{'|'.join(UNITS_M)}|deg|rad|°|º|s|ms)?", re.I)
# A text that begins so is a formula to spreadsheets.
_FORMULAS = ("=", "+", "-", "@", "\t", "\r")


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


def parse_table(text: str, label: str) -> TextTable:
    """Splits a table with a header row; blank lines are skipped. `label` is its name in messages.

    Where the header has semicolons or tabs and no comma, they separate the columns. Decimal commas
    are read as points, as many spreadsheets write them, in quotes between commas. Empty columns at
    the end are dropped. Rows may differ in length; an empty text has no columns. Raises DataError.
    """
    header = text.lstrip().partition("\n")[0]
    separator = next((name for name in ";\t" if name in header and "," not in header), ",")
    split = _split(enumerate(io.StringIO(text, newline=""), 1), label, separator)
    rows = _with_points(split, separator)
    names, *filled = _without_margin([cells for _, cells in rows]) if rows else [()]
    columns = tuple(name.strip() for name in names)
    return TextTable(label, columns, tuple(filled), [line for line, _ in rows[1:]])


def _split(
    lines: Iterable[tuple[int, str]], label: str, separator: str, *, stripped: bool = False
) -> Iterator[tuple[int, tuple[str, ...]]]:
    """The line in which each filled row begins, and its cells."""
    at: list[int] = []

    def texts() -> Iterator[str]:
        for line, text in lines:
            at.append(line)
            yield text

    try:
        for cells in csv.reader(
            texts(), strict=not stripped, delimiter=separator, skipinitialspace=stripped
        ):
            if any(cell.strip() for cell in cells):
                yield at[0], tuple(cell.strip() for cell in cells) if stripped else tuple(cells)
            at.clear()
    except csv.Error as error:
        place = f"{label}, line {at[0]}"
        raise DataError(
            f"{place}: {error}.",
            culprits=[place],
            next_step='A field that holds a comma or a "quote" is put in quotes, "" inside.',
        ) from error


def _with_points(
    rows: Iterable[tuple[int, tuple[str, ...]]], separator: str
) -> list[tuple[int, tuple[str, ...]]]:
    """Rows with decimal points; between commas only where some number shows what its comma is."""
    split = list(rows)
    marks = [
        cell for _, row in split for cell in row if "," in cell and _DECIMAL_COMMA.fullmatch(cell)
    ]
    if separator == "," and all(map(THOUSANDS.fullmatch, marks)):
        return split
    points = {cell: cell.replace(",", ".") for cell in marks}
    return [(at, tuple(points.get(cell, cell) for cell in row)) for at, row in split]


def csv_text(rows: Iterable[Iterable[object]], *, inert: bool = False) -> str:
    """Formats rows as CSV with the line ends of UNIX.

    A text that begins like a formula is evaluated by spreadsheets; `inert` puts an apostrophe
    before it, for tables that leave for other programs.
    """

    def quoted(cell: object) -> str:
        text = str(cell)
        if inert and text.startswith(_FORMULAS) and not is_number(text):
            text = f"'{text}"
        # csv.writer does not quote a lone carriage return.
        return '"' + text.replace('"', '""') + '"' if {*text} & {*',"\r\n'} else text

    return "".join(",".join(map(quoted, row)) + "\n" for row in rows)


def is_number(cell: str) -> bool:
    """Whether a cell is a number, NaN and inf included."""
    return _NUMBER.fullmatch(cell) is not None


def read_table(path: Path, text: str | None = None) -> TextTable:
    """Reads a table; the separator is a semicolon, a tab, a comma or blanks, in this order.

    `text` is that of the file, where it has been read; None to read it.

    Without a header row, a comment right before the first row is the header if it has one word per
    column after any colon; a first line such as `sep=;` declares the separator. Decimal commas
    are read as points, in quotes between commas. Rows may be lists in brackets, with a name before
    them. Empty rows, empty trailing columns, titles or a preamble above the header, and results
    below an empty line are ignored.
    Raises DataError.
    """
    text, where = read_plain_text(path) if text is None else text, str(path)
    if sum(map(text.count, ";\t,\n\r ")) > MAX_VALUES:
        raise too_many(where)
    all_lines = [*io.StringIO(text, newline="")]
    declared = _SEPARATOR.fullmatch("".join(all_lines[:1]))
    lines = [
        (at, line)
        for at, line in enumerate(all_lines, start=1)
        if line.strip(_EMPTY) and not line.strip().startswith(_COMMENTS)
    ][1 if declared else 0 :]
    listed = [_LISTED.fullmatch(line) for _, line in lines]
    if all(listed):
        inside = (match[1] for match in listed if match)
        lines = list(zip((at for at, _ in lines), inside, strict=True))
    # Titles may stand above.
    usual = lines[3 * len(lines) // 4][1] if lines else ""
    separator = declared[1] if declared else next((mark for mark in ";\t," if mark in usual), " ")
    split = [(at, tuple(line.split())) for at, line in lines]
    if separator != " ":
        split = _with_points(_split(lines, where, separator, stripped=True), separator)
    if not split or not all(cells for _, cells in split):
        raise DataError(f"{where} has no rows.", culprits=[where])
    split = _below_titles(_above_results(_within_width(split)))
    numbers, cells = [at for at, _ in split], [cells for _, cells in split]
    rows = _without_margin(cells)
    columns = rows[0] if not any(is_number(cell) for cell in rows[0]) else None
    if columns is not None:
        rows, numbers = rows[1:], numbers[1:]
    else:
        columns = _header_in_comments(all_lines[: numbers[0] - 1], separator, len(rows[0]))
    if not rows:
        raise DataError(f"{where} has a header and no rows.", culprits=[where])
    width = len(columns or rows[0])
    for at, row in zip(numbers, rows, strict=True):
        if len(row) != width:
            line = all_lines[at - 1]
            raise DataError(
                f"{where}, line {at}: {len(row)} cells, but must be {width}, as in the first row.",
                culprits=[f"{where}, line {at}"],
                next_step="Where commas are decimal, separate the columns by semicolons or tabs."
                if re.search("[0-9],[0-9]", line) and not re.search(r"\.|,(?![0-9])", line)
                else "Give every row as many cells, and begin lines of other content with #.",
            )
    return TextTable(
        path.name, _named(columns, width, where), tuple(rows), numbers, columns is not None
    )


def _within_width(rows: list[tuple[int, tuple[str, ...]]]) -> list[tuple[int, tuple[str, ...]]]:
    """Rows without empty cells beyond the width of most, as of a comma at a line's end."""
    width = Counter(len(cells) for _, cells in rows).most_common(1)[0][0]
    return [(at, cells if any(cells[width:]) else cells[:width]) for at, cells in rows]


def _below_titles(rows: list[tuple[int, tuple[str, ...]]]) -> list[tuple[int, tuple[str, ...]]]:
    """Rows without what stands above: titles of other widths, or rows filled in few cells.

    Units in a row of their own join the names.
    """
    widths = [len(cells) for _, cells in rows]
    filled = [sum(map(bool, cells)) * (len(cells) == widths[-1]) for _, cells in rows]
    fullest = max(filled)
    above = next(at for at, count in enumerate(filled) if 2 * count > fullest)
    # Without a header, rows of few cells may be rows all the same.
    is_header = not any(map(is_number, rows[above][1])) or widths[-1] not in widths[:above]
    is_title = is_header and len(rows) > above + 2 and len({*widths[above:]}) == 1
    rows = rows[above:] if is_title else rows
    if len(rows) > 2 and len(rows[0][1]) == len(units := rows[1][1]):
        plain = [unit.strip("[]()-") for unit in units]
        if any(plain) and all(map(_UNIT.fullmatch, plain)):
            titles = zip(rows[0][1], plain, strict=True)
            return [
                (
                    rows[0][0],
                    tuple(f"{name} [{unit}]" * bool(unit) or name for name, unit in titles),
                ),
                *rows[2:],
            ]
    return rows


def _above_results(rows: list[tuple[int, tuple[str, ...]]]) -> list[tuple[int, tuple[str, ...]]]:
    """Rows without results of a program below: two or more of other widths after an empty line."""
    gaps = [at for at in range(1, len(rows)) if rows[at][0] > rows[at - 1][0] + 1]
    end, widths = gaps[-1] if gaps else len(rows), [len(cells) for _, cells in rows]
    is_result = 3 * len(rows) <= 4 * end < 4 * (len(rows) - 1)
    is_result &= {*widths[:end]}.isdisjoint(widths[end:])
    return rows[:end] if is_result and len({*widths[:end]}) == 1 else rows


def _named(columns: Sequence[str] | None, width: int, where: str) -> tuple[str, ...]:
    """Names of all columns: those of the header, or their numbers without one."""
    if columns is None:
        return tuple(str(at) for at in range(1, width + 1))
    named = tuple(name or f"column_{at}" for at, name in enumerate(columns, start=1))
    twice, count = Counter(named).most_common(1)[0]
    if count > 1:
        raise DataError(
            f"{where}: two columns are named {twice[:60]!r}.",
            culprits=[where],
            next_step="Give every column a name of its own.",
        )
    return named


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


def _header_in_comments(
    before: Sequence[str], separator: str, width: int
) -> tuple[str, ...] | None:
    comment = next((name.strip() for name in reversed(before) if name.strip()), "")
    if not comment.startswith(_COMMENTS):
        return None
    names = comment.lstrip("#%/ ").rpartition(":")[2]
    # Names may have blanks, and units in brackets: `#t, p_x [m], q_w []`.
    words = [cell.strip() for cell in names.split(separator)]
    if separator == " " or len(words) != width or not all(words):
        words = names.replace(separator, " ").replace(",", " ").split()
    # A sentence may have as many words.
    is_whole = all(sum(map(word.count, "([")) == sum(map(word.count, ")]")) for word in words)
    fits = is_whole and len(words) == width and not any(is_number(word) for word in words)
    return tuple(words) if fits else None
