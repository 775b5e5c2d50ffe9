"""Whether a calibration still holds, what has changed if not, and when to calibrate again."""

from visioncal.verification.check import Check, Suspect, verify
from visioncal.verification.document import to_document
from visioncal.verification.policy import Outcome, Trigger, facts_of, load_policy, outcomes
from visioncal.verification.words import sentences

__all__ = [
    "Check",
    "Outcome",
    "Suspect",
    "Trigger",
    "facts_of",
    "load_policy",
    "outcomes",
    "sentences",
    "to_document",
    "verify",
]
