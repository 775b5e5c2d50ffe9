"""A lens that was zoomed, refocused, hit or exchanged, or whose pictures are bent otherwise."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import LensEffect, Size


@dataclass(frozen=True, eq=False)
class LensSteps(LensEffect):
    """Focal lengths and centre before a stop, less those from there on, in `LensGrows`' units.

    The picks come after the session: there it is zero, or else before.
    """

    kind, bounds, count = "lens steps", (1e-2, 1e-6, 0.3), 3
    clause = "the lens changed at once"
    wider = "lens changes"
    stop: int  # The first stop after it.
    is_first: bool = False  # Whether the lens is that of the views before, as a stated one may be.

    def shares(self, moments: Moments) -> FloatArray:
        """Shares (k,) of the values by which the lens is another one."""
        before = (moments.stops >= 0) & (moments.stops < self.stop)
        return before.astype(float) - self.is_first

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        found, focal = self.none(moments), self.lens.matrix[:2]
        shares = self.shares(moments)
        found[:, :2, 0] = shares[:, None] * focal
        found[:, 2, 1] = found[:, 3, 2] = shares * np.mean(focal)
        return found


@dataclass(frozen=True, eq=False)
class LensChanges(LensSteps):
    """Lens steps with the first two coefficients of distortion, as where pictures are rectified."""

    kind, count, wider = "lens changes", 5, ""
    clause = "the lens was exchanged, or its pictures rectified"

    @property
    def size(self) -> Size:
        """See `Effect`: each picture shows it by pixels, or a lens that gave way is likelier."""
        # Likelihood ratio of a change that moves corners by pixels: ten noises in each of some
        # views.
        return replace(super().size, limit=400.0)

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        found = super().columns(moments, distances)
        found[:, 4, 3] = found[:, 5, 4] = self.shares(moments)
        return found
