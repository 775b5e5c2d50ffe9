"""The page of a check: one HTML file on whether a calibration still holds."""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.figure import Figure

from visioncal.calibration.verification.change_hypotheses import NOISE
from visioncal.calibration.verification.check import Check
from visioncal.calibration.verification.messages import change_words, listed_suspects
from visioncal.calibration.verification.triggers import Trigger
from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    WIDE_IN,
    bars,
    drawn,
    few_ticks,
    label_x,
    legend,
    panels,
)
from visioncal.present.report.templates import template
from visioncal.present.tables import Table, TableRow

# Width of a stop's bars.
_BAR = 0.38
# Words for the states of triggers, in the order of the table.
_STATES = {"fired": "now", "unknown": "not known", "quiet": "not yet"}


def render_check(check: Check, triggers: Sequence[Trigger], verdict: Verdict) -> str:
    """Renders the page of a check as HTML text."""
    change = check.named[0] if check.named else None
    # The change that can be undone, unlike mere noise.
    undone = "" if change is None or change.cause.kind == NOISE else change_words(check, change)
    stops = [str(view) for view in check.predicted.views]
    before, after = _lengths(check.residuals), _lengths(check.remaining)
    return template("check.html.j2").render(
        check=check,
        kind="Check of a calibration",
        name=check.predicted.observed.session.name,
        subtitle=f"against {check.calibration.session_name}, {check.calibration.created}",
        notes=(),
        judged=verdict,
        provenance={},
        undone=undone,
        changes=_change_table(check),
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
        residuals=_residual_table(stops, before, after if undone else None),
        figure=_residuals(stops, before, after if undone else None),
    )


def _residual_table(stops: Sequence[str], before: FloatArray, after: FloatArray | None) -> Table:
    """Residuals by stop, and their rms; see `_residuals`."""
    sides = {"as calibrated": before} | ({} if after is None else {"undone": after})
    # Positions first, then rotations.
    columns = {
        f"{name} [{unit}]": values[:, column_index]
        for column_index, unit in enumerate(("mm", "deg"))
        for name, values in sides.items()
    }
    rms = [np.sqrt(np.mean(np.square(column))) for column in columns.values()]
    rows = [*zip(stops, *columns.values(), strict=True), ("rms", *rms)]
    return Table.of(
        ("stop (views)", *columns), [(name, *map(significant, row)) for name, *row in rows]
    )


@drawn
def _residuals(
    stops: Sequence[str], before: FloatArray, after: FloatArray | None
) -> tuple[Figure, str]:
    """Residuals by stop: as calibrated, and with the change undone."""
    sides = [("as calibrated", ACCENT if after is None else BAD, before)]
    sides += [] if after is None else [("with the change undone", ACCENT, after)]
    figure, grid = panels(WIDE_IN, 3.6, 2, 1, (0.8, 0.45, 0.06, 0.3), sharex=True)
    # Side by side where there are two.
    width, shifts = (1.5 * _BAR, (0.0,)) if after is None else (_BAR, (-0.5 * _BAR, 0.5 * _BAR))
    places = np.arange(len(stops))
    label_x(grid[1, 0], stops, "stop, by its views")
    for column, label in enumerate(("position [mm]", "rotation [deg]")):
        axes = grid[column, 0]
        for shift, (_, colour, values) in zip(shifts, sides, strict=True):
            bars(axes, places + shift, values[:, column], colour, width)
        axes.set(ylabel=label, ylim=(0.0, None))
        axes.grid(visible=False, axis="x")
        few_ticks(axes, y=4)
    if after is not None:
        legend(figure, [("s", colour, words) for words, colour, _ in sides])
    return figure, "Residuals of each stop, before and after the change"


def _change_table(check: Check) -> Table:
    """Changes that were compared: their probability, and whether the check found them."""
    rows = []
    for suspect in [] if check.passed else listed_suspects(check):
        share, is_found = 100.0 * suspect.probability, suspect in check.named
        cells = (
            f"{share:.0f} %" if share >= 1.0 else f"{share:.1g} %",
            "found" if is_found else "ruled out",
            change_words(check, suspect),
        )
        rows.append(TableRow(cells, "left-out" if is_found else "rejected"))
    return _reasons(rows, ("share", "", "change"))


def _reasons(rows: Iterable[TableRow], titles: tuple[str, str, str] = ("", "", "")) -> Table:
    return Table(titles, tuple(rows), (0, 1, 2))


def _lengths(twists: FloatArray) -> FloatArray:
    """(m, 2) norms of (m, 6) twists [mm, deg]."""
    rotation, translation = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
    return np.stack([1e3 * translation, np.rad2deg(rotation)], axis=1)
