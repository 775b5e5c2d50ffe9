"""Detection of a target's corners in an image: one module per kind of target."""

import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.finders.board import FINDERS, find_board
from visioncal.vision.finders.charuco import fitting_layouts
from visioncal.vision.finders.imaging import blur_at_corners
from visioncal.vision.finders.marker import find_marker
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.finders.tags import find_tags
from visioncal.vision.finders.template import refine

__all__ = ["DetectedCorners", "NotFound", "blur_of", "find_target", "fitting_layouts"]


def find_target(image: Image, target: Target, *, quick: bool = False) -> DetectedCorners | NotFound:
    """Detects a target's corners in a (h, w) grey image, to sub-pixel accuracy.

    Returns the corners, or why there are none. With `quick`, detection of a board stops if a first,
    quick search fails.
    """
    match target.kind:
        case "charuco" | "checkerboard" | "aprilgrid" | "circles":
            return find_board(image, target, quick=quick)
        case "marker":
            return find_marker(image, target)
        case "points" if target.point_tags:
            return find_tags(image, target)
        case "points":
            return NotFound(
                f"target {target.name} is a rig of points, which no image is searched for: "
                "corners.csv has no rows of this view"
            )


def blur_of(image: Image, target: Target, ids: IntArray, px: FloatArray) -> float:
    """Edge width at detected corners, in the same image or another one of them.

    Args:
        image: (h, w) grey image.
        target: Detected target.
        ids: (n,) corner ids, n >= 1.
        px: (n, 2) corners, to about a pixel [px].

    Returns:
        The width as a Gaussian's sigma; on a board, in the direction of the wider edges, as motion
        smears one direction only [px].
    """
    if target.kind in FINDERS:
        blur_px = float(refine(image, target, ids, px).blur_px.max())
        if np.isfinite(blur_px):
            return blur_px
    return blur_at_corners(image, px)
