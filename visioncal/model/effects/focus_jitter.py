"""A lens that focuses anew for each image."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray, IntArray, evenly
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import LensEffect, Size


@dataclass(frozen=True, eq=False)
class FocusJitter(LensEffect):
    """Growth of the focal lengths at each of some stops, independent of the others."""

    kind, bounds = "focus jitter", (1e-2, 1e-6, 0.1)
    clause = "the lens focuses anew at each stop"
    stops: IntArray  # (c,) in order.
    is_breathing: bool = False  # Whether the lens is known to focus: then this is likely.

    @property
    def size(self) -> Size:
        """See `Effect`: chance exceeds the limit of an expected one in one of twenty sessions."""
        size = Size(self.name, *self.bounds)
        return replace(size, limit=3.84) if self.is_breathing else size

    @property
    def count(self) -> int:
        """See `Effect`."""
        return len(self.stops)

    @property
    def typical(self) -> "FocusJitter":
        """See `Effect`."""
        return replace(self, stops=self.stops[evenly(self.count, 150)])

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        found = self.none(moments)
        known = np.flatnonzero(np.isin(moments.stops, self.stops))
        stop_columns = np.searchsorted(self.stops, moments.stops[known])
        found[known, :2, stop_columns] = self.lens.matrix[:2]
        return found
