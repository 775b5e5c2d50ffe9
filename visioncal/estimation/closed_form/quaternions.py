"""Batched unit quaternions (w, x, y, z).

Products with whole batches are single matrix products: at 20 views the overhead of a call costs
more than its arithmetic.
"""

import numpy as np

from visioncal.core.types import FloatArray

CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])

# PRODUCT[k, n, l] is the coefficient of p_n * q_l in component k of the product p * q.
PRODUCT = np.zeros((4, 4, 4))
PRODUCT[0] = np.diag(CONJUGATE)
PRODUCT[1, [0, 1, 2, 3], [1, 0, 3, 2]] = [1, 1, 1, -1]
PRODUCT[2, [0, 1, 2, 3], [2, 3, 0, 1]] = [1, -1, 1, 1]
PRODUCT[3, [0, 1, 2, 3], [3, 2, 1, 0]] = [1, 1, -1, 1]


def _outer_product_map() -> FloatArray:
    """The (9, 16) map from a rotation's entries to those of 4 q q^T - I."""
    entries = np.zeros((3, 3, 4, 4))
    for axis in range(3):
        signs = -np.ones(4)
        signs[[0, axis + 1]] = 1.0
        entries[axis, axis] = np.diag(signs)
        after, last = (axis + 1) % 3, (axis + 2) % 3
        for row, column in ((0, axis + 1), (axis + 1, 0)):
            entries[last, after, row, column] = 1.0
            entries[after, last, row, column] = -1.0
        for row, column in ((after + 1, last + 1), (last + 1, after + 1)):
            entries[last, after, row, column] = 1.0
            entries[after, last, row, column] = 1.0
    return entries.reshape(9, 16)


_OUTER_PRODUCT = _outer_product_map()
_IDENTITY = np.eye(4).reshape(16)


def from_rotations(rotations: FloatArray) -> FloatArray:
    """Quaternions (..., 4) of (..., 3, 3) rotations, accurate at any angle; signs are free.

    Every row of q q^T is a multiple of q; the row with the largest diagonal is well scaled.
    """
    outer = rotations.reshape(-1, 9) @ _OUTER_PRODUCT + _IDENTITY
    row = outer[:, ::5].argmax(axis=1)
    quaternions = outer.reshape(-1, 4, 4)[np.arange(len(row)), row]
    norms = np.sqrt((quaternions * quaternions).sum(axis=1))
    return np.asarray(quaternions / norms[:, None]).reshape(*rotations.shape[:-2], 4)


def to_rotation(quaternion: FloatArray) -> FloatArray:
    """The (3, 3) rotation of one quaternion, which is normalised first."""
    w, x, y, z = (quaternion / np.sqrt(quaternion @ quaternion)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def all_products(left: FloatArray, right: FloatArray) -> FloatArray:
    """Every `left[j] * right[i]` of (..., m, 4) quaternions, as (..., 4, m * m), i fastest."""
    *sets, m, _ = left.shape
    turned = (left[..., None, :, :] @ PRODUCT).reshape(*sets, 4 * m, 4)
    return np.asarray((turned @ np.swapaxes(right, -1, -2)).reshape(*sets, 4, m * m))
