"""The page of a batch: what stands out among many sessions, and the results of all."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from visioncal.core.number_format import significant
from visioncal.present.report.templates import template
from visioncal.present.tables import Table, TableRow
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
    states = Counter(row.verdict or row.state for row in rows)
    return template("fleet.html.j2").render(
        kind="Batch",
        name=f"{len(rows)} sessions",
        subtitle="",
        notes=(),
        rows=rows,
        cells=_cell_table(cells),
        odd=list(_odd(rows)),
        states=[(name, states[name]) for name in ("good", "check", "bad", "failed")],
        changes=_reasons((row.name, "", row.change, "look") for row in rows if row.changed),
        is_compared=any(row.changed is not None for row in rows),
        failures=_reasons(
            (
                row.name,
                _ERRORS.get(row.error, row.error),
                f"{row.words} {row.next_step}",
                "rejected",
            )
            for row in rows
            if row.state == "failed"
        ),
        icon_of=lambda value: _ICONS.get(value.verdict, "bad"),
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
        (cell.name, f"{cell.results} of {cell.count}", str(cell.good),
         *map(_figure, (cell.radius95_mm, cell.sigma_mm, cell.error_mm)))
        for cell in cells
    )  # fmt: skip
    return Table.of(titles, rows)


def _reasons(rows: Iterable[tuple[str, str, str, str]]) -> Table:
    """Sessions by name, with what is said of them and how that is marked."""
    marked = (TableRow((name, kind, words.strip()), mark) for name, kind, words, mark in rows)
    return Table(("", "", ""), tuple(marked), (0, 1, 2))


def _figure(value: float | None) -> str:
    return "" if value is None else significant(value)


def _odd(rows: Sequence[FleetRow]) -> Iterator[_Odd]:
    """By folder, in the order of the worst that stands out in each."""
    standing = [row for row in rows if row.score > 0.0]
    order = list(dict.fromkeys(row.group or row.name for row in standing))
    sizes = Counter(row.group or row.name for row in rows)
    by_place = sorted(standing, key=lambda value: order.index(value.group or value.name))
    for name, members in groupby(by_place, key=lambda value: value.group or value.name):
        mine = tuple(members)
        reasons = tuple(mine[0].stands_out.split("; "))
        count = f"{len(mine)} of {sizes[name]} sessions" if sizes[name] > 1 else ""
        named = mine[:_MOST_NAMED]
        yield _Odd(name, count, reasons, named, len(mine) - len(named))
