"""Batched closed-form alignment of point sets."""

import numpy as np

from visioncal.core.transforms import compose, nearest_rotation
from visioncal.core.types import FloatArray


def align(measured: FloatArray, nominal: FloatArray) -> FloatArray:
    """Rigid transforms that align nominal points with measured ones.

    Least squares of the distances (Arun, Huang and Blostein 1987), with the determinant kept at +1
    (Umeyama 1991, equation 43).

    Args:
        measured: (..., n, 3) in frame a [m].
        nominal: (..., n, 3) in frame b [m], in the same order.

    Returns:
        (..., 4, 4) `a_from_b`. For collinear points it is one of the many that fit.
    """
    centre_a, centre_b = measured.mean(axis=-2), nominal.mean(axis=-2)
    centred_a, centred_b = measured - centre_a[..., None, :], nominal - centre_b[..., None, :]
    rotation = nearest_rotation(np.swapaxes(centred_a, -1, -2) @ centred_b)
    return compose(rotation, centre_a - (rotation @ centre_b[..., None])[..., 0])


def spreads(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root mean square extents (3,) of (n, 3) points along their principal axes [m].

    Largest first, with the (3, 3) axes as rows.
    """
    _, sizes, axes = np.linalg.svd(points - points.mean(axis=0))
    extents = np.zeros(3)
    extents[: len(sizes)] = sizes / np.sqrt(len(points))
    return extents, axes
