"""A lens that changes while it warms up: its focal length and its centre."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Size

# Time constants of a camera's warming in one session.
_CONSTANTS = 3.0


@dataclass(frozen=True)
class LensGrows(Effect):
    """Growth of the focal lengths, and shifts of the centre by as many pixels, until the end.

    The picks come after the session: there it is zero.
    """

    place = "lens"
    focal: tuple[float, float]  # fx and fy [px].
    intrinsics: int  # The number q of the lens's intrinsics.

    @property
    def name(self) -> str:
        """See `Effect`."""
        return f"lens grows {self.frame}"

    @property
    def size(self) -> Size:
        """See `Effect`."""
        return Size(self.name, 1e-2, 1e-7, 0.1)

    @property
    def count(self) -> int:
        """See `Effect`."""
        return 3

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        left = np.exp(-_CONSTANTS * (moments.progress + 1.0)) - np.exp(-_CONSTANTS)
        found = np.zeros((len(moments), self.intrinsics, 3))
        found[:, :2, 0] = -np.outer(left, self.focal)
        found[:, 2, 1] = found[:, 3, 2] = -left * np.mean(self.focal)
        return found
