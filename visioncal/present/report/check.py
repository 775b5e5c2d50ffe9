"""The page of a check: one HTML file that says whether a calibration still holds."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from visioncal.calibration.verification.change_hypotheses import NOISE
from visioncal.calibration.verification.check import Check, Suspect
from visioncal.calibration.verification.document import listed_suspects
from visioncal.calibration.verification.messages import thing
from visioncal.calibration.verification.policy import Outcome
from visioncal.core.files import write_atomically
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


@dataclass(frozen=True)
class ChangeRow:
    """A change that was compared, as text; `named` are those that the check takes for true."""

    words: str
    share: str
    named: bool


@dataclass(frozen=True)
class TriggerRow:
    """A reason to calibrate again, as text, and whether it is `fired`, `quiet` or `unknown`."""

    state: str
    words: str


@dataclass(frozen=True, eq=False)
class CheckPage:
    """What the page of a check says.

    Attributes:
        session: Name of the check's session.
        against: Name and time of the calibration.
        passed: Whether it still holds.
        verdict: What was found and what to do, the most important first.
        changes: What may have changed, the likeliest first.
        undone: What the likeliest change is, where one was found; else empty.
        stops: Names of the m stops, by their views.
        before: (m, 2) how far each places the target from where the calibration has it
            [mm, deg].
        after: (m, 2) the same with that change undone.
        triggers: Reasons to calibrate again.
        warnings: What is odd, in sentences.
        not_used: Views that were not used, and why.
    """

    session: str
    against: str
    passed: bool
    verdict: Verdict
    changes: Sequence[ChangeRow]
    undone: str
    stops: Sequence[str]
    before: FloatArray
    after: FloatArray
    triggers: Sequence[TriggerRow]
    warnings: Sequence[str]
    not_used: Sequence[tuple[int, str]]


def write_check(path: Path, page: CheckPage) -> None:
    """Writes the page as one HTML file that needs no network and no script.

    Raises:
        DataError: The file cannot be written.
    """
    write_atomically(path, render_check(page))


def render_check(page: CheckPage) -> str:
    """Renders the page as HTML text."""
    return template("check.html.j2").render(
        page=page,
        version=__version__,
        rows=[
            (name, *(f"{it:.3f}" for it in (before[0], after[0], before[1], after[1])))
            for name, before, after in zip(page.stops, page.before, page.after, strict=True)
        ],
        rms=[
            f"{it:.3f}"
            for it in np.sqrt(np.mean(np.square([page.before, page.after]), axis=1)).T.ravel()
        ],
        plot=_residuals(page),
    )


def _residuals(page: CheckPage) -> Markup:
    """Residuals stop by stop: as the calibration has the cell, and with the change undone."""
    count, sides = len(page.stops), [("as calibrated", svg.ACCENT, page.before)]
    if page.undone:
        sides = [("as calibrated", svg.BAD, page.before),
                 ("with the change undone", svg.ACCENT, page.after)]  # fmt: skip
    step = -(-count // _MOST_LABELS)
    ticks = [(float(it), page.stops[it]) for it in range(0, count, step)]
    figure = Figure(_WIDE_IN, _HIGH_IN)
    rows = boxes(figure, 2, 1, Margins(0.75, top=0.3), (0.0, 0.2))
    for column, label in enumerate(("position [mm]", "rotation [deg]")):
        ((box,), last) = (rows[column], column == 1)
        top = 1.05 * max(float(values[:, column].max()) for *_, values in sides) or 1.0
        panel = Panel(figure, box, Scale(-0.7, count - 0.3), Scale(0.0, top))
        panel.x_axis("stop, by its views" if last else "", ticks, grid=False, words=last)
        panel.y_axis(label)
        for side, (_, colour, values) in enumerate(sides):
            # Side by side where there are two.
            shift = (side - 0.5) * _BAR if page.undone else 0.0
            width = _BAR if page.undone else 1.5 * _BAR
            panel.bars([it + shift for it in range(count)], values[:, column], width, colour)
    if page.undone:
        entries = [("\N{BLACK SQUARE}", colour, words) for words, colour, _ in sides]
        figure.legend(rows[0][0].right, 12.0, entries)
    return figure.inline("Residuals of each stop, before and after the change")


def page_of(check: Check, triggers: Sequence[Outcome], verdict: Verdict) -> CheckPage:
    """Puts together what the page of a check says.

    Args:
        check: The check.
        triggers: What became of the policy's triggers.
        verdict: What it found.
    """
    known, calibration = check.seen.known, check.calibration
    order = {"fired": 0, "unknown": 1, "quiet": 2}
    return CheckPage(
        known.session.name,
        f"{calibration.session_name}, {calibration.created}",
        check.passed,
        verdict,
        [] if check.passed else [_change(check, it) for it in listed_suspects(check)],
        _undone(check),
        [", ".join(map(str, views)) for views in check.seen.views],
        _lengths(check.away),
        _lengths(check.left),
        [TriggerRow(it.state, it.words) for it in sorted(triggers, key=lambda it: order[it.state])],
        check.seen.warnings,
        sorted(known.reasons.items()),
    )


def _undone(check: Check) -> str:
    """The change without which stops are shown, in words; a scatter cannot be undone."""
    found = check.named[0] if check.named else None
    return "" if found is None or found.name == NOISE else thing(check, found)


def _change(check: Check, suspect: Suspect) -> ChangeRow:
    share = 100.0 * suspect.probability
    words = f"{share:.0f} %" if share >= 1.0 else f"{share:.1g} %"
    return ChangeRow(thing(check, suspect), words, suspect in check.named)


def _lengths(twists: FloatArray) -> FloatArray:
    """(m, 2) lengths of (m, 6) twists [mm, deg]."""
    turn, shift = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
    return np.stack([1e3 * shift, np.rad2deg(turn)], axis=1)
