"""Shah (2013): both rotations as singular vectors of one Kronecker sum.

M. Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker product",
Journal of Mechanisms and Robotics 5(3), 2013.
"""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.kronecker import least_scatter, rotations, turn_maps
from visioncal.estimation.closed_form.translation import complete


@solver
def shah(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for both rotations at once, then for both translations.

    R_i R_X C_i = R_Z makes vec(R_X) and vec(R_Z) the singular vectors of
    K = sum kron(R_i, C_i^T) that belong to its largest singular value, which is m without noise.
    As the terms of K are orthogonal, m - |K x|^2 / m is their scatter at a unit vector x, and
    the singular vector is where it is least. It is found as such, because the singular values
    of K themselves are nearly equal where all tilts are small. Both vectors are then made
    rotations by the orthogonal Procrustes solution.
    """
    maps = turn_maps(robot, camera)
    vector_x = least_scatter(maps)
    vector_z = (maps @ vector_x).sum(axis=0)
    rotation_x, rotation_z = rotations(np.array([vector_x, vector_z]))
    return complete(robot, camera, rotation_x, rotation_z)
