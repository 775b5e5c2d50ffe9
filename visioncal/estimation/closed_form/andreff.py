"""Andreff, Horaud and Espiau (1999): one linear system in X's entries.

N. Andreff, R. Horaud, B. Espiau, "On-line hand-eye calibration", Second International Conference
on 3-D Digital Imaging and Modeling, 1999.
"""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.kronecker import least_scatter, rotations, turn_maps
from visioncal.estimation.closed_form.translation import complete, mean_camera


@solver
def andreff(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves the linear system of rotation and translation, then makes its rotation one.

    A pair says (I - kron(A_R, B_R)) vec(R_X) = 0 and
    kron(I, t_B^T) vec(R_X) + (I - A_R) t_X = t_A (eq. 10). Summed over all pairs both are the
    scatter of what the views say about Z, so the pairs need not be formed: the second is that of
    the places of one target point, half-way to the camera; see `closed_form.translation`.

    The system is solved up to scale, with t_A times a free factor: solved as it stands it
    collapses to R_X = 0 where the flange turns on the spot. The translation is solved for again
    once R_X is a rotation, because it was fitted to a matrix that was not. One metre weighs
    as much as one radian.
    """
    m = len(robot)
    seen = camera[:, :3, :3] @ (0.5 * mean_camera(camera)) + camera[:, :3, 3]
    rows = np.empty((m, 3, 13))
    rows[:, :, :4] = robot[:, :3, :]
    rows[:, :, 4:] = (robot[:, :3, :3, None] * seen[:, None, None, :]).reshape(m, 3, 9)
    vector_x = least_scatter(turn_maps(robot, camera), rows)
    return complete(robot, camera, rotations(vector_x)[0])
