"""The step that most solvers share: both translations and Z, once X's rotation is known.

The equation is (A_R - I) t_X = R_X t_B - t_A of Tsai and Lenz (1989), eq. 15, which later authors
share, over all pairs of views. Where rotations agree, a pair's residual is the difference between
what both views say about the place of one point of the target, so the sum over all pairs is m
times the scatter of m places about their mean: linear in the number of views.

Noise makes the choice of that point matter. At the target's origin the robot's rotation noise has
the lever from target to flange; at the camera's centre, to which t_B amounts, the camera's has
the same lever. Of the points between both, the one is taken that the views place most repeatably.
"""

import numpy as np

from visioncal.core.transforms import compose, nearest_rotation
from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye

# A direction that the views turn by less than this (root mean square) shows the robot's noise,
# which would move X by metres; noise is up to 0.5 mrad, useful motion begins at 10 mrad.
_SMALLEST_TURN_RAD = 2e-3


def smallest_solution(normal: FloatArray, right: FloatArray, noise: float) -> FloatArray:
    """Solves `normal @ x = right` for the shortest x.

    Args:
        normal: (..., n, n) symmetric and positive semidefinite.
        right: (n,) or (..., n, k) right-hand sides.
        noise: An eigenvalue up to this one says nothing.

    Returns:
        x of the shape of `right`, without any component along which the eigenvalue is within noise.
    """
    values, vectors = np.linalg.eigh(normal)
    inverse = np.where(values > noise, 1.0 / np.where(values > noise, values, 1.0), 0.0)
    return np.asarray((vectors * inverse[..., None, :]) @ (np.swapaxes(vectors, -1, -2) @ right))


def mean_camera(camera: FloatArray) -> FloatArray:
    """The (..., 3) mean of the camera's centres in the target frame [m] of (..., m, 4, 4) poses."""
    *sets, m, _, _ = camera.shape
    rotation = camera[..., :3, :3].reshape(*sets, 3 * m, 3)
    translation = camera[..., :3, 3].reshape(*sets, 1, 3 * m)
    return np.asarray((translation @ rotation)[..., 0, :] / -m)


def complete(
    robot: FloatArray,
    camera: FloatArray,
    rotation_x: FloatArray,
    rotation_z: FloatArray | None = None,
) -> HandEye:
    """Finds what X's rotation leaves open, by least squares over all pairs of views.

    Args:
        robot: (..., m, 4, 4) robot poses `R_i` [m].
        camera: (..., m, 4, 4) `cam_from_target` [m].
        rotation_x: (..., 3, 3) rotation of X.
        rotation_z: (..., 3, 3) rotation of Z; absent, it is the chordal mean of `R_i X C_i`.

    Returns:
        X and Z. Components of X's translation that the motion does not show are zero.
    """
    *sets, m, _, _ = robot.shape
    turns, rotation_x = robot[..., :3, :3], rotation_x[..., None, :, :]
    towards = mean_camera(camera)
    # Column 0 is for the target's origin; column 1 is what a step from it to the camera adds.
    seen = np.empty((*sets, m, 3, 2))
    seen[..., 0] = camera[..., :3, 3]
    seen[..., 1] = (camera[..., :3, :3] @ towards[..., None, :, None])[..., 0]
    places = turns @ (rotation_x @ seen)
    places[..., 0] += robot[..., :3, 3]

    mean_turn, mean_place = turns.mean(axis=-3), places.mean(axis=-3)
    deviations = (turns - mean_turn[..., None, :, :]).reshape(*sets, 3 * m, 3)
    scatter = (places - mean_place[..., None, :, :]).reshape(*sets, 3 * m, 2)
    cut, turned = m * _SMALLEST_TURN_RAD**2, np.swapaxes(deviations, -1, -2)
    shifts = -smallest_solution(turned @ deviations, turned @ scatter, cut)
    step = _steadiest_step(scatter + deviations @ shifts)[..., None]

    translation_x = shifts[..., 0] + step * shifts[..., 1]
    if rotation_z is None:
        rotation_z = nearest_rotation((turns @ rotation_x @ camera[..., :3, :3]).sum(axis=-3))
    place = mean_place[..., 0] + step * mean_place[..., 1]
    place = place + (mean_turn @ translation_x[..., None])[..., 0]
    translation_z = place - (rotation_z @ (step * towards)[..., None])[..., 0]
    x = compose(rotation_x[..., 0, :, :], translation_x)
    return HandEye(x, compose(rotation_z, translation_z))


def _steadiest_step(scatter: FloatArray) -> FloatArray:
    """The step from 0 to 1 that makes column 0 + step * column 1 of (..., n, 2) residuals least."""
    square = np.sum(scatter[..., 1] ** 2, axis=-1)
    pulled = -np.sum(scatter[..., 0] * scatter[..., 1], axis=-1)
    best = np.divide(pulled, square, out=np.full_like(square, 0.5), where=square > 0.0)
    return np.asarray(np.clip(best, 0.0, 1.0))
