"""The example of a medium arm that is loaded at its flange, read by a tracker."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.simulation import Payload, arm_named
from visioncal.simulation.instrument_session import random_postures

GRAVITY = 9.80665
LOADS_N = (0.0, 10.0, 20.0, 50.0)
HUNG = tuple(Payload(kg=load / GRAVITY) for load in LOADS_N)
NOMINAL = arm_named("generic-6r-1800")


def loaded_postures(count: int) -> FloatArray:
    """So many postures, each as often as there are loads: it is loaded where it stands."""
    drawn = random_postures(NOMINAL, count, np.random.default_rng(0))
    return np.repeat(drawn, len(LOADS_N), axis=0)
