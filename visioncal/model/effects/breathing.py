"""A lens whose focal length follows the distance at which it is focused."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Size


@dataclass(frozen=True)
class Breathing(Effect):
    """Growth of the focal lengths as the distance doubles from `reference_m`."""

    place = "lens"
    focal: tuple[float, float]  # fx and fy [px].
    intrinsics: int  # The number q of the lens's intrinsics.
    reference_m: float

    @property
    def name(self) -> str:
        """See `Effect`."""
        return f"breathing {self.frame}"

    @property
    def size(self) -> Size:
        """See `Effect`."""
        return Size(self.name, 1e-2, 1e-6, 0.1)

    @property
    def count(self) -> int:
        """See `Effect`."""
        return 1

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        found = np.zeros((len(moments), self.intrinsics, 1))
        found[:, :2, 0] = np.outer(distances / self.reference_m - 1.0, self.focal)
        return found
