"""A lens on a flange that gives way in its thread, or whose focus slips, with gravity."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import Camera, FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, LensEffect, Named


@dataclass(frozen=True, eq=False)
class LensSags(LensEffect, Named):
    """Shifts of the centre, over the focal length, and growth of it, linear in gravity's direction.

    The direction is along the flange's axes. A turn of the whole camera shifts the centre by nearly
    as much, and stretches the image's far side, too, as no lens does.
    """

    kind, bounds, count, most = "lens sags", (1e-2, 1e-7, 0.1), 9, 1e-2
    clause = "the lens gives way with its weight"
    do = "Lock the lens in its mount, and its focus ring, or record and work in the same attitudes."
    flange: str

    @classmethod
    def of_lens(cls, camera: str, lens: Camera, flange: str) -> Iterator[Effect]:
        """See `Named`."""
        if flange:
            yield cls(camera, lens, flange)

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        focus, centre = np.linalg.norm(values[:3]), np.linalg.norm(values[3:].reshape(2, 3), ord=2)
        return (
            f"The lens gives way with its weight as the camera turns: its centre by up to "
            f"{figure(float(np.rad2deg(centre)))} deg, its focal length by "
            f"{figure(100.0 * float(focus))} %. The result is that of the views' mean attitude."
        )

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        found, focal, down = self.none(moments), self.lens.matrix[:2], -moments.poses[self.flange]
        found[:, :2, :3] = focal[:, None] * down[:, None, 2, :3]
        for axis in (0, 1):
            found[:, 2 + axis, 3 + 3 * axis : 6 + 3 * axis] = np.mean(focal) * down[:, 2, :3]
        return found
