"""Frames that creep during the session: a base, and what a flange carries."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect

_UNITS: FloatArray = np.repeat([1.0 / LEVER_M, 1.0], 3)


@dataclass(frozen=True, eq=False)
class BaseCreeps(Effect):
    """Motion of a base, or of what stands in it, over the session [m, of turns at a lever].

    The picks come after the session: at its end it is zero.
    """

    kind, bounds, count = "base creeps", (1e-2, 1e-7, 0.1), 6

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        twists = adjoint(invert(moments.poses[self.frame])) * _UNITS
        return np.asarray(twists * moments.progress[:, None, None])


@dataclass(frozen=True, eq=False)
class MountCreeps(Effect):
    """The same of what the flange carries."""

    kind, bounds, count = "mount creeps", (1e-2, 1e-7, 0.1), 6

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.asarray(moments.progress[:, None, None] * np.diag(_UNITS))
