"""Clocks of a camera and a robot that differ by another time than was taken."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Size


@dataclass(frozen=True)
class Clock(Effect):
    """Lead of the camera's clock over the robot's beyond the assumed one [s]."""

    kind, count = "clock", 1
    clause = "the clocks of robot and camera are apart"
    camera: str
    sigma_s: float  # Its standard deviation, which is known [s].

    @property
    def name(self) -> str:
        """See `Effect`."""
        return f"{self.kind} {self.camera} {self.frame}"

    @property
    def size(self) -> Size:
        """See `Effect`."""
        return Size(self.name, self.sigma_s, self.sigma_s, self.sigma_s)

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`: the farther it is ahead, the earlier the robot's own time."""
        del distances
        rates = moments.rates.get((self.camera, self.frame))
        return np.zeros((len(moments), 6, 1)) if rates is None else -rates[:, :, None]
