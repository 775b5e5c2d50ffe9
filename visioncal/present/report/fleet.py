"""The page of a batch: outstanding sessions, and the results of all."""

from collections import Counter
from collections.abc import Iterator, Sequence

from visioncal.core.number_format import significant
from visioncal.present.report.templates import template
from visioncal.results.fleet import FEWEST, FleetRow

_ICONS = {"good": "good", "check": "check"}
# Largest number of outstanding sessions listed per group.
_MOST_NAMED = 6


def fleet_page(rows: Sequence[FleetRow]) -> str:
    """Renders the page as HTML text, with links relative to its folder; worst sessions first."""
    states = Counter(row.verdict or row.state for row in rows)
    return template("fleet.html.j2", has_result=False).render(
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
        icon_of=lambda value: _ICONS.get(value.verdict, "bad"),
        figure=_figure,
    )


def _figure(value: float | None) -> str:
    return "" if value is None else significant(value)


def _odd(rows: Sequence[FleetRow]) -> Iterator[dict[str, object]]:
    """Groups of outstanding sessions, such as of one robot, in the order of the worst of each."""
    groups: dict[str, list[FleetRow]] = {}
    for row in rows:
        if row.score > 0.0:
            groups.setdefault(row.group or row.name, []).append(row)
    sizes = Counter(row.group or row.name for row in rows)
    for name, members in groups.items():
        yield {
            "title": name,
            "count": f"{len(members)} of {sizes[name]} sessions" if sizes[name] > 1 else "",
            "reasons": members[0].stands_out.split("; "),
            "rows": members[:_MOST_NAMED],
            "more": len(members[_MOST_NAMED:]),
        }
