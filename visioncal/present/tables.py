"""Facts and tables of text, which pages and recordings show."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from visioncal.core.number_format import significant

_UNKNOWN = significant(None)


@dataclass(frozen=True)
class Fact:
    """A labelled figure or phrase."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class TableRow:
    """A row of a table."""

    cells: tuple[str, ...]  # Its text; a single cell is a heading of the rows below.
    # Kind of highlighting: `taken`, `sure`, `used`, `look` (worth a look), `left-out` or
    # `rejected`; empty for none.
    mark: str = ""
    anchor: str = ""  # Name that links lead to; empty for none.


@dataclass(frozen=True)
class Table:
    """A table."""

    titles: tuple[str, ...]  # Column titles.
    rows: tuple[TableRow, ...]  # Its rows.
    words: tuple[int, ...] = (0,)  # Indices of columns with text; the others have figures.

    @classmethod
    def of(
        cls,
        titles: Sequence[str],
        rows: Iterable[Sequence[str] | TableRow],
        words: tuple[int, ...] = (0,),
    ) -> "Table":
        """A table without the columns in which no value is known."""
        all_rows = [
            given if isinstance(given, TableRow) else TableRow(tuple(given)) for given in rows
        ]
        filled = [row.cells for row in all_rows if len(row.cells) > 1]
        kept = [
            column
            for column in range(len(titles))
            if not filled or any(value[column] not in ("", _UNKNOWN) for value in filled)
        ]
        return cls(
            tuple(titles[column] for column in kept),
            tuple(
                replace(row, cells=tuple(row.cells[at] for at in kept))
                if len(row.cells) > 1
                else row
                for row in all_rows
            ),
            tuple(index for index, column in enumerate(kept) if column in words),
        )

    def parts(self, count: int) -> Iterator["Table"]:
        """Splits the rows into at most `count` tables, to stand side by side."""
        size = max(-(-len(self.rows) // count), 1)
        for start in range(0, len(self.rows), size):
            yield replace(self, rows=self.rows[start : start + size])
