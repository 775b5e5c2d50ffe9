"""The page of a check: one HTML file on whether a calibration still holds."""

from collections.abc import Iterable, Sequence

import numpy as np

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.present.report.templates import template
from visioncal.present.tables import Table, TableRow
from visioncal.verification import NOISE, Check, Trigger, change_words, listed_changes

# Words for the states of triggers, in the order of the table.
_STATES = {"fired": "now", "unknown": "not known", "quiet": "not yet"}


def render_check(check: Check, triggers: Sequence[Trigger], verdict: Verdict) -> str:
    """Renders the page of a check as HTML text."""
    change = check.named[0] if check.named else None
    # The change that can be undone, unlike mere noise.
    undone = "" if change is None or change.cause.kind == NOISE else change_words(check, change)
    stops = [str(view) for view in check.predicted.views]
    before, after = _lengths(check.residuals), _lengths(check.remaining)
    rows = []
    for listed in [] if check.passed else listed_changes(check):
        share, is_found = 100.0 * listed.probability, listed in check.named
        cells = (
            f"{share:.0f} %" if share >= 1.0 else f"{share:.1g} %",
            "found" if is_found else "ruled out",
            change_words(check, listed),
        )
        rows.append(TableRow(cells, "left-out" if is_found else "rejected"))
    sides = {"as calibrated": before} | ({"undone": after} if undone else {})
    # Positions first, then rotations.
    residuals = {
        f"{name} [{unit}]": values[:, column_index]
        for column_index, unit in enumerate(("mm", "deg"))
        for name, values in sides.items()
    }
    rms = ("rms", *(np.sqrt(np.mean(np.square(column))) for column in residuals.values()))
    by_stop = [*zip(stops, *residuals.values(), strict=True), rms]
    return template("check.html.j2").render(
        check=check,
        kind="Check of a calibration",
        name=check.predicted.observed.session.name,
        subtitle=f"against {check.calibration.session_name}, {check.calibration.created}",
        notes=(),
        judged=verdict,
        provenance={},
        undone=undone,
        changes=_reasons(rows, ("share", "", "change")),
        triggers=_reasons(
            TableRow(
                (_STATES[state], "", trigger.words), "look" if state == "fired" else "rejected"
            )
            for state in _STATES
            for trigger in triggers
            if trigger.state == state
        ),
        not_used=_reasons(
            TableRow((str(view), "not used", reason), "rejected")
            for view, reason in sorted(check.predicted.observed.reasons.items())
        ),
        residuals=Table.of(
            ("stop (views)", *residuals), [(name, *map(significant, row)) for name, *row in by_stop]
        ),
    )


def _reasons(rows: Iterable[TableRow], titles: tuple[str, str, str] = ("", "", "")) -> Table:
    return Table(titles, tuple(rows), (0, 1, 2))


def _lengths(twists: FloatArray) -> FloatArray:
    """(m, 2) norms of (m, 6) twists [mm, deg]."""
    rotation, translation = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
    return np.stack([1e3 * translation, np.rad2deg(rotation)], axis=1)
