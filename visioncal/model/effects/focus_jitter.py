"""A lens that focuses anew for each image."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Size


@dataclass(frozen=True)
class FocusJitter(Effect):
    """Growth of the focal lengths at each stop, independent of the others."""

    place = "lens"
    focal: tuple[float, float]  # fx and fy [px].
    intrinsics: int  # The number q of the lens's intrinsics.
    stops: int

    @property
    def name(self) -> str:
        """See `Effect`."""
        return f"focus jitter {self.frame}"

    @property
    def size(self) -> Size:
        """See `Effect`."""
        return Size(self.name, 1e-2, 1e-6, 0.1)

    @property
    def count(self) -> int:
        """See `Effect`."""
        return self.stops

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        found = np.zeros((len(moments), self.intrinsics, self.stops))
        known = np.flatnonzero(moments.stops >= 0)
        found[known, 0, moments.stops[known]] = self.focal[0]
        found[known, 1, moments.stops[known]] = self.focal[1]
        return found
