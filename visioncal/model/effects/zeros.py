"""Joints whose zeros are elsewhere than the controller has them."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.joints import JointEffect


@dataclass(frozen=True, eq=False)
class Zeros(JointEffect):
    """Offset of each joint's zero [rad]."""

    kind, bounds = "zeros", (1e-2, 1e-7, 0.1)
    clause = "the arm's joints have other zeros"

    def turns(self, q: FloatArray, moments: Moments) -> FloatArray:
        """See `JointEffect`."""
        del moments
        return np.tile(np.eye(self.count), (len(q), 1, 1))
