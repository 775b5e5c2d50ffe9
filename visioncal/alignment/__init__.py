"""Whole cells: several robots, cameras and boards in one frame."""

from visioncal.alignment.anycell import arms_asked, calibrate
from visioncal.alignment.arms import ArmsAsked
from visioncal.alignment.run import align

__all__ = ["ArmsAsked", "align", "arms_asked", "calibrate"]
