"""Errors of an arm's links: each joint's frame is placed elsewhere than its model says."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect
from visioncal.robot import Robot
from visioncal.robot.errors import TWIST_UNITS


@dataclass(frozen=True)
class Links(Effect):
    """Six errors a joint, of one size [rad], [m / 0.5].

    They are the placements of everything behind each joint, so that those of the base and the
    flange, which edges have already, are not among them but for one joint's.
    """

    kind, bounds = "links", (1e-3, 1e-7, 0.1)
    clause = "the arm's links are not as stated"
    robot: Robot

    @property
    def count(self) -> int:
        """See `Effect`."""
        return 6 * self.robot.joint_count

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        frames = self.robot.link_frames(moments.joints[self.frame])
        twists = adjoint(invert(frames[:, -1:]) @ frames[:, :-1]) * TWIST_UNITS
        return np.asarray(np.moveaxis(twists, 1, 2).reshape(len(frames), 6, self.count))
