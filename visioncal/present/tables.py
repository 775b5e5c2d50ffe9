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
    """A row of a table.

    Attributes:
        cells: Its text; one alone is a heading of the rows below.
        mark: What it is marked as: `taken`, `sure`, `used`, `look` (at it), `left-out` or
            `rejected`; empty for nothing.
        anchor: By what name a link leads to it; empty for none.
    """

    cells: tuple[str, ...]
    mark: str = ""
    anchor: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        titles: Of its columns.
        rows: Its rows.
        words: The places of columns that have words; the others have figures.
    """

    titles: tuple[str, ...]
    rows: tuple[TableRow, ...]
    words: tuple[int, ...] = (0,)

    @classmethod
    def of(
        cls,
        titles: Sequence[str],
        rows: Iterable[Sequence[str] | TableRow],
        words: tuple[int, ...] = (0,),
    ) -> "Table":
        """A table without the columns in which nothing is known."""
        marked = [row if isinstance(row, TableRow) else TableRow(tuple(row)) for row in rows]
        filled = [group.cells for group in marked if len(group.cells) > 1]
        kept = [
            at
            for at in range(len(titles))
            if not filled or any(value[at] not in ("", _UNKNOWN) for value in filled)
        ]
        return cls(
            tuple(titles[at] for at in kept),
            tuple(replace(group, cells=_some(group.cells, kept)) for group in marked),
            tuple(place for place, at in enumerate(kept) if at in words),
        )

    def parts(self, count: int) -> Iterator["Table"]:
        """Its rows in so many tables, one beside the other."""
        size = max(-(-len(self.rows) // count), 1)
        for at in range(0, len(self.rows), size):
            yield replace(self, rows=self.rows[at : at + size])


def _some(cells: tuple[str, ...], kept: Sequence[int]) -> tuple[str, ...]:
    return tuple(cells[at] for at in kept) if len(cells) > 1 else cells
