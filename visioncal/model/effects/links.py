"""Errors of an arm's links: each joint's frame is placed elsewhere than its model says."""

from dataclasses import dataclass

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect
from visioncal.robot import Robot
from visioncal.robot.errors import link_basis


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
        return link_basis(self.robot, moments.joints[self.frame])
