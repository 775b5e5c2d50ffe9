"""The page of a check: one HTML file that says whether a calibration still holds."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from visioncal.calibration.verification.change_hypotheses import NOISE
from visioncal.calibration.verification.check import Check, Suspect
from visioncal.calibration.verification.document import listed_suspects
from visioncal.calibration.verification.messages import thing
from visioncal.calibration.verification.policy import Outcome
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.core.version import __version__
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes
from visioncal.present.report.content import template
from visioncal.present.report.svg import Figure

_WIDE_IN, _HIGH_IN = 9.2, 3.6
# Bars of a stop, side by side, and how many labels have room below them.
_BAR, _MOST_LABELS = 0.38, 20


def render_check(check: Check, triggers: Sequence[Outcome], verdict: Verdict) -> str:
    """Renders the page of a check as HTML text."""
    undone, order = _undone(check), ("fired", "unknown", "quiet")
    stops = [", ".join(map(str, views)) for views in check.seen.views]
    before, after = _lengths(check.away), _lengths(check.left)
    return template("check.html.j2").render(
        check=check,
        verdict=verdict,
        version=__version__,
        undone=undone,
        changes=[] if check.passed else [_change(check, it) for it in listed_suspects(check)],
        triggers=sorted(triggers, key=lambda it: order.index(it.state)),
        not_used=sorted(check.seen.known.reasons.items()),
        rows=[
            (name, *(f"{it:.3f}" for it in (was[0], left[0], was[1], left[1])))
            for name, was, left in zip(stops, before, after, strict=True)
        ],
        rms=[f"{it:.3f}" for it in np.sqrt(np.mean(np.square([before, after]), axis=1)).T.ravel()],
        plot=_residuals(stops, before, after if undone else None),
    )


def _residuals(stops: Sequence[str], before: FloatArray, after: FloatArray | None) -> Markup:
    """Residuals stop by stop: as the calibration has the cell, and with the change undone."""
    count, sides = len(stops), [("as calibrated", svg.ACCENT, before)]
    if after is not None:
        sides = [("as calibrated", svg.BAD, before),
                 ("with the change undone", svg.ACCENT, after)]  # fmt: skip
    step = -(-count // _MOST_LABELS)
    ticks = [(float(it), stops[it]) for it in range(0, count, step)]
    figure = Figure(_WIDE_IN, _HIGH_IN)
    rows = boxes(figure, 2, 1, Margins(0.75, top=0.3), (0.0, 0.2))
    # Side by side where there are two.
    width, shifts = (1.5 * _BAR, (0.0,)) if after is None else (_BAR, (-0.5 * _BAR, 0.5 * _BAR))
    for column, label in enumerate(("position [mm]", "rotation [deg]")):
        ((box,), last) = (rows[column], column == 1)
        top = 1.05 * max(float(values[:, column].max()) for *_, values in sides) or 1.0
        panel = Panel(figure, box, Scale(-0.7, count - 0.3), Scale(0.0, top))
        panel.x_axis("stop, by its views" if last else "", ticks, grid=False, words=last)
        panel.y_axis(label)
        for shift, (_, colour, values) in zip(shifts, sides, strict=True):
            panel.bars([it + shift for it in range(count)], values[:, column], width, colour)
    if after is not None:
        entries = [("\N{BLACK SQUARE}", colour, words) for words, colour, _ in sides]
        figure.legend(rows[0][0].right, 12.0, entries)
    return figure.inline("Residuals of each stop, before and after the change")


def _undone(check: Check) -> str:
    """The change without which stops are shown, in words; a scatter cannot be undone."""
    found = check.named[0] if check.named else None
    return "" if found is None or found.name == NOISE else thing(check, found)


def _change(check: Check, suspect: Suspect) -> tuple[str, str, bool]:
    """A change that was compared: in words, its share, and whether the check takes it for true."""
    share = 100.0 * suspect.probability
    words = f"{share:.0f} %" if share >= 1.0 else f"{share:.1g} %"
    return thing(check, suspect), words, suspect in check.named


def _lengths(twists: FloatArray) -> FloatArray:
    """(m, 2) lengths of (m, 6) twists [mm, deg]."""
    turn, shift = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
    return np.stack([1e3 * shift, np.rad2deg(turn)], axis=1)
