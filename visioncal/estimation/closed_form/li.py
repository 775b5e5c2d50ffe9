"""Li, Wang and Wu (2010): one linear system in both unknowns' entries.

A. Li, L. Wang, D. Wu, "Simultaneous robot-world and hand-eye calibration using dual-quaternions
and Kronecker product", International Journal of the Physical Sciences 5(10), 2010.
"""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.kronecker import least_scatter, rotations, turn_maps
from visioncal.estimation.closed_form.translation import complete


@solver
def li(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves the linear system of all four unknown parts, then makes its rotations true ones.

    With D_i = inv(C_i) a view says kron(R_i, C_i^T) vec(R_X) = vec(R_Z) and
    R_i t_X + t_i = R_Z d_i + t_Z (eq. 19, where A = R_i and B = D_i). R_X and the translations
    are eliminated, which leaves 9 unknowns of the 24. As in `andreff`, the system is solved
    up to scale and the translations once more when the rotations are known. One metre weighs
    as much as one radian.
    """
    m = len(robot)
    # -d_i: from the camera to the target's origin, in the target's axes.
    origins = (camera[:, None, :3, 3] @ camera[:, :3, :3])[:, 0]
    rows = np.zeros((m, 3, 13))
    rows[:, :, :4] = robot[:, :3, :]
    for axis in range(3):
        rows[:, axis, 4 + 3 * axis : 7 + 3 * axis] = origins
    to_x = turn_maps(robot, camera).swapaxes(1, 2)
    vector_z = least_scatter(to_x, rows)
    vector_x = (to_x @ vector_z).sum(axis=0)
    rotation_x, rotation_z = rotations(np.array([vector_x, vector_z]))
    return complete(robot, camera, rotation_x, rotation_z)
