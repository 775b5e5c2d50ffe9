"""A robot whose poses are read before it has arrived, or that are commanded and not reached."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Named, Stood


@dataclass(frozen=True, eq=False)
class StopsShort(Effect, Named):
    """Where the arm stands along its last motion: by a share of it, and by as much of each.

    The latter as a share of a motion of 0.3 m, with turns at a lever. At other moments than the
    cell's stops it has arrived.
    """

    kind, count, bounds, most = "stops short", 2, (1e-2, 1e-6, 0.1), 5e-2
    do = (
        "Wait until the arm stands still before each image, and log the poses that the controller "
        "measures, not those that it was sent to."
    )
    poses: FloatArray  # (s, 4, 4) `base_from_flange` at the cell's stops; NaN where unknown.

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """See `Named`."""
        if not stood.is_swept:
            yield cls(flange, stood.poses)

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        off = 0.3 * float(values.sum())
        way = "short of" if off < 0.0 else "beyond"
        return (
            f"At each stop the arm stood {way} the pose that was logged, along its last motion: by "
            f"{figure(1e3 * abs(off))} mm after one of 0.3 m. The result counts it."
        )

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.where(moments.stops[:, None, None] >= 0, self._of_stops[moments.stops], 0.0)

    @cached_property
    def _of_stops(self) -> FloatArray:
        stood = np.flatnonzero(np.isfinite(self.poses[:, 0, 0]))
        motion, found = np.zeros((len(stood), 6)), np.zeros((len(self.poses), 6, 2))
        motion[1:] = log(invert(self.poses[stood[:-1]]) @ self.poses[stood[1:]])
        length = np.linalg.norm(motion * np.repeat([LEVER_M, 1.0], 3), axis=1)
        even = motion * (0.3 / np.maximum(length, 1e-6))[:, None]
        found[stood] = np.stack([motion, even], axis=2)
        return found
