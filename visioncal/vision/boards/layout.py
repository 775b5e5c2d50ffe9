"""Markers in an image, and whether they lie on a plane as a target describes them."""

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image
from visioncal.vision.boards.kind import aruco_dictionary

# Largest rms distance of markers from a homography, in marker sides. Lens distortion and noise stay
# under 0.1; another layout moves every second row by more than a side.
LAYOUT_MISFIT = 0.35


def read_markers(
    image: Image, dictionary: str, parameters: cv2.aruco.DetectorParameters | None = None
) -> tuple[list[int], FloatArray]:
    """Markers of a dictionary in a (h, w) grey image (Garrido-Jurado et al. 2014; OpenCV).

    Returns:
        Their ids, which may repeat, and (t, 4, 2) corners in OpenCV's order [px].
    """
    if min(image.shape) < 2:
        return [], np.zeros((0, 4, 2))
    given = parameters or cv2.aruco.DetectorParameters()
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(dictionary), given)
    px, ids, _ = detector.detectMarkers(image)
    found = [] if ids is None else [int(number) for number in np.ravel(ids)]
    return found, np.asarray(np.reshape(px, (-1, 4, 2)), dtype=float)


def layout_misfit(on_board: FloatArray, in_image: FloatArray) -> float:
    """Rms distance of markers from their positions on a plane, in marker sides.

    A wide-angle lens bends a large board by more than a side, but not a few neighbours: if the
    whole board does not fit a plane, each marker is judged with its neighbours.

    Above `LAYOUT_MISFIT`, which no correct layout exceeds, it is a lower bound: a search over many
    layouts does not need the exact value.

    Args:
        on_board: (m, 4, 2) corners of the markers on the board, in any unit.
        in_image: (m, 4, 2) detected corners [px].
    """
    board_misfit = _off_plane(on_board, in_image)
    if board_misfit <= LAYOUT_MISFIT:
        return board_misfit
    centres = in_image.mean(axis=1)
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    # Enough to include the rows above and below.
    neighbours = np.argsort(distances, axis=1)[:, :9]
    squares, limit = 0.0, len(neighbours) * LAYOUT_MISFIT**2
    for index in neighbours:
        squares += _off_plane(on_board[index], in_image[index]) ** 2
        if squares > limit:
            break
    return float(np.sqrt(squares / len(neighbours)))


def _off_plane(on_board: FloatArray, in_image: FloatArray) -> float:
    """Rms distance of (n, 4, 2) marker corners from a homography, in marker sides."""
    on_plane, px = on_board.reshape(-1, 2), in_image.reshape(-1, 2)
    homography = np.asarray(cv2.findHomography(on_plane, px)[0])
    if homography.shape != (3, 3):
        return 0.0
    predicted = cv2.perspectiveTransform(on_plane[None], homography)[0]
    sides = np.linalg.norm(np.diff(in_image, axis=1), axis=2)
    errors = np.linalg.norm(predicted - px, axis=1)
    return float(np.sqrt(np.mean(errors**2)) / np.median(sides))
