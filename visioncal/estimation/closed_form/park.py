"""Park and Martin (1994): rotation vectors, matched by least squares on SO(3).

F. C. Park, B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group",
IEEE Transactions on Robotics and Automation 10(5), 1994.
"""

import numpy as np

from visioncal.core.transforms import nearest_rotation
from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.pairs import rotation_pairs
from visioncal.estimation.closed_form.translation import complete


@solver
def park(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for X by matching the logarithms of relative rotations; for (...,) sets at once.

    With log A = [alpha], log B = [beta] a pair obeys alpha = R_X beta. The minimum of the squared
    differences is (M^T M)^(-1/2) M^T with M = sum beta alpha^T, the paper's closed form for noisy
    pairs. The singular value decomposition of M^T gives it even where M is rank deficient.
    """
    pairs = rotation_pairs(robot, camera)
    alpha, beta = _half_logarithms(pairs.robot), _half_logarithms(pairs.camera)
    # The branch below |angle| = 180 degrees has settled the signs: only the fading is left.
    matched = (np.abs(pairs.weight)[..., None, :] * alpha) @ np.swapaxes(beta, -1, -2)
    return complete(robot, camera, nearest_rotation(matched))


def _half_logarithms(quaternions: FloatArray) -> FloatArray:
    """Half the (..., 3, n) rotation vectors [rad] of (..., 4, n) quaternions of any sign."""
    scalar, vector = quaternions[..., :1, :], quaternions[..., 1:, :]
    sine = np.sqrt((vector * vector).sum(axis=-2, keepdims=True))
    half_angle = np.arctan2(sine, np.abs(scalar))
    stretch = half_angle / np.maximum(sine, np.finfo(float).tiny)
    return np.asarray(np.copysign(stretch, scalar) * vector)
