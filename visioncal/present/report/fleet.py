"""The page of a batch: outstanding sessions, and the results of all."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from visioncal.core.number_format import significant
from visioncal.present.report.templates import template
from visioncal.present.tables import Table, TableRow
from visioncal.results.fleet import FEWEST, FleetRow

_ICONS = {"good": "good", "check": "check"}
# Largest number of outstanding sessions listed per group.
_MOST_NAMED = 6


@dataclass(frozen=True)
class _Odd:
    """Outstanding sessions of one group, such as one robot, with the reasons of the worst."""

    title: str
    count: str
    reasons: tuple[str, ...]
    rows: tuple[FleetRow, ...]
    more: int


def fleet_page(rows: Sequence[FleetRow]) -> str:
    """Renders the page as HTML text, with links relative to its folder; worst sessions first."""
    states = Counter(row.verdict or row.state for row in rows)
    return template("fleet.html.j2").render(
        kind="Batch",
        name=f"{len(rows)} sessions",
        subtitle="",
        notes=(),
        rows=rows,
        odd=list(_odd(rows)),
        is_comparable=any(
            count >= FEWEST
            for count in Counter(row.robot for row in rows if row.state != "failed").values()
        ),
        states=[(name, states[name]) for name in ("good", "check", "bad", "failed")],
        changes=Table(
            ("", ""),
            tuple(TableRow((row.name, row.change), "look") for row in rows if row.changed),
            (0, 1),
        ),
        is_compared=any(row.changed is not None for row in rows),
        icon_of=lambda value: _ICONS.get(value.verdict, "bad"),
        figure=_figure,
    )


def _figure(value: float | None) -> str:
    return "" if value is None else significant(value)


def _odd(rows: Sequence[FleetRow]) -> Iterator[_Odd]:
    """Groups of outstanding sessions, in the order of the worst of each."""
    outstanding = [row for row in rows if row.score > 0.0]
    order = list(dict.fromkeys(row.group or row.name for row in outstanding))
    sizes = Counter(row.group or row.name for row in rows)
    grouped = sorted(outstanding, key=lambda value: order.index(value.group or value.name))
    for name, members in groupby(grouped, key=lambda value: value.group or value.name):
        worst_first = tuple(members)
        reasons = tuple(worst_first[0].stands_out.split("; "))
        count = f"{len(worst_first)} of {sizes[name]} sessions" if sizes[name] > 1 else ""
        listed = worst_first[:_MOST_NAMED]
        yield _Odd(name, count, reasons, listed, len(worst_first) - len(listed))
