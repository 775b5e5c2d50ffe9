"""The page of a batch: what stands out among many sessions, and the results of all."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from visioncal.core.number_format import significant
from visioncal.present.report.templates import template
from visioncal.present.tables import Row, Table
from visioncal.results.fleet import CellFigures, FleetRow

_ERRORS = {
    "DataError": "input",
    "DegenerateError": "not determined",
    "ConvergenceError": "not settled",
}
_ICONS = {"good": "good", "check": "check"}
# So many of the sessions of one robot are named by what stands out of them.
_MOST_NAMED = 6


@dataclass(frozen=True)
class _Odd:
    """What stands out of the sessions in one folder, as those of one robot are: of the worst."""

    title: str
    count: str
    reasons: tuple[str, ...]
    rows: tuple[FleetRow, ...]
    more: int


def fleet_page(rows: Sequence[FleetRow], cells: Sequence[CellFigures] = ()) -> str:
    """Renders the page as HTML text, whose links are relative to its folder.

    Args:
        rows: Those first that stand out the most.
        cells: What simulated ones came to, by what they have in common.
    """
    states = Counter(it.verdict or it.state for it in rows)
    return template("fleet.html.j2").render(
        kind="Batch",
        name=f"{len(rows)} sessions",
        subtitle="",
        notes=(),
        rows=rows,
        cells=_cell_table(cells),
        odd=list(_odd(rows)),
        states=[(name, states[name]) for name in ("good", "check", "bad", "failed")],
        changes=_reasons((it.name, "", it.change, "look") for it in rows if it.changed),
        is_compared=any(it.changed is not None for it in rows),
        failures=_reasons(
            (it.name, _ERRORS.get(it.error, it.error), f"{it.words} {it.next_step}", "rejected")
            for it in rows
            if it.state == "failed"
        ),
        icon_of=lambda it: _ICONS.get(it.verdict, "bad"),
        figure=_figure,
    )


def _cell_table(cells: Sequence[CellFigures]) -> Table:
    """What simulated sessions came to, by what they have in common."""
    titles = (
        "cell",
        "results",
        "good",
        "95 % of picks within [mm]",
        "sigma of the camera [mm]",
        "95 % of cameras off by [mm]",
    )
    rows = (
        (it.name, f"{it.results} of {it.count}", str(it.good),
         *map(_figure, (it.radius95_mm, it.sigma_mm, it.error_mm)))
        for it in cells
    )  # fmt: skip
    return Table.of(titles, rows)


def _reasons(rows: Iterable[tuple[str, str, str, str]]) -> Table:
    """Sessions by name, with what is said of them and how that is marked."""
    marked = (Row((name, kind, words.strip()), mark) for name, kind, words, mark in rows)
    return Table(("", "", ""), tuple(marked), (0, 1, 2))


def _figure(value: float | None) -> str:
    return "" if value is None else significant(value)


def _odd(rows: Sequence[FleetRow]) -> Iterator[_Odd]:
    """By folder, in the order of the worst that stands out in each."""
    standing = [it for it in rows if it.score > 0.0]
    order = list(dict.fromkeys(it.group or it.name for it in standing))
    sizes = Counter(it.group or it.name for it in rows)
    by_place = sorted(standing, key=lambda it: order.index(it.group or it.name))
    for name, members in groupby(by_place, key=lambda it: it.group or it.name):
        mine = tuple(members)
        reasons = tuple(mine[0].stands_out.split("; "))
        count = f"{len(mine)} of {sizes[name]} sessions" if sizes[name] > 1 else ""
        named = mine[:_MOST_NAMED]
        yield _Odd(name, count, reasons, named, len(mine) - len(named))
