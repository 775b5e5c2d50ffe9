"""Effects that turn joints: all else of an arm follows from where they really stand."""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import inverse_right_jacobian, invert, log
from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect
from visioncal.robot import Robot


@dataclass(frozen=True, eq=False)
class JointEffect(Effect):
    """An effect on the joints of an arm; its frame is the flange."""

    curvature = 1.0
    robot: Robot

    @property
    def count(self) -> int:
        """See `Effect`: one value a joint, if a kind has no other."""
        return self.robot.joint_count

    @abstractmethod
    def turns(self, q: FloatArray, moments: Moments) -> FloatArray:
        """Turns (k, n, c) of the joints by each value [rad], where they stand at (k, n) `q`."""

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return self.slopes(moments, np.zeros(self.count))

    def twists(self, moments: Moments, values: FloatArray) -> FloatArray:
        """See `Effect`."""
        before, after = map(self.robot.base_from_flange, self._stand(moments, values))
        return log(invert(before) @ after)

    def slopes(self, moments: Moments, values: FloatArray) -> FloatArray:
        """See `Effect`; turns change with the turns by a hundredth, which is left out."""
        _, q = self._stand(moments, values)
        moved = self.robot.axis_jacobian(q) @ self.turns(q, moments)
        return inverse_right_jacobian(self.twists(moments, values)) @ moved

    def _stand(self, moments: Moments, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(k, n) joint angles as reported, and as they are [rad]."""
        reported = moments.joints[self.frame]
        q = reported
        # Each round leaves a hundredth of what the one before does.
        for _ in range(3 if values.any() else 0):
            q = reported + self.turns(q, moments) @ values
        return reported, q
