"""Where dark and light squares meet: a chessboard's corners, separated from what only lies near."""

import numpy as np

from visioncal.core.types import FloatArray, Image, Mask
from visioncal.vision.finders.identify_plane import Plane

# The weaker pair of opposite squares must differ from the other by this share of the contrast that
# a board's corners have.
_LEAST_CONTRAST = 0.4


def contrasts(image: Image, plane: Plane, corners: FloatArray, reach: float) -> FloatArray:
    """Measures how much corners of squares look like corners of a chessboard.

    Args:
        image: (h, w) grey image.
        plane: How the board lies.
        corners: (n, 2) whole numbers: corners on the board.
        reach: How far from the corner, along both axes, its four squares are looked at.

    Returns:
        (n,) the least light less the greatest dark of the four squares [grey levels], positive
        where the squares up left and down right of the corner are light; negative by as much where
        they are dark; 0 where they do not alternate.
    """
    steps = reach * np.array([[-1.0, -1], [1, 1], [1, -1], [-1, 1]])
    levels = plane.levels(image, corners[:, None] + steps)
    first, second = levels[:, :2], levels[:, 2:]
    light = first.min(axis=1) - second.max(axis=1)
    dark = second.min(axis=1) - first.max(axis=1)
    return np.asarray(np.where(light > 0, light, np.where(dark > 0, -dark, 0.0)))


def typical_contrast(values: FloatArray, corners: FloatArray) -> float:
    """The contrast of a board's (n, 2) corners, as it would be at corner (0, 0): signed."""
    return float(np.median(values * _signs(corners)))


def alternating(values: FloatArray, corners: FloatArray, typical: float) -> Mask:
    """Tells which corners alternate as those of the board do.

    Args:
        values: (n,) what `contrasts` gave.
        corners: (n, 2) the corners.
        typical: What `typical_contrast` gave for corners of the board.
    """
    signed = values * _signs(corners) * np.sign(typical)
    return np.asarray(signed > _LEAST_CONTRAST * abs(typical))


def _signs(corners: FloatArray) -> FloatArray:
    """The colours alternate from corner to corner."""
    return np.where(corners.sum(axis=1) % 2 == 0, 1.0, -1.0)
