"""Compensation: what to command a nominal controller so that the real arm goes where wanted."""

from visioncal.results.compensation.correction import CalibratedArm, Corrected, correct

__all__ = ["CalibratedArm", "Corrected", "correct"]
