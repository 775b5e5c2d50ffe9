"""Finding single ArUco or AprilTag markers."""

import cv2
import numpy as np

from visioncal.finders.result import NotFound, Seen
from visioncal.targets import aruco_dictionary
from visioncal.types import Image, Target


def find_marker(image: Image, target: Target) -> Seen | NotFound:
    """Finds the four corners of one marker, in OpenCV's order (Garrido-Jurado et al. 2014).

    Args:
        image: (h, w) grey image.
        target: A marker target.

    Returns:
        The corners, or why there are none.
    """
    dictionary = aruco_dictionary(target.dictionary)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    px, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    found = [] if ids is None else [int(it) for it in ids.ravel()]
    if target.marker_id not in found:
        seen = f"; seen instead: {', '.join(map(str, found[:5]))}" if found else ""
        return NotFound(f"no marker {target.marker_id} of {target.dictionary} is seen{seen}")
    if found.count(target.marker_id) > 1:
        return NotFound(f"marker {target.marker_id} is seen {found.count(target.marker_id)} times")
    corners = px[found.index(target.marker_id)].reshape(4, 2).astype(np.float64)
    return Seen(np.arange(4), corners)
