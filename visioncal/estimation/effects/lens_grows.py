"""A lens whose focal length grows with time: a camera that warms up."""

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.effects.random_effect import RandomEffect, Stops

# Time constants of a camera's warming in one session.
TIME_CONSTANTS = 3.0


class LensGrows(RandomEffect):
    """A lens whose focal length grows with time: a camera that warms up."""

    kind, typical, most = "lens_grows", 1e-3, 1e-2
    do = "Let the camera run for half an hour before it is calibrated and used."
    is_of_sensor = True

    def columns(self, stops: Stops) -> FloatArray:
        """Relative growth of the focal length, towards that at the session's end."""
        grown = np.exp(-TIME_CONSTANTS) - np.exp(-TIME_CONSTANTS * stops.time)
        return np.asarray((grown[:, None] * stops.by_focal)[:, :, None])

    def says(self, values: FloatArray) -> str:
        """What they mean."""
        way = "grew" if values[0] > 0.0 else "shrank"
        share = figure(100.0 * abs(float(values[0])) * (1.0 - np.exp(-TIME_CONSTANTS)))
        return (
            f"The lens's focal length {way} by {share} % during the session, as of a camera that "
            "warms up. The result is that of its end."
        )
