"""How the corners of a printed board may lie elsewhere than its file says."""

from visioncal.core.types import FloatArray
from visioncal.estimation.appearance import ASPECT, SCALE, SHEAR, board_basis

# Derivatives by size, by aspect and shear, and by seven polynomials of second and third order.
SIZE, PLANE, BEND = slice(0, 1), slice(1, 3), slice(3, 10)
SHAPES = BEND.stop


def shape_basis(points: FloatArray) -> FloatArray:
    """Derivatives (c, 3, 10) of a board's (c, 3) corners by its shape [m].

    Size, aspect and shear are shares of its lengths; a bend is the height at a distance of half of
    its longer side from its middle [m], less the plane that fits it best: that is confounded with
    the board's pose.
    """
    return board_basis(points)[:, :, [SCALE, ASPECT, SHEAR, *range(2, 9)]]
