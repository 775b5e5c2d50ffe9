"""Sample of postures over the whole workspace of an arm."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Robot


def postures(robot: Robot, count: int = 400) -> FloatArray:
    """(k, n) random joint angles above the base's plane, at most half a turn either way [rad]."""
    limits = np.maximum(robot.lower_rad, -np.pi), np.minimum(robot.upper_rad, np.pi)
    q = np.random.default_rng(0).uniform(*limits, (count, robot.joint_count))
    above = robot.base_from_flange(q)[:, 2, 3] > 0.0
    # A positioner may hang below the plane altogether.
    return q[above] if above.any() else q
