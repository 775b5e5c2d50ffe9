"""Joints that have play: each stands on the side from which it came."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.joints import JointEffect


@dataclass(frozen=True, eq=False)
class Play(JointEffect):
    """Difference of each joint's angle between both sides of approach [rad].

    Where sides are not known, as of picks, joints are in the middle.
    """

    kind, bounds = "play", (1e-2, 1e-7, 0.1)
    clause = "the arm's joints have play"

    def turns(self, q: FloatArray, moments: Moments) -> FloatArray:
        """See `JointEffect`."""
        sides = moments.sides.get(self.frame, np.zeros_like(q))
        return 0.5 * sides[:, :, None] * np.eye(self.count)
