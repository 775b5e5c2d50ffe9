"""What files of links alone can hold of an arm whose joints err by their angles and their loads."""

import numpy as np

from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.robot.chain import IDENTITY_FUNCTION
from visioncal.robot.model import Robot

# A radian counts as what carries its tip so far away [m].
_LEVER_M = 0.3
# Links move with the square of a thousandth; the second step is off by less than a micrometre.
_STEPS = 4
# Twists of links that no joint tells from offsets, or hardly moves the tip by, stay.
_DETERMINED = 1e-6


def without_functions(robot: Robot) -> Robot:
    """The arm without gear ratios, eccentricity and harmonics; the offsets stay."""
    functions = np.array(IDENTITY_FUNCTION) - robot.chain.functions
    functions[:, 0] = 0.0
    harmonics = robot.chain.harmonics
    return robot.corrected(functions=functions, harmonics=None if harmonics is None else -harmonics)


def fit_links(
    robot: Robot, q: FloatArray, base_from_flange: FloatArray, weights: FloatArray
) -> Robot:
    """Fits links and offsets of an arm to where a real one stands; its functions stay.

    Links are moved behind their joints, so that the base stays; see `Robot.placement_jacobian`.

    Args:
        robot: The arm, with the functions that a reader is to know.
        q: (m, n) postures [rad].
        base_from_flange: (m, 4, 4) where the real one stands there.
        weights: (m,) how much each counts.

    Returns:
        The arm that is off the least, in the mean of squares.
    """
    count, units = robot.joint_count, np.repeat([1.0, _LEVER_M], 3)
    row_weights = np.sqrt(weights)[:, None] * np.repeat([_LEVER_M, 1.0], 3)
    for _ in range(_STEPS):
        away = log(invert(robot.base_from_flange(q)) @ base_from_flange)
        links = robot.placement_jacobian(q)[:, :, 6:] * np.tile(units, count)
        offsets = robot.function_jacobian(q).reshape(len(q), 6, count, -1)[..., 0]
        columns = row_weights[:, :, None] * np.concatenate([offsets, links], axis=2)
        step = np.linalg.lstsq(
            columns.reshape(-1, 7 * count), (row_weights * away).ravel(), rcond=_DETERMINED
        )[0]
        functions, placements = np.zeros((count, 4)), np.zeros((count + 1, 6))
        functions[:, 0] = step[:count]
        placements[1:] = step[count:].reshape(count, 6) * units
        robot = robot.corrected(placements, functions)
    return robot
