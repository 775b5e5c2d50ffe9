"""A base that tilts with the arm's reach: its stand, or the floor, gives way."""

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.effects.random_effect import RandomEffect, Stops


class BaseTilts(RandomEffect):
    """A base that tilts with the arm's reach: its stand, or the floor, gives way."""

    kind, typical, most = "base_tilts", 1e-3, 5e-3
    do = "Tighten the base's screws, and stiffen what it stands on, or keep to one reach."

    def columns(self, stops: Stops) -> FloatArray:
        """Tilts of the base about its x and y [rad/m], in proportion to the horizontal reach."""
        poses = stops.base_from_flange
        reach = np.hypot(poses[:, 0, 3], poses[:, 1, 3])
        return np.asarray(adjoint(invert(poses))[:, :, :2] * reach[:, None, None])

    def says(self, values: FloatArray) -> str:
        """What they mean."""
        size = figure(1e3 * float(np.linalg.norm(values)))
        return (
            f"The base tilts as the arm reaches out, by {size} mrad for each metre. The result "
            "counts it; the robot's own poses do not."
        )
