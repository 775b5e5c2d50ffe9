"""Linear equations in the entries of rotation matrices: the solvers of Andreff, Shah and Li.

N. Andreff, R. Horaud, B. Espiau, "On-line hand-eye calibration", Second International Conference
on 3-D Digital Imaging and Modeling, 1999: one linear system in X's entries.

M. Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker product",
Journal of Mechanisms and Robotics 5(3), 2013: both rotations as singular vectors of one sum.

A. Li, L. Wang, D. Wu, "Simultaneous robot-world and hand-eye calibration using dual-quaternions
and Kronecker product", International Journal of the Physical Sciences 5(10), 2010: one linear
system in both unknowns' entries.

vec() stacks the rows of a matrix, so that vec(R M C) = kron(R, C^T) vec(M).
"""

import numpy as np

from visioncal.core.transforms import nearest_rotation
from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.translation import complete, mean_camera


@solver
def andreff(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves the linear system of rotation and translation, then projects the rotation on SO(3).

    A pair obeys (I - kron(A_R, B_R)) vec(R_X) = 0 and kron(I, t_B^T) vec(R_X) + (I - A_R) t_X = t_A
    (eq. 10). Summed over all pairs both are the scatter of each view's Z, so the pairs need not be
    formed: the second is that of the positions of one target point, half-way to the camera; see
    `closed_form.translation`.

    The system is solved up to scale, with t_A times a free factor; otherwise it collapses to R_X =
    0 where the flange rotates about a fixed point. The translation is solved for again once R_X is
    a rotation. One metre weighs as much as one radian.
    """
    m = len(robot)
    seen = camera[:, :3, :3] @ (0.5 * mean_camera(camera)) + camera[:, :3, 3]
    rows = np.empty((m, 3, 13))
    rows[:, :, :4] = robot[:, :3, :]
    rows[:, :, 4:] = (robot[:, :3, :3, None] * seen[:, None, None, :]).reshape(m, 3, 9)
    vector_x = _least_scatter(_rotation_maps(robot, camera), rows)
    return complete(robot, camera, _rotations(vector_x)[0])


@solver
def shah(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for both rotations at once, then for both translations.

    R_i R_X C_i = R_Z makes vec(R_X) and vec(R_Z) the singular vectors of K = sum kron(R_i, C_i^T)
    for its largest singular value, which is m without noise. As the terms of K are orthogonal, m -
    |K x|^2 / m is their scatter at a unit vector x, and the singular vector minimises it. It is
    computed that way, because the singular values of K themselves are nearly equal where all tilts
    are small. Both vectors are then made rotations by the orthogonal Procrustes solution.
    """
    maps = _rotation_maps(robot, camera)
    vector_x = _least_scatter(maps)
    vector_z = (maps @ vector_x).sum(axis=0)
    rotation_x, rotation_z = _rotations(np.array([vector_x, vector_z]))
    return complete(robot, camera, rotation_x, rotation_z)


@solver
def li(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves the linear system of all four unknown parts, then projects its rotations on SO(3).

    With D_i = inv(C_i) a view obeys kron(R_i, C_i^T) vec(R_X) = vec(R_Z) and R_i t_X + t_i = R_Z
    d_i + t_Z (eq. 19, where A = R_i and B = D_i). R_X and the translations are eliminated, which
    leaves 9 unknowns of the 24. As in `andreff`, the system is solved up to scale and the
    translations once more when the rotations are known. One metre weighs as much as one radian.
    """
    m = len(robot)
    # -d_i: from the camera to the target's origin, in the target's axes.
    origins = (camera[:, None, :3, 3] @ camera[:, :3, :3])[:, 0]
    rows = np.zeros((m, 3, 13))
    rows[:, :, :4] = robot[:, :3, :]
    for axis in range(3):
        rows[:, axis, 4 + 3 * axis : 7 + 3 * axis] = origins
    to_x = _rotation_maps(robot, camera).swapaxes(1, 2)
    vector_z = _least_scatter(to_x, rows)
    vector_x = (to_x @ vector_z).sum(axis=0)
    rotation_x, rotation_z = _rotations(np.array([vector_x, vector_z]))
    return complete(robot, camera, rotation_x, rotation_z)


def _rotation_maps(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """The (m, 9, 9) orthogonal matrices kron(R_i, C_i^T), which map vec(R_X) to vec(R_Z)."""
    turned = camera[:, :3, :3].swapaxes(1, 2)
    products = robot[:, :3, None, :3, None] * turned[:, None, :, None, :]
    return np.asarray(products.reshape(-1, 9, 9))


def _least_scatter(maps: FloatArray, rows: FloatArray | None = None) -> FloatArray:
    """Minimises the scatter of the entries' images under the views' maps, up to scale.

    The mean image is eliminated by centring, and other unknowns by a QR decomposition. Normal
    equations would lose half of the digits, which small tilts need.

    Args:
        maps: (m, 9, 9) maps from the entries to an image that all views share.
        rows: (m, k, n + 9) coefficients of n other unknowns and of the 9 entries in further
            equations, with an unknown constant of their own that all views share.

    Returns:
        (9,) entries, of length 1 and of either sign.
    """
    m = len(maps)
    system = maps
    if rows is not None:
        system = np.zeros((m, 9 + rows.shape[1], rows.shape[2]))
        system[:, :9, -9:] = maps
        system[:, 9:] = rows
    centred = (system - system.sum(axis=0) / m).reshape(-1, system.shape[2])
    triangle = np.asarray(np.linalg.qr(centred, mode="r"))
    return np.asarray(np.linalg.svd(triangle[-9:, -9:])[2][-1])


def _rotations(vectors: FloatArray) -> FloatArray:
    """The (n, 3, 3) rotations nearest to matrices of which (n, 9) are multiples of either sign.

    All have the same sign; the first decides it.
    """
    matrices = vectors.reshape(-1, 3, 3)
    return nearest_rotation(np.copysign(1.0, np.linalg.det(matrices[0])) * matrices)
