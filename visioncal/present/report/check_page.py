"""The page of a check, in words and figures."""

from collections.abc import Sequence

import numpy as np

from visioncal.calibration.verification.change_hypotheses import NOISE
from visioncal.calibration.verification.check import Check, Suspect
from visioncal.calibration.verification.document import listed_suspects
from visioncal.calibration.verification.messages import thing
from visioncal.calibration.verification.policy import Outcome
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.present.report.check import ChangeRow, CheckPage, TriggerRow


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
