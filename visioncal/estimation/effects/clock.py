"""Effect of clocks: a camera's is ahead of a robot's, and the robot was elsewhere in between."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.parts import ROBOT, Effect
from visioncal.estimation.variance import Knowledge


def clock_effect(
    speeds: FloatArray, sigma_s: float = np.inf, name: str = "clock", robot: str = ROBOT
) -> Effect:
    """The change of an offset [s] as an unknown.

    Args:
        speeds: (s, 6) twists a second of the robot's flange at each stop, in its own frame; zero
            where a pose does not depend on the clock.
        sigma_s: How well the offset is known beforehand [s].
        name: What it is of.
        robot: The robot whose flange moves.
    """
    known = Knowledge(np.array([[sigma_s**-2.0]]), np.zeros(1))
    # The farther the camera's clock is ahead, the earlier the robot's own time.
    return Effect.free(name, known, flange_jacobian={robot: -speeds[:, :, None]})
