"""Linear equations in the entries of rotation matrices, shared by Shah, Andreff and Li.

vec() stacks the rows of a matrix, so that vec(R M C) = kron(R, C^T) vec(M).
"""

import numpy as np

from visioncal.core.transforms import nearest_rotation
from visioncal.core.types import FloatArray


def turn_maps(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """The (m, 9, 9) orthogonal matrices kron(R_i, C_i^T), which map vec(R_X) to vec(R_Z)."""
    turned = camera[:, :3, :3].swapaxes(1, 2)
    products = robot[:, :3, None, :3, None] * turned[:, None, :, None, :]
    return np.asarray(products.reshape(-1, 9, 9))


def least_scatter(maps: FloatArray, rows: FloatArray | None = None) -> FloatArray:
    """Finds the entries, up to scale, about whose images the views agree best.

    The image is unknown, too, and is eliminated by centring; then other unknowns are by a QR
    decomposition. Normal equations would lose half of the digits, which small tilts need.

    Args:
        maps: (m, 9, 9) maps from the entries to what all views should agree about.
        rows: (m, k, n + 9) coefficients of n other unknowns and of the 9 entries in further
            equations, with a constant of their own that all views share.

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


def rotations(vectors: FloatArray) -> FloatArray:
    """The (n, 3, 3) rotations nearest to matrices of which (n, 9) are multiples of either sign.

    All have the same sign; the first decides it.
    """
    matrices = vectors.reshape(-1, 3, 3)
    return nearest_rotation(np.copysign(1.0, np.linalg.det(matrices[0])) * matrices)
