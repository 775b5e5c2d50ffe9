"""Detection of single ArUco or AprilTag markers."""

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.finders.board import DETECTED_WEIGHT
from visioncal.vision.finders.layout import read_markers
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.finders.template import refine_tags
from visioncal.vision.targets import aruco_dictionary

# Error of OpenCV's corners, due to rounding by blur; they are used where the template is no better
# [px].
_DETECTED_SIGMA_PX = 0.2


def find_marker(image: Image, target: Target) -> DetectedCorners | NotFound:
    """Corners of one marker in a (h, w) grey image, or why there are none.

    OpenCV's corners (Garrido-Jurado et al. 2014) are biased inwards by blur. They are refined by
    the template of `refine_tags`; a corner that it does not fit remains OpenCV's, with less weight.
    """
    if min(image.shape) < 2:
        return NotFound("the image is a line")
    ids, px = _markers(image, target.dictionary)
    if target.marker_id not in ids:
        seen = f"; seen instead: {', '.join(map(str, ids[:5]))}" if ids else ""
        return NotFound(f"no marker {target.marker_id} of {target.dictionary} is seen{seen}")
    if ids.count(target.marker_id) > 1:
        return NotFound(f"marker {target.marker_id} is seen {ids.count(target.marker_id)} times")
    corners = px[ids.index(target.marker_id)]
    modules = int(aruco_dictionary(target.dictionary).markerSize) + 2
    refined = refine_tags(image, modules, corners[None])
    fitted = refined.sigma_px < _DETECTED_SIGMA_PX
    weights = None if fitted.all() else np.where(fitted, 1.0, DETECTED_WEIGHT)
    return DetectedCorners(np.arange(4), np.where(fitted[:, None], refined.px, corners), weights)


def marker_ids(image: Image, dictionary: str) -> tuple[int, ...]:
    """Ids of a dictionary's markers in a (h, w) grey image, each once."""
    return tuple(dict.fromkeys(_markers(image, dictionary)[0]))


def _markers(image: Image, dictionary: str) -> tuple[list[int], FloatArray]:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return read_markers(image, dictionary, parameters)
