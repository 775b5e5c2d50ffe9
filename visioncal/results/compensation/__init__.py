"""Compensation of arm errors: commands for a nominal controller that reach the real targets."""

from visioncal.results.compensation.correction import CalibratedArm, Corrected, correct
