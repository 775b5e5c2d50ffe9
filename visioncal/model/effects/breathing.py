"""A lens whose focal length follows the distance at which it is focused."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import LensEffect


@dataclass(frozen=True, eq=False)
class Breathing(LensEffect):
    """Growth of the focal lengths as the distance doubles from `reference_m`.

    Nobody says at which distance a stated lens was focused: half of that growth is as likely there.
    """

    kind, bounds = "breathing", (1e-2, 1e-6, 0.1)
    clause = "the lens focuses on what it sees"
    reference_m: float
    is_stated: bool = False

    @property
    def count(self) -> int:
        """See `Effect`."""
        return 2 if self.is_stated else 1

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        found = self.none(moments)
        found[:, :2, 0] = np.outer(distances / self.reference_m - 1.0, self.lens.matrix[:2])
        found[:, :2, 1:] = 0.5 * self.lens.matrix[:2, None]
        return found
