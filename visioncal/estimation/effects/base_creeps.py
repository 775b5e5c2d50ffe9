"""A base, or a fixed target, that creeps during the session."""

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.effects.random_effect import RandomEffect, Stops


def _columns(stops: Stops) -> FloatArray:
    """Motion of the base from begin to end: a turn about each axis times a lever, a shift [m]."""
    twists = adjoint(invert(stops.base_from_flange)) / np.repeat([LEVER_M, 1.0], 3)
    return np.asarray(twists * (stops.time - 0.5)[:, None, None])


def _says(values: FloatArray) -> str:
    shift = figure(1e3 * float(np.linalg.norm(values[3:])))
    turn = figure(float(np.rad2deg(np.linalg.norm(values[:3]) / LEVER_M)))
    return (
        f"The base, or what stands in it, crept by {shift} mm and {turn} deg during the session. "
        "The result is that of its middle."
    )


BASE_CREEPS = RandomEffect(
    "base_creeps",
    2e-4,
    _columns,
    _says,
    "Fasten the base, the fixed camera and the fixed target, let the cell warm up, and record "
    "again.",
)
