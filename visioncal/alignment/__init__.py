"""Whole cells: several robots, cameras and boards in one frame."""

from visioncal.alignment.arms import ArmsAsked
from visioncal.alignment.run import align

__all__ = ["ArmsAsked", "align"]
