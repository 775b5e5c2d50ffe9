"""A board that grows in the damp, or shrinks as it dries, during the session."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.moves import still_to_come
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Displacement


@dataclass(frozen=True, eq=False)
class BoardSwells(Displacement):
    """Share by which the board that a camera sees grows until the session's end, evenly.

    The size is that of the end: before it, corners are nearer to the board's origin.
    """

    kind, bounds, count = "board swells", (1e-2, 1e-6, 0.1), 1
    clause = "the board grew or shrank"

    def moved(self, points: FloatArray, poses: FloatArray) -> FloatArray:
        """See `Displacement`."""
        return np.asarray((poses[..., :3, 3] - points)[:, :, None])

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`: (k, 1, 1) shares of the growth that are still to come."""
        del distances
        return np.asarray(still_to_come(moments.progress, 0.0)[:, None, None])
