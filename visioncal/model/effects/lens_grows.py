"""A lens that changes while it warms up: its focal length and its centre."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.effects.lens_grows import TIME_CONSTANTS
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import LensEffect


@dataclass(frozen=True, eq=False)
class LensGrows(LensEffect):
    """Growth of the focal lengths, and shifts of the centre by as many pixels, until the end.

    The picks come after the session: there it is zero.
    """

    kind, bounds, count = "lens grows", (1e-2, 1e-7, 0.1), 3

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        left = np.exp(-TIME_CONSTANTS * (moments.progress + 1.0)) - np.exp(-TIME_CONSTANTS)
        found, focal = self.none(moments), self.lens.matrix[:2]
        found[:, :2, 0] = -np.outer(left, focal)
        found[:, 2, 1] = found[:, 3, 2] = -left * np.mean(focal)
        return found
