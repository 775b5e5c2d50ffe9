"""A rolling shutter: the rows of an image are exposed one after the other."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect


@dataclass(frozen=True)
class Rolling(Effect):
    """Time from an image's first row to its last, whose middle row has the stamp [s]."""

    place, kind, count, bounds = "corners", "rolling", 1, (1e-2, 1e-6, 0.1)
    curvature = 1.0  # At a radian per second.
    height: int  # Of the images [px].

    def shares(self, px: FloatArray) -> FloatArray:
        """(n,) delays of (n, 2) corners from the stamp, as shares of the readout time."""
        return np.asarray(px[:, 1] / (self.height - 1) - 0.5)

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`: it moves no pose, since the middle row has the stamp."""
        del distances
        return np.zeros((len(moments), 6, 1))
