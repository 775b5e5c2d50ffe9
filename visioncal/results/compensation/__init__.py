"""Compensation: what to command a nominal controller so that the real arm goes where wanted."""

from visioncal.results.compensation.correction import WIDEST_RAD, CalibratedArm, Corrected, correct

__all__ = ["WIDEST_RAD", "CalibratedArm", "Corrected", "correct"]
