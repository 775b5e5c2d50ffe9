"""Finding single ArUco or AprilTag markers."""

from collections.abc import Sequence

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.finders.board import DETECTED_WEIGHT
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.finders.template import refine_tags
from visioncal.vision.targets import aruco_dictionary

# OpenCV's corners are off by so much, as blur rounds them; where the template is no better, they
# serve [px].
_DETECTED_SIGMA_PX = 0.2


def find_marker(image: Image, target: Target) -> DetectedCorners | NotFound:
    """Finds the four corners of one marker, in OpenCV's order (Garrido-Jurado et al. 2014).

    OpenCV draws blurred corners inwards, all four alike. The template of `refine_tags` places them;
    a corner that it does not fit stays OpenCV's, with less weight.

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
    modules = int(aruco_dictionary(target.dictionary).markerSize) + 2
    refined = refine_tags(image, modules, corners[None])
    fitted = refined.sigma_px < _DETECTED_SIGMA_PX
    weights = None if fitted.all() else np.where(fitted, 1.0, DETECTED_WEIGHT)
    return DetectedCorners(np.arange(4), np.where(fitted[:, None], refined.px, corners), weights)


def marker_ids(image: Image, dictionary: str) -> tuple[int, ...]:
    """Lists the markers of a dictionary that a (h, w) grey image shows, each once."""
    return tuple(dict.fromkeys(_markers(image, dictionary)[1]))


def _markers(image: Image, dictionary: str) -> tuple[Sequence[FloatArray], list[int]]:
    """The corners of all markers and their ids."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(dictionary), parameters)
    px, ids, _ = detector.detectMarkers(image)
    found = [] if ids is None else [int(number) for number in ids.ravel()]
    return [np.asarray(mat, dtype=np.float64) for mat in px], found
