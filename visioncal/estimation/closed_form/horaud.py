"""Horaud and Dornaika (1995): rotation axes, matched by one unit quaternion.

R. Horaud, F. Dornaika, "Hand-eye calibration", International Journal of Robotics Research 14(3),
1995.
"""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form import quaternions
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.pairs import rotation_pairs
from visioncal.estimation.closed_form.translation import complete

_VECTORS = quaternions.PRODUCT[:, 1:, :], quaternions.PRODUCT[:, :, 1:]
# What the product a_k b_l adds to entry (r, c) of sum Q(a)^T W(b), as a (9, 16) map.
_CORRELATION = np.einsum("nkr,ncl->klrc", *_VECTORS).reshape(9, 16)


@solver
def horaud(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for X's quaternion as an eigenvector.

    A pair obeys a q = q b, with a and b the vector parts of both relative rotations. The sum of
    |Q(a) q - W(b) q|^2, with the matrices Q and W of the paper's appendix A, is smallest at the
    eigenvector of sum Q(a)^T W(b), symmetric for pure vectors, that belongs to its largest
    eigenvalue. The paper's a and b are unit axes; here they keep their length sin(angle / 2),
    which weights the pairs by their noise.
    """
    pairs = rotation_pairs(robot, camera)
    matched = (pairs.weight * pairs.robot[1:]) @ pairs.camera[1:].T
    correlation = (matched.reshape(9) @ _CORRELATION).reshape(4, 4)
    quaternion = np.linalg.eigh(correlation)[1][:, -1]
    return complete(robot, camera, quaternions.to_rotation(quaternion))
