"""A rolling shutter: the rows of an image are exposed one after the other."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import Camera, FloatArray, IntArray, evenly
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect
from visioncal.vision.lens_field import row_motions


@dataclass(frozen=True)
class Rolling(Effect):
    """Time from an image's first row to its last, whose middle row has the stamp [s]."""

    place, kind, count, bounds = "corners", "rolling", 1, (1e-2, 1e-6, 0.1)
    clause = "rows of an image were read one after the other"
    curvature = 1.0  # At a radian per second.
    height: int  # Of the images [px].

    def shares(self, px: FloatArray) -> FloatArray:
        """(n,) delays of (n, 2) corners from the stamp, as shares of the readout time."""
        return np.asarray(px[:, 1] / (self.height - 1) - 0.5)

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`: it moves no pose, since the middle row has the stamp."""
        del distances
        return np.zeros((len(moments), 6, 1))


@dataclass(frozen=True, eq=False)
class RowMotion(Effect):
    """Motion of the image while its rows are read, another one at each of some stops [rad].

    Four values each: see `row_motions`. An arm that creeps meanwhile, at a speed that no stamp
    shows, moves the image so; its pose is that of the middle row, or off by noise.
    """

    # Half a metre away, at 0.2 m/s, rows of 25 ms move by a hundredth.
    place, kind, bounds = "corners", "row motion", (3e-3, 1e-7, 0.01)
    clause = "the camera moved while rows of its images were read"
    lens: Camera
    stops: IntArray  # (s,) in order.

    @property
    def count(self) -> int:
        """See `Effect`."""
        return 4 * len(self.stops)

    @property
    def typical(self) -> "RowMotion":
        """See `Effect`."""
        return replace(self, stops=self.stops[evenly(len(self.stops), 40)])

    def shifts(self, px: FloatArray) -> FloatArray:
        """(n, 2, 4) displacements of (n, 2) corners by a stop's own values."""
        return row_motions(px, self.lens)

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """(k, 4, c) of the values at the moments' stops."""
        del distances
        is_at_stop = moments.stops[:, None] == self.stops
        return np.asarray(np.kron(is_at_stop, np.eye(4)).reshape(len(is_at_stop), 4, -1))
