"""A robot whose poses are read before it has arrived, or that are commanded and not reached."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect


@dataclass(frozen=True, eq=False)
class StopsShort(Effect):
    """Where the arm stands along its last motion: by a share of it, and by as much of each.

    The latter as a share of a motion of 0.3 m, with turns at a lever. At other moments than the
    cell's stops it has arrived.
    """

    kind, count, bounds = "stops short", 2, (1e-2, 1e-6, 0.1)
    poses: FloatArray  # (s, 4, 4) `base_from_flange` at the cell's stops; NaN where unknown.

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.where(moments.stops[:, None, None] >= 0, self._of_stops[moments.stops], 0.0)

    @cached_property
    def _of_stops(self) -> FloatArray:
        stood = np.flatnonzero(np.isfinite(self.poses[:, 0, 0]))
        motion, found = np.zeros((len(stood), 6)), np.zeros((len(self.poses), 6, 2))
        motion[1:] = log(invert(self.poses[stood[:-1]]) @ self.poses[stood[1:]])
        length = np.linalg.norm(motion * np.repeat([LEVER_M, 1.0], 3), axis=1)
        even = motion * (0.3 / np.maximum(length, 1e-6))[:, None]
        found[stood] = np.stack([motion, even], axis=2)
        return found
