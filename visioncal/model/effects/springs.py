"""Joints that bend: under their links' weight, and under what the flange carries."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.joints import JointEffect
from visioncal.robot.elasticity import WeightFunctions


@dataclass(frozen=True, eq=False)
class Springs(JointEffect):
    """Compliance of each joint [rad/(N m)], under torques that are known."""

    kind, bounds = "springs", (1e-3, 1e-9, 0.1)
    clause = "the arm's joints give way under loads"
    curvature = 200.0  # Under so many newton metres.

    def turns(self, q: FloatArray, moments: Moments) -> FloatArray:
        """See `JointEffect`."""
        torques = self.robot.load_torques(q, moments.loads.get(self.frame))
        return torques[:, :, None] * np.eye(self.count)


@dataclass(frozen=True, eq=False)
class Weight(JointEffect):
    """Turns of joints by links whose masses are not known, as functions of the posture [rad].

    See `WeightFunctions`: each is of one joint, with a root mean square of 1 over postures.
    """

    kind, bounds = "weight", (1e-2, 1e-7, 0.1)
    clause = "the arm's joints give way under its own weight"

    @cached_property
    def functions(self) -> WeightFunctions:
        """The functions of all joints."""
        return WeightFunctions.of(self.robot)

    @property
    def count(self) -> int:
        """See `Effect`."""
        return self.functions.size

    def turns(self, q: FloatArray, moments: Moments) -> FloatArray:
        """See `JointEffect`."""
        del moments
        return self.functions.values(self.robot, q)
