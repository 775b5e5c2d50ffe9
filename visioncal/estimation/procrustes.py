"""Closed forms that lay one set of points on another, batched."""

import numpy as np

from visioncal.core.transforms import apply, compose, nearest_rotation
from visioncal.core.types import FloatArray

# One reflection: with a rotation behind it, it is any other.
_MIRROR = np.array([-1.0, 1.0, 1.0])


def align(measured: FloatArray, nominal: FloatArray) -> FloatArray:
    """Finds the rigid transforms that lay nominal points on measured ones.

    Least squares of the distances (Arun, Huang and Blostein 1987), with the determinant kept at +1
    (Umeyama 1991, equation 43).

    Args:
        measured: (..., n, 3) in frame a [m].
        nominal: (..., n, 3) in frame b [m], aligned with them.

    Returns:
        (..., 4, 4) `a_from_b`. Where the points are collinear, it is one of the many that fit.
    """
    centre_a, centre_b = measured.mean(axis=-2), nominal.mean(axis=-2)
    spread_a, spread_b = measured - centre_a[..., None, :], nominal - centre_b[..., None, :]
    rotation = nearest_rotation(np.swapaxes(spread_a, -1, -2) @ spread_b)
    return compose(rotation, centre_a - (rotation @ centre_b[..., None])[..., 0])


def procrustes_residual(measured: FloatArray, nominal: FloatArray) -> FloatArray:
    """Sums (...,) the squared distances [m^2] that the best rigid transform leaves."""
    left = measured - apply(align(measured, nominal), nominal)
    return np.asarray(np.sum(left**2, axis=(-1, -2)))


def mirrored(points: FloatArray) -> FloatArray:
    """Reflects (..., n, 3) points, as a left-handed frame has them."""
    return np.asarray(points * _MIRROR)


def scale_between(measured: FloatArray, nominal: FloatArray) -> float:
    """How much larger (n, 3) measured points are than (n, 3) nominal ones (Umeyama 1991, eq. 42).

    Where the nominal points coincide it is 1.
    """
    spread_a, spread_b = measured - measured.mean(axis=0), nominal - nominal.mean(axis=0)
    turned = spread_b @ align(measured, nominal)[:3, :3].T
    size = float(np.sum(spread_b**2))
    return float(np.sum(spread_a * turned)) / size if size > 0.0 else 1.0


def spreads(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far points reach along their principal axes.

    Args:
        points: (n, 3) [m].

    Returns:
        (3,) root mean square extents, largest first [m], and the (3, 3) axes as rows.
    """
    _, sizes, axes = np.linalg.svd(points - points.mean(axis=0))
    extents = np.zeros(3)
    extents[: len(sizes)] = sizes / np.sqrt(len(points))
    return extents, axes
