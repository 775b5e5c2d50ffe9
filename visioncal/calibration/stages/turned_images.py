"""Detection of single images that were turned or mirrored.

Such an image shows another lens than the others, from a pose that the robot did not take; but its
corners, turned back, are where the robot and the board predict them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from visioncal.core.types import FloatArray

# Corners agree with the prediction within this multiple of the typical residual.
_AGREEMENT = 5.0
# Least residual of a detector [px].
_LEAST_PX = 0.05
# Corners at random places among the predicted ones are 0.4 of the spacing from the nearest.
_OF_SPACING = 0.15


@dataclass(frozen=True, order=True)
class ImageTurn:
    """A rotation or reflection of an image, in words, and ImageMagick's option that undoes it."""

    words: str
    option: str


# What each did to a corner's place relative to the middle of the image, which its inverse undoes;
# quarter turns only of square images, which keep their size.
_TURNS = {
    ImageTurn("turned by 180 deg", "-rotate 180"): [[-1, 0], [0, -1]],
    ImageTurn("mirrored left to right", "-flop"): [[-1, 0], [0, 1]],
    ImageTurn("mirrored upside down", "-flip"): [[1, 0], [0, -1]],
    ImageTurn("turned by 90 deg counterclockwise", "-rotate 90"): [[0, 1], [-1, 0]],
    ImageTurn("turned by 90 deg clockwise", "-rotate 270"): [[0, -1], [1, 0]],
}


def find_image_turn(
    px: FloatArray, predicted_px: FloatArray, size: tuple[int, int], typical_px: float
) -> ImageTurn | None:
    """Finds how the image of an outlier view was turned or mirrored.

    Corners are compared with the nearest predicted one: a mirrored checkerboard is numbered
    differently, and one that looks the same upside down may be numbered from either end.

    Args:
        px: (n, 2) its corners [px].
        predicted_px: (m, 2) all of the target's, as robot and board predict them [px].
        size: Width and height of the image [px].
        typical_px: RMS residual of the corners of inlier views [px].

    Returns:
        The turn; None where the corners are as predicted, or no turn explains them.
    """
    predicted = predicted_px[np.isfinite(predicted_px).all(axis=1)]
    if not len(predicted):
        return None
    # Median distance of a corner from its nearest neighbour; infinite for one.
    spacing_px = float(np.median(cKDTree(predicted).query(predicted, k=2)[0][:, 1]))
    limit_px = min(_AGREEMENT * max(typical_px, _LEAST_PX), _OF_SPACING * spacing_px)
    if _rms_px(px, predicted) < limit_px:
        return None
    middle = (np.array(size) - 1.0) / 2.0
    rms_px, turn = min(
        (_rms_px(middle + (px - middle) @ np.array(turned), predicted), turn)
        for turn, turned in _TURNS.items()
        if turned[0][0] or size[0] == size[1]
    )
    return turn if rms_px < limit_px else None


def _rms_px(px: FloatArray, places: FloatArray) -> float:
    """RMS distance of points from the nearest of others [px]."""
    return float(np.sqrt(np.mean(cKDTree(places).query(px)[0] ** 2)))
