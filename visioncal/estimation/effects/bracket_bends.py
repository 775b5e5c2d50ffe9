"""A bracket at the flange that bends with gravity."""

import numpy as np

from visioncal.core.number_format import mm_and_deg
from visioncal.core.types import FloatArray
from visioncal.estimation.effects.random_effect import RandomEffect, Stops

# A bracket turns by a radian where its end shifts by so much [m].
_LENGTH_M = 0.1


class BracketBends(RandomEffect):
    """A bracket at the flange that bends with gravity."""

    kind, typical, most = "bracket_bends", 1e-4, 3e-3
    do = "Stiffen the bracket, or record and work in the same attitudes."

    def columns(self, stops: Stops) -> FloatArray:
        """Turns times a length, and shifts, of what the flange carries by the direction of gravity.

        Each is linear in the components of the downward direction along the flange's axes [m].
        """
        down = -stops.base_from_flange[:, 2, :3]
        columns = np.zeros((len(down), 6, 18))
        for axis in range(6):
            scale = 1.0 / _LENGTH_M if axis < 3 else 1.0
            columns[:, axis, 3 * axis : 3 * axis + 3] = scale * down
        return columns

    def says(self, values: FloatArray) -> str:
        """What they mean."""
        shift = np.linalg.norm(values.reshape(6, 3)[3:], ord=2)
        turn = np.linalg.norm(values.reshape(6, 3)[:3], ord=2) / _LENGTH_M
        return (
            "What the flange carries bends with its weight, by up to "
            f"{mm_and_deg(1e3 * float(shift), float(np.rad2deg(turn)))}. The result is that of the "
            "views' mean attitude."
        )
