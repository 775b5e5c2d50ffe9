"""The page of a batch."""

from collections import Counter
from collections.abc import Sequence

from visioncal.core.number_format import significant
from visioncal.present.report.templates import template
from visioncal.results.fleet import FleetRow

_ICONS = {"good": "good", "check": "check"}


def fleet_page(rows: Sequence[FleetRow]) -> str:
    """Renders the page as HTML text, with links relative to its folder; worst sessions first."""
    states = Counter(row.verdict or row.state for row in rows)
    return template("fleet.html.j2", has_result=False).render(
        kind="Batch",
        name=f"{len(rows)} sessions",
        subtitle="",
        notes=(),
        rows=rows,
        states=[(name, states[name]) for name in ("good", "check", "bad", "failed")],
        icon_of=lambda value: _ICONS.get(value.verdict, "bad"),
        figure=lambda value: "" if value is None else significant(value),
    )
