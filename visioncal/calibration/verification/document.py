"""verify.json."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from visioncal.calibration.verification.check import Check, Suspect
from visioncal.calibration.verification.messages import described, verdict_of
from visioncal.calibration.verification.policy import Outcome
from visioncal.core.verdict import Verdict

SCHEMA = 1
# Changes that are less likely than this share get no line.
_LISTED_SHARE = 1e-3


def to_document(
    check: Check, triggers: Sequence[Outcome], verdict: Verdict | None = None
) -> dict[str, Any]:
    """Writes a check as JSON has it; what is not known is absent.

    Args:
        check: The check.
        triggers: What became of the policy's triggers.
        verdict: What it found, with the paths of the run; without them where None.
    """
    calibration, known, verdict = check.calibration, check.seen.known, verdict or verdict_of(check)
    return {
        "schema": SCHEMA,
        "passed": check.passed,
        "calibration": {
            "session": calibration.session_name,
            "sha256": calibration.session_sha256,
            "created": calibration.created,
        },
        "session": {"name": known.session.name, "sha256": known.session.digest()},
        "sentences": list(verdict.reasons),
        "next": [vars(step) for step in verdict.next_steps],
        "changes": [_change(check, suspect) for suspect in check.named],
        "others": [
            _change(check, suspect)
            for suspect in listed_suspects(check)
            if suspect not in check.named
        ],
        "explained": check.explained,
        "log10_evidence": check.log_evidence / float(np.log(10.0)),
        "misfit": check.misfit,
        "degrees_of_freedom": check.freedom,
        "p_value": check.p_value,
        "camera_sigma": {
            "rotation_deg": np.rad2deg(check.camera_sigma[:3]).tolist(),
            "translation_mm": (1e3 * check.camera_sigma[3:]).tolist(),
        },
        "stops": [
            {
                "views": list(views),
                "off_mm": 1e3 * float(np.linalg.norm(away[3:])),
                "off_deg": float(np.rad2deg(np.linalg.norm(away[:3]))),
                "left_mm": 1e3 * float(np.linalg.norm(left[3:])),
                "left_deg": float(np.rad2deg(np.linalg.norm(left[:3]))),
            }
            for views, away, left in zip(check.seen.views, check.away, check.left, strict=True)
        ],
        "not_used": [
            {"view": view, "reason": reason} for view, reason in sorted(known.reasons.items())
        ],
        "warnings": list(check.seen.warnings),
        "recalibrate": any(trigger.state == "fired" for trigger in triggers),
        "triggers": [_trigger(trigger) for trigger in triggers],
    }


def listed_suspects(check: Check) -> tuple[Suspect, ...]:
    """The changes that are listed: those that are named, and others that are not unlikely."""
    others = (suspect for suspect in check.suspects if suspect not in check.named)
    return (*check.named, *(other for other in others if other.probability > _LISTED_SHARE))


def _change(check: Check, suspect: Suspect) -> dict[str, Any]:
    return {
        "cause": suspect.name,
        "probability": suspect.probability,
        **described(check, suspect),
    }


def _trigger(outcome: Outcome) -> dict[str, Any]:
    trigger = outcome.trigger
    figures = {"limit": trigger.limit, "value": outcome.value}
    return {
        "quantity": trigger.quantity,
        "state": outcome.state,
        **{name: figure for name, figure in figures.items() if figure is not None},
        "words": outcome.words,
    }
