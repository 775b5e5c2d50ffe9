"""Verification of a calibration with new stops: test, and cause of a change."""

from visioncal.calibration.verification.check import Check, Suspect, verify
from visioncal.calibration.verification.messages import to_document, verdict_of

__all__ = [
    "Check",
    "Suspect",
    "to_document",
    "verdict_of",
    "verify",
]
