"""How the corners of a printed board may lie elsewhere than its file says."""

from visioncal.core.types import FloatArray, Target
from visioncal.vision.board_shape import ASPECT, SCALE, SHEAR, loose_basis

# Derivatives by size, by aspect and shear, and by seven polynomials of second and third order.
SIZE, PLANE, BEND = slice(0, 1), slice(1, 3), slice(3, 10)
SHAPES = BEND.stop


def shape_count(board: Target | None) -> int:
    """The number s of values of a board's shape, with two for each corner where these are loose."""
    return SHAPES + (2 * len(board.point_sigmas_m) if board and not board.is_rig else 0)


def shape_basis(points: FloatArray, *, is_loose: bool = False) -> FloatArray:
    """Derivatives (c, 3, s) of a board's (c, 3) corners by its shape [m].

    Size, aspect and shear are shares of its lengths; a bend is the height at a distance of half of
    its longer side from its middle [m], less the plane that fits it best: that is confounded with
    the board's pose. Loose corners are elsewhere in its plane, too [m].
    """
    basis = loose_basis(points, is_loose=is_loose)
    return basis[:, :, shape_order(basis.shape[2])]


def shape_order(count: int) -> list[int]:
    """The index of each of s values of a board's shape among those of `loose_basis`."""
    return [SCALE, ASPECT, SHEAR, *range(2, 9), *range(SHAPES, count)]
