"""A robot whose poses are read before it has arrived, or that are commanded and not reached."""

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.effects.random_effect import RandomEffect, Stops

# A motion of which both values are the share [m].
_TYPICAL_M = 0.3


class StopsShort(RandomEffect):
    """A robot whose poses are read before it has arrived, or that are commanded and not reached."""

    kind, typical, most = "stops_short", 1e-3, 5e-2
    do = (
        "Wait until the arm stands still before each image, and log the poses that the controller "
        "measures, not those that it was sent to."
    )

    def columns(self, stops: Stops) -> FloatArray:
        """The last motion, by a share of it and by as much of each, along the flange's axes."""
        poses = stops.base_from_flange
        motion = np.zeros((len(poses), 6))
        motion[1:] = log(invert(poses[:-1]) @ poses[1:])
        length = np.linalg.norm(motion * np.repeat([LEVER_M, 1.0], 3), axis=1)
        even = motion * (_TYPICAL_M / np.maximum(length, 1e-6))[:, None]
        return np.stack([motion, even], axis=2)

    def says(self, values: FloatArray) -> str:
        """What they mean."""
        off = _TYPICAL_M * float(values.sum())
        way = "short of" if off < 0.0 else "beyond"
        return (
            f"At each stop the arm stood {way} the pose that was logged, along its last motion: by "
            f"{figure(1e3 * abs(off))} mm after one of {_TYPICAL_M:g} m. The result counts it."
        )
