"""Effect of a clock offset between a camera and a robot."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import ROBOT, Effect


def clock_effect(
    speeds: FloatArray, sigma_s: float = np.inf, name: str = "clock", robot: str = ROBOT
) -> Effect:
    """The change of a clock offset [s] as an unknown.

    By (s, 6) twists per second of the robot's flange at each stop, in its own frame; zero where a
    pose does not depend on the clock.
    """
    prior = PriorInformation(np.array([[sigma_s**-2.0]]), np.zeros(1))
    # The farther the camera's clock is ahead, the earlier the robot's own time.
    return Effect.free(name, prior, flange_jacobian={robot: -speeds[:, :, None]})
