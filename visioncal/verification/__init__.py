"""Verification of a calibration with new stops: test, cause of a change, recalibration triggers."""

from visioncal.verification.change_hypotheses import NOISE
from visioncal.verification.check import Check, PossibleChange, verify
from visioncal.verification.guard import Guard, Guarded, Look, PossibleCause
from visioncal.verification.messages import change_words, listed_changes, to_document, verdict_of
from visioncal.verification.triggers import Trigger, triggers_of
