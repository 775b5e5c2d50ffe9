"""Verification of a calibration with new stops: test, cause of a change, recalibration triggers."""

from visioncal.calibration.verification.change_hypotheses import NOISE
from visioncal.calibration.verification.check import Check, PossibleChange, verify
from visioncal.calibration.verification.guard import Guard, Guarded, Look, PossibleCause
from visioncal.calibration.verification.messages import (
    change_words,
    listed_changes,
    to_document,
    verdict_of,
)
from visioncal.calibration.verification.triggers import Trigger, triggers_of
