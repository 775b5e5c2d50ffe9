"""Frames that creep or settle during the session: a base, and what a flange carries."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect


@dataclass(frozen=True, eq=False)
class Creep(Effect):
    """Motion of a frame over the session [m, of turns at a lever].

    The picks come after the session: at its end it is zero.
    """

    bounds, count = (1e-2, 1e-7, 0.1), 6
    rate: float = 0.0  # By which it fades, over the session; zero of an even one.

    def left(self, moments: Moments) -> FloatArray:
        """(k, 1, 1) share of the motion that is still to come."""
        over = moments.progress[:, None, None] + 1.0
        if self.rate == 0.0:
            return np.asarray(1.0 - over)
        end = np.exp(-self.rate)
        return np.asarray((np.exp(-self.rate * over) - end) / (1.0 - end))


@dataclass(frozen=True, eq=False)
class BaseCreeps(Creep):
    """Motion of a base, or of what stands in it."""

    kind = "base creeps"

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        twists = adjoint(invert(moments.poses[self.frame])) / np.repeat([LEVER_M, 1.0], 3)
        return np.asarray(twists * self.left(moments))


@dataclass(frozen=True, eq=False)
class MountCreeps(Creep):
    """Motion of what the flange carries."""

    kind = "mount creeps"

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.asarray(self.left(moments) * np.diag(np.repeat([1.0 / LEVER_M, 1.0], 3)))
