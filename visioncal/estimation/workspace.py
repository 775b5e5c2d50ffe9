"""Sample of postures over the whole workspace of an arm."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Robot

# Number of postures, and range of joints without limits, either way.
_POSTURES, _TURN_RAD = 400, np.pi


def turning_range(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """(n,) lower and upper joint limits, at most half a turn either way."""
    return np.maximum(robot.lower_rad, -_TURN_RAD), np.minimum(robot.upper_rad, _TURN_RAD)


def postures(robot: Robot, count: int = _POSTURES) -> FloatArray:
    """(k, n) random joint angles over the workspace, above the base's plane [rad]."""
    rng = np.random.default_rng(0)
    q = rng.uniform(*turning_range(robot), (count, robot.joint_count))
    above = robot.base_from_flange(q)[:, 2, 3] > 0.0
    # A positioner may hang below the plane altogether.
    return q[above] if above.any() else q
