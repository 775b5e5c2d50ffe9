"""An arm whose links grow, and whose joints' zeros drift, with what heats them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Size
from visioncal.model.heating import LEAST_RISE_K, is_recorded, sigmas_of, usual_arm
from visioncal.robot import Robot
from visioncal.robot.thermal import Inputs, ThermalModel


@dataclass(frozen=True, eq=False)
class Heat(Effect):
    """Departures of growth, drift, time constants and gains from the usual ones [their sigmas].

    See `ThermalModel`. The arm is as stated at the first sample, and at moments without a time as
    warm as at the last one.
    """

    kind, curvature = "heat", 1.0
    clause = "the arm is warmer at some stops than at others"
    robot: Robot
    inputs: Inputs  # Its heat sources.
    grown: Robot | None = None  # The arm whose lengths grow; None for the same one.

    @property
    def size(self) -> Size:
        """See `Effect`: it is known how arms differ."""
        return Size(self.name, 1.0, 1.0, 1.0)

    @property
    def count(self) -> int:
        """See `Effect`."""
        return len(self.sigmas)

    def is_shown(self, moments: Moments) -> bool:
        """Whether the links' temperatures are known at some moments, and differ."""
        stood = np.isfinite(moments.poses[self.frame][:, 0, 0])
        if moments.stamps_s is None or not is_recorded(self.inputs, moments.stamps_s[stood]):
            return False
        links_c = self._usual.heating.links_c(self.inputs, moments.stamps_s[stood])
        return bool(np.ptp(links_c, axis=0).max() >= LEAST_RISE_K)

    def arm(self, values: FloatArray) -> ThermalModel:
        """The arm with some values."""
        return self._usual.changed(self.sigmas * values)

    def twists(self, moments: Moments, values: FloatArray) -> FloatArray:
        """See `Effect`."""
        arm = self.arm(values)
        rises = arm.rises(arm.heating.links_c(self.inputs, self.times_s(moments)))
        moved = arm.jacobian(moments.joints[self.frame]) @ rises[:, :, None]
        return np.asarray(moved[:, :, 0])

    def slopes(self, moments: Moments, values: FloatArray) -> FloatArray:
        """See `Effect`."""
        arm, at_s = self.arm(values), self.times_s(moments)
        links_c = arm.heating.links_c(self.inputs, at_s)
        heated = arm.heating.jacobian(self.inputs, at_s)
        return arm.basis(moments.joints[self.frame], links_c, heated) * self.sigmas

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return self.slopes(moments, np.zeros(self.count))

    def times_s(self, moments: Moments) -> FloatArray:
        """(k,) times of moments [s]."""
        last_s = float(self.inputs.stamps_s[-1])
        stamps_s = moments.stamps_s
        return (
            np.full(len(moments), last_s)
            if stamps_s is None
            else np.nan_to_num(stamps_s, nan=last_s)
        )

    @cached_property
    def _usual(self) -> ThermalModel:
        return usual_arm(self.robot, self.grown or self.robot, self.inputs)

    @cached_property
    def sigmas(self) -> FloatArray:
        """(c,) units of the values."""
        return sigmas_of(self.inputs)
