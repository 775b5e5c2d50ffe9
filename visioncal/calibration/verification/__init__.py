"""Verification of a calibration with new stops: test, cause of a change, recalibration triggers."""

from visioncal.calibration.verification.check import Check, Suspect, verify
from visioncal.calibration.verification.messages import to_document, verdict_of
from visioncal.calibration.verification.policy import Outcome, Trigger, load_policy, outcomes

__all__ = [
    "Check",
    "Outcome",
    "Suspect",
    "Trigger",
    "load_policy",
    "outcomes",
    "to_document",
    "verdict_of",
    "verify",
]
