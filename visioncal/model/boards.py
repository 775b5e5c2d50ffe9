"""How the corners of a printed board may lie elsewhere than its file says."""

import numpy as np

from visioncal.core.types import FloatArray

# Derivatives by size, by aspect and shear, and by seven polynomials of second and third order.
SIZE, PLANE, BEND = slice(0, 1), slice(1, 3), slice(3, 10)
SHAPES = BEND.stop


def shape_basis(points: FloatArray) -> FloatArray:
    """Derivatives (c, 3, 10) of a board's (c, 3) corners by its shape [m].

    Size, aspect and shear are shares of its lengths; a bend is the height at a distance of half of
    its longer side from its middle [m], less the plane that fits it best: that is confounded with
    the board's pose.
    """
    middle, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0).max() / 2
    u, v = ((points - middle) / half)[:, :2].T
    basis = np.zeros((len(points), 3, SHAPES))
    basis[:, :, 0] = points
    basis[:, 0, 1], basis[:, 1, 1] = -points[:, 0] / 2, points[:, 1] / 2
    basis[:, :2, 2] = points[:, 1::-1] / 2
    bends = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    basis[:, 2, BEND] = bends - plane @ np.linalg.lstsq(plane, bends, rcond=None)[0]
    return basis
