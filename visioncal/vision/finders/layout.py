"""Whether markers lie on a plane as a target describes them."""

import cv2
import numpy as np

from visioncal.core.types import FloatArray

# Rms distance of markers from a plane's homography, in sides of a marker. Lens distortion and
# noise stay under a tenth; another layout moves every second row by more than a whole side.
LAYOUT_MISFIT = 0.35
# A marker and those around it: of this many, some are of the rows above and below.
_NEIGHBOURS = 9


def layout_misfit(on_board: FloatArray, in_image: FloatArray) -> float:
    """Rms distance of markers from their places on a plane, in sides of a marker.

    A wide lens bends a board of many squares by more than a side, but nowhere a few neighbours:
    where the whole board does not fit a plane, each marker is judged together with those around it.

    Beyond `LAYOUT_MISFIT`, which no layout that fits reaches, it is a lower bound: whoever tries
    many layouts need not know how wrong each is.

    Args:
        on_board: (m, 4, 2) the markers' corners on the board, in any unit.
        in_image: (m, 4, 2) where they are seen [px].
    """
    whole = _off_plane(on_board, in_image)
    if whole <= LAYOUT_MISFIT:
        return whole
    centres = in_image.mean(axis=1)
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    near = np.argsort(distances, axis=1)[:, :_NEIGHBOURS]
    squares, most = 0.0, len(near) * LAYOUT_MISFIT**2
    for index in near:
        squares += _off_plane(on_board[index], in_image[index]) ** 2
        if squares > most:
            break
    return float(np.sqrt(squares / len(near)))


def _off_plane(on_board: FloatArray, in_image: FloatArray) -> float:
    """Rms distance of (n, 4, 2) corners of markers from a homography, in sides of a marker."""
    flat, px = on_board.reshape(-1, 2), in_image.reshape(-1, 2)
    homography = np.asarray(cv2.findHomography(flat, px)[0])
    if homography.shape != (3, 3):
        return 0.0
    predicted = cv2.perspectiveTransform(flat[None], homography)[0]
    sides = np.linalg.norm(np.diff(in_image, axis=1), axis=2)
    errors = np.linalg.norm(predicted - px, axis=1)
    return float(np.sqrt(np.mean(errors**2)) / np.median(sides))
