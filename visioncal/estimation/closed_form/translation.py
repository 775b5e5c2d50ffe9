"""Translations and Z for a known rotation of X: the last step of most solvers.

The equation is (A_R - I) t_X = R_X t_B - t_A of Tsai and Lenz (1989), eq. 15, which later authors
share, over all pairs of views. Where rotations agree, a pair's residual is the difference between
both views' positions of one target point, so the sum over all pairs is m times the scatter of m
positions about their mean: linear in the number of views.

Noise makes the choice of that point matter. At the target's origin the robot's rotation noise has
the lever from target to flange; at the camera's centre, which t_B amounts to, the camera's has the
same lever. The point between both with the least scatter is used.
"""

import numpy as np

from visioncal.core.transforms import compose, nearest_rotation
from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye

# Least rotation (root mean square) about a direction: less is the robot's noise, which would move X
# by metres. Noise is up to 0.5 mrad, useful motion begins at 10 mrad.
_SMALLEST_TURN_RAD = 2e-3


def smallest_solution(normal: FloatArray, right: FloatArray, noise: float) -> FloatArray:
    """Minimum-norm solution of `normal @ x = right`, truncated at the noise.

    Args:
        normal: (..., n, n) symmetric and positive semidefinite.
        right: (n,) or (..., n, k) right-hand sides.
        noise: Eigenvalues up to this one are discarded.

    Returns:
        x of the shape of `right`, without components along discarded eigenvectors.
    """
    values, vectors = np.linalg.eigh(normal)
    inverse = np.where(values > noise, 1.0 / np.where(values > noise, values, 1.0), 0.0)
    return np.asarray((vectors * inverse[..., None, :]) @ (np.swapaxes(vectors, -1, -2) @ right))


def mean_camera(camera: FloatArray) -> FloatArray:
    """The (..., 3) mean camera centre in the target frame [m], of (..., m, 4, 4) poses."""
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
    """Solves for both translations and Z's rotation, by least squares over all pairs of views.

    Args:
        robot: (..., m, 4, 4) robot poses `R_i` [m].
        camera: (..., m, 4, 4) `cam_from_target` [m].
        rotation_x: (..., 3, 3) rotation of X.
        rotation_z: (..., 3, 3) rotation of Z; if None, the chordal mean of `R_i X C_i`.

    Returns:
        X and Z. Components of X's translation that the motion does not determine are zero.
    """
    *sets, m, _, _ = robot.shape
    turns, rotation_x = robot[..., :3, :3], rotation_x[..., None, :, :]
    towards = mean_camera(camera)
    # Column 0 is the target's origin; column 1 the step from it to the camera.
    columns = np.empty((*sets, m, 3, 2))
    columns[..., 0] = camera[..., :3, 3]
    columns[..., 1] = (camera[..., :3, :3] @ towards[..., None, :, None])[..., 0]
    positions = turns @ (rotation_x @ columns)
    positions[..., 0] += robot[..., :3, 3]

    mean_turn, mean_position = turns.mean(axis=-3), positions.mean(axis=-3)
    deviations = (turns - mean_turn[..., None, :, :]).reshape(*sets, 3 * m, 3)
    scatter = (positions - mean_position[..., None, :, :]).reshape(*sets, 3 * m, 2)
    cut, transposed = m * _SMALLEST_TURN_RAD**2, np.swapaxes(deviations, -1, -2)
    shifts = -smallest_solution(transposed @ deviations, transposed @ scatter, cut)
    step = _steadiest_step(scatter + deviations @ shifts)[..., None]

    translation_x = shifts[..., 0] + step * shifts[..., 1]
    if rotation_z is None:
        rotation_z = nearest_rotation((turns @ rotation_x @ camera[..., :3, :3]).sum(axis=-3))
    position = mean_position[..., 0] + step * mean_position[..., 1]
    position = position + (mean_turn @ translation_x[..., None])[..., 0]
    translation_z = position - (rotation_z @ (step * towards)[..., None])[..., 0]
    x = compose(rotation_x[..., 0, :, :], translation_x)
    return HandEye(x, compose(rotation_z, translation_z))


def _steadiest_step(scatter: FloatArray) -> FloatArray:
    """The step from 0 to 1 that makes column 0 + step * column 1 of (..., n, 2) residuals least."""
    square = np.sum(scatter[..., 1] ** 2, axis=-1)
    pulled = -np.sum(scatter[..., 0] * scatter[..., 1], axis=-1)
    best = np.divide(pulled, square, out=np.full_like(square, 0.5), where=square > 0.0)
    return np.asarray(np.clip(best, 0.0, 1.0))
