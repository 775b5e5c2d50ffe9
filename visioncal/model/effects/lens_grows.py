"""A lens that changes while it warms up: its focal length and its centre."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.moves import still_to_come
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, LensEffect, Named

# Time constants of a camera's warming in one session.
TIME_CONSTANTS = 3.0


@dataclass(frozen=True, eq=False)
class LensGrows(LensEffect, Named):
    """Growth of the focal lengths, and shifts of the centre by as many pixels, until the end.

    The picks come after the session: there it is zero.
    """

    kind, bounds, count, most = "lens grows", (1e-2, 1e-7, 0.1), 3, 3e-3
    clause = "the lens crept"
    do = "Let the camera run for half an hour before it is calibrated and used."
    rate: float = TIME_CONSTANTS  # By which it fades, over the session; zero of an even one.

    @classmethod
    def of_lens(cls, camera: str, lens: Camera, flange: str) -> Iterator[Effect]:
        """Growth as of a camera that warms up, and even growth."""
        del flange
        for rate in (TIME_CONSTANTS, 0.0):
            yield cls(camera, lens, rate)

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        way = "grew" if values[0] > 0.0 else "shrank"
        changed = f"{way} by {figure(100.0 * abs(float(values[0])))} %"
        if (shift := float(np.linalg.norm(values[1:]))) > abs(float(values[0])):
            changed += f", and its centre moved by {figure(np.rad2deg(shift))} deg,"
        return (
            f"The lens's focal length {changed} during the session, as of a camera that warms up. "
            "The result is that of its end."
        )

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        left = still_to_come(moments.progress, self.rate)
        found, focal = self.none(moments), self.lens.matrix[:2]
        found[:, :2, 0] = -np.outer(left, focal)
        found[:, 2, 1] = found[:, 3, 2] = -left * np.mean(focal)
        return found
