"""Relative motions between pairs of views, and how much each of them is to be trusted.

Up to a hundred views are all paired with each other. More are dealt at random, the same way every
time, into groups within which all are: so the work grows with the number of views alone. What is
lost is what separates the groups' means, 1 % of the information: over 60 seeds of 16 simulated
worlds with 300 views, errors of X grew by 0.4 % in rotation and 0.1 % in translation on average,
and by 1 % at most.

The solvers use the vector part sin(angle / 2) * axis of a relative rotation's quaternion. Noise
of the poses moves that vector across its axis by the same amount at every angle, so plain least
squares already gives a pair of small rotation the small say that it deserves: no smallest angle
is needed, and views that are tilted by 3 degrees only still give all that they know.

Near 180 degrees the sign of a quaternion, which must agree between robot and camera, hangs on a
scalar part that drowns in noise. There a pair fades out; it is not cut off, so that a set
whose second axis shows in such pairs alone keeps it.
"""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.closed_form import quaternions

FADES_FROM_RAD = np.radians(165.0)
_FULL_WEIGHT = float(np.cos(0.5 * FADES_FROM_RAD) ** 2)
# Views that are all paired with each other.
_GROUP = 100


@dataclass(frozen=True, eq=False)
class Pairs:
    """Relative rotations as quaternions (w, x, y, z), both orders of n / 2 pairs of views.

    Attributes:
        robot: (..., 4, n) of A = inv(R_j) R_i.
        camera: (..., 4, n) of B = C_j inv(C_i), one motion after the other.
        weight: (..., n) from -1 to 1; negative where one of the two is to change its sign.
    """

    robot: FloatArray
    camera: FloatArray
    weight: FloatArray


def rotation_pairs(robot: FloatArray, camera: FloatArray) -> Pairs:
    """Forms the relative rotations of the pairs of (..., m, 4, 4) views."""
    r = quaternions.from_rotations(robot[..., :3, :3])
    c = quaternions.from_rotations(camera[..., :3, :3])
    return pair_up(r, c)


def pair_up(robot: FloatArray, camera: FloatArray) -> Pairs:
    """Forms the relative rotations of the pairs of (..., m, 4) quaternions."""
    a = pair_products(robot * quaternions.CONJUGATE, robot)
    b = pair_products(camera, camera * quaternions.CONJUGATE)
    agreement = a[..., 0, :] * b[..., 0, :] / _FULL_WEIGHT
    return Pairs(a, b, np.minimum(np.maximum(agreement, -1.0), 1.0))


def pair_products(left: FloatArray, right: FloatArray) -> FloatArray:
    """Products `left[j] * right[i]` of (..., m, 4) quaternions of all pairs, as (..., 4, n)."""
    if left.shape[-2] <= _GROUP:
        return quaternions.all_products(left, right)
    parts = [
        quaternions.all_products(left[..., group, :], right[..., group, :])
        for group in _groups(left.shape[-2])
    ]
    return np.concatenate(parts, axis=-1)


def _groups(views: int) -> list[IntArray]:
    """Which of many views are paired with each other."""
    order = np.random.default_rng(0).permutation(views)
    return np.array_split(order, -(-views // _GROUP))
