"""A base, or a fixed target, that creeps during the session."""

import numpy as np

from visioncal.core.number_format import mm_and_deg
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.effects.random_effect import RandomEffect, Stops


class BaseCreeps(RandomEffect):
    """A base, or a fixed target, that creeps during the session."""

    kind, typical, most = "base_creeps", 2e-4, 3e-3
    do = (
        "Fasten the base, the fixed camera and the fixed target, let the cell warm up, and record "
        "again."
    )

    def columns(self, stops: Stops) -> FloatArray:
        """Motion of the base over the session: turns about each axis times a lever, shifts [m]."""
        twists = adjoint(invert(stops.base_from_flange)) / np.repeat([LEVER_M, 1.0], 3)
        return np.asarray(twists * (stops.time - 0.5)[:, None, None])

    def says(self, values: FloatArray) -> str:
        """What they mean."""
        turn_rad, shift_m = np.linalg.norm(values.reshape(2, 3), axis=1) / (LEVER_M, 1.0)
        crept = mm_and_deg(1e3 * float(shift_m), float(np.rad2deg(turn_rad)))
        return (
            f"The base, or what stands in it, crept by {crept} during the session. The result is "
            "that of its middle."
        )
