"""Whole cells: several robots, cameras and boards in one frame."""

from visioncal.alignment.anycell import calibrate, check_whole
from visioncal.alignment.run import align

__all__ = ["align", "calibrate", "check_whole"]
