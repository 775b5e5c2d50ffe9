"""Tsai and Lenz (1989): modified Rodrigues vectors, one linear system.

R. Y. Tsai, R. K. Lenz, "A new technique for fully autonomous and efficient 3D robotics hand/eye
calibration", IEEE Transactions on Robotics and Automation 5(3), 1989.
"""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form import quaternions
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.pairs import rotation_pairs
from visioncal.estimation.closed_form.translation import complete, smallest_solution

# The identity and the half turns about x, y, z. The scalar part of X's quaternion, seen from
# these frames, is w, x, y or z; one of the four is at least 1/2, a turn of at most 120 degrees.
_FRAMES = np.array([np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])], float)

# Least mean square rotation [rad^2]: less is rounding, not motion.
_ROUNDING = 1e-14


@solver
def tsai(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for X's modified Rodrigues vector, in a frame where it is small.

    A pair obeys (P_g + P_c) x P' = P_c - P_g (eq. 12), with P = 2 sin(angle / 2) axis of both
    relative rotations and P' = tan(angle / 2) axis of X, which is infinite for a half turn.
    Therefore the camera's vectors are first rotated by a known R0, which leaves X inv(R0) to solve
    for: by the best conditioned of four such rotations, and then by the solution of that, so that
    the result does not depend on the choice of the camera's axes.
    """
    pairs = rotation_pairs(robot, camera)
    g, c, trust = pairs.robot[1:], pairs.camera[1:], np.abs(pairs.weight)
    moments = (trust * g) @ g.T, (trust * c) @ c.T, (pairs.weight * g) @ c.T

    normals, _ = _normal_equations(*moments, _FRAMES)
    frame = _FRAMES[np.linalg.eigvalsh(normals)[:, 0].argmax()]
    for _ in range(2):
        normal, right = _normal_equations(*moments, frame)
        rodrigues = smallest_solution(normal, right, _ROUNDING * pairs.weight.size)
        frame = quaternions.to_rotation(np.concatenate([[1.0], rodrigues])) @ frame
    return complete(robot, camera, frame)


def _normal_equations(
    robot: FloatArray, camera: FloatArray, mixed: FloatArray, frames: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of eq. 12, halved, in rotated camera frames.

    Args:
        robot: (3, 3) sum of the outer products g g^T, with P_g = 2 g.
        camera: (3, 3) sum of c c^T, with P_c = 2 c.
        mixed: (3, 3) sum of g c^T.
        frames: (..., 3, 3) rotations by which c is turned.

    Returns:
        (..., 3, 3) normal matrices [rad^2] and (..., 3) right-hand sides of P'.
    """
    frames_t = np.swapaxes(frames, -1, -2)
    turned = mixed @ frames_t
    turned_t = np.swapaxes(turned, -1, -2)
    outer = robot + frames @ camera @ frames_t + turned + turned_t
    normals = np.trace(outer, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - outer
    # (g + c) x (c - g) = 2 g x c, and the entries of g x c are differences of those of g c^T.
    cross = (turned - turned_t)[..., [1, 2, 0], [2, 0, 1]]
    return normals, -2.0 * cross
