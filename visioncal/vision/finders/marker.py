"""Finding single ArUco or AprilTag markers."""

from collections.abc import Sequence

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.targets import aruco_dictionary


def find_marker(image: Image, target: Target) -> DetectedCorners | NotFound:
    """Finds the four corners of one marker, in OpenCV's order (Garrido-Jurado et al. 2014).

    Args:
        image: (h, w) grey image.
        target: A marker target.

    Returns:
        The corners, or why there are none.
    """
    if min(image.shape) < 2:
        return NotFound("the image is a line")
    px, found = _markers(image, target.dictionary)
    if target.marker_id not in found:
        seen = f"; seen instead: {', '.join(map(str, found[:5]))}" if found else ""
        return NotFound(f"no marker {target.marker_id} of {target.dictionary} is seen{seen}")
    if found.count(target.marker_id) > 1:
        return NotFound(f"marker {target.marker_id} is seen {found.count(target.marker_id)} times")
    corners = px[found.index(target.marker_id)].reshape(4, 2)
    return DetectedCorners(np.arange(4), corners)


def marker_ids(image: Image, dictionary: str) -> tuple[int, ...]:
    """Lists the markers of a dictionary that a (h, w) grey image shows, each once."""
    return tuple(dict.fromkeys(_markers(image, dictionary)[1]))


def _markers(image: Image, dictionary: str) -> tuple[Sequence[FloatArray], list[int]]:
    """The corners of all markers and their ids."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(dictionary), parameters)
    px, ids, _ = detector.detectMarkers(image)
    found = [] if ids is None else [int(it) for it in ids.ravel()]
    return [np.asarray(it, dtype=np.float64) for it in px], found
