"""Text, facts and tables as Markdown for the viewer."""

import re
from collections.abc import Iterable, Iterator

import rerun as rr

from visioncal.present.tables import Fact, Table

# Marks of rows that are set in bold.
_BOLD = ("taken", "sure")


def plain(text: str) -> str:
    """Escapes text from outside: in Markdown, the viewer would load pictures and follow links."""
    return re.sub(r"([\\`*_{}\[\]()#+\-.!|<>~&])", r"\\\1", " ".join(text.split()))


def markdown(text: str) -> rr.TextDocument:
    """A text document that viewers render as Markdown."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def fact_lines(facts: Iterable[Fact]) -> Iterator[str]:
    """Facts as a list."""
    for fact in facts:
        note = f" ({plain(fact.note)})" if fact.note else ""
        yield f"- {plain(fact.label)}: {plain(fact.value)}{note}"


def table_lines(table: Table | None) -> Iterator[str]:
    """A table, after an empty line; nothing for None."""
    if table is None:
        return
    yield ""
    yield _line(map(plain, table.titles))
    yield _line("---" if column in table.words else "---:" for column in range(len(table.titles)))
    for row in table.rows:
        first, *rest = map(plain, row.cells)
        is_bold = row.mark in _BOLD or not rest
        rest = rest or [""] * (len(table.titles) - 1)
        yield _line([f"**{first}**" if is_bold else first, *rest])


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
