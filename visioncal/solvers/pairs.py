"""Relative motions between all pairs of views, and how much each of them is to be trusted.

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

from visioncal.errors import DataError
from visioncal.solvers import quaternions
from visioncal.types import FloatArray

# Their pairs take 1.6 GB.
MOST_VIEWS = 2000
FADES_FROM_RAD = np.radians(165.0)
_FULL_WEIGHT = float(np.cos(0.5 * FADES_FROM_RAD) ** 2)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Relative rotations as quaternions (w, x, y, z), all ordered pairs of m views.

    Attributes:
        robot: (4, m * m) of A = inv(R_j) R_i.
        camera: (4, m * m) of B = C_j inv(C_i), as they come.
        weight: (m * m,) from -1 to 1; negative where one of the two is to change its sign.
    """

    robot: FloatArray
    camera: FloatArray
    weight: FloatArray


def rotation_pairs(robot: FloatArray, camera: FloatArray) -> Pairs:
    """Forms the relative rotations of all pairs of (m, 4, 4) views."""
    r = quaternions.from_rotations(robot[:, :3, :3])
    c = quaternions.from_rotations(camera[:, :3, :3])
    return pair_up(r, c)


def pair_up(robot: FloatArray, camera: FloatArray) -> Pairs:
    """Forms the relative rotations of all pairs of (m, 4) quaternions.

    Raises:
        DataError: They are too many for all their pairs to be held in memory.
    """
    if len(robot) > MOST_VIEWS:
        raise DataError(
            f"{len(robot)} views have poses; up to {MOST_VIEWS} are solved together, since all "
            "pairs of them are compared.",
            next_step="Take every second or third row: dozens of stops that differ say more than "
            "thousands alike.",
        )
    a = quaternions.all_products(robot * quaternions.CONJUGATE, robot)
    b = quaternions.all_products(camera, camera * quaternions.CONJUGATE)
    agreement = a[0] * b[0] / _FULL_WEIGHT
    return Pairs(a, b, np.minimum(np.maximum(agreement, -1.0), 1.0))
