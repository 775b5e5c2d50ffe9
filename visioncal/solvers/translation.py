"""The step that most solvers share: both translations and Z, once X's rotation is known.

The equation is (A_R - I) t_X = R_X t_B - t_A of Tsai and Lenz (1989), eq. 15, which later authors
share, over all pairs of views. Where rotations agree, a pair's residual is the difference between
what both views say about the place of one point of the target, so the sum over all pairs is m
times the scatter of m places about their mean: linear in the number of views.

Noise makes the choice of that point matter. At the target's origin the robot's rotation noise has
the lever from target to flange; at the camera's centre, to which t_B amounts, the camera's has
the same lever. Half-way, neither has more than half.
"""

import numpy as np

from visioncal.solvers.handeye import HandEye
from visioncal.solvers.leastsquares import smallest_solution
from visioncal.transforms import compose, nearest_rotation
from visioncal.types import FloatArray

# A direction that the views turn by less than this (root mean square) shows the robot's noise,
# which would move X by metres; noise is up to 0.5 mrad, useful motion begins at 10 mrad.
_SMALLEST_TURN_RAD = 2e-3


def halfway_point(camera: FloatArray) -> FloatArray:
    """The (3,) point half-way from the target's origin to the mean camera, target frame [m]."""
    m = len(camera)
    rotation, translation = camera[:, :3, :3], camera[:, :3, 3]
    return np.asarray(translation.reshape(3 * m) @ rotation.reshape(3 * m, 3) / (-2.0 * m))


def complete(
    robot: FloatArray,
    camera: FloatArray,
    rotation_x: FloatArray,
    rotation_z: FloatArray | None = None,
) -> HandEye:
    """Finds what X's rotation leaves open, by least squares over all pairs of views.

    Args:
        robot: (m, 4, 4) robot poses `R_i` [m].
        camera: (m, 4, 4) `cam_from_target` [m].
        rotation_x: (3, 3) rotation of X.
        rotation_z: (3, 3) rotation of Z; absent, it is the chordal mean of `R_i X C_i`.

    Returns:
        X and Z. Components of X's translation that the motion does not show are zero.
    """
    m = len(robot)
    turns, stations = robot[:, :3, :3], robot[:, :3, 3]
    point = halfway_point(camera)
    seen = (camera[:, :3, :3] @ point + camera[:, :3, 3]) @ rotation_x.T
    reached = (turns @ seen[..., None])[..., 0] + stations

    mean_turn, mean_reached = turns.sum(axis=0) / m, reached.sum(axis=0) / m
    spread = (turns - mean_turn).reshape(3 * m, 3)
    misses = (mean_reached - reached).reshape(3 * m)
    translation_x = smallest_solution(spread.T @ spread, misses @ spread, m * _SMALLEST_TURN_RAD**2)

    if rotation_z is None:
        rotation_z = nearest_rotation((turns @ rotation_x @ camera[:, :3, :3]).sum(axis=0))
    translation_z = mean_reached + mean_turn @ translation_x - rotation_z @ point
    return HandEye(compose(rotation_x, translation_x), compose(rotation_z, translation_z))
