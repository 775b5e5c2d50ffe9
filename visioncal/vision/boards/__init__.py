"""Kinds of targets: one class in one file for each, and their detection in images."""

from collections.abc import Mapping

import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.aprilgrid import AprilGrid
from visioncal.vision.boards.charuco import Charuco
from visioncal.vision.boards.checkerboard import Checkerboard
from visioncal.vision.boards.circles import CircleGrid
from visioncal.vision.boards.dots import Dots
from visioncal.vision.boards.gridboard import GridBoard
from visioncal.vision.boards.imaging import blur_at_corners
from visioncal.vision.boards.kind import BoardKind, DetectedCorners, NotFound
from visioncal.vision.boards.marker import MarkerKind
from visioncal.vision.boards.picture import Picture
from visioncal.vision.boards.points import Rig

KINDS: Mapping[str, BoardKind] = {
    kind.name: kind
    for kind in (
        *(Charuco(), Checkerboard(), AprilGrid(), GridBoard()),
        *(CircleGrid(), MarkerKind(), Rig(), Dots(), Picture()),
    )
}


def kind_of(target: Target) -> BoardKind:
    """The kind of a target."""
    return KINDS[target.kind]


def find_target(image: Image, target: Target) -> DetectedCorners | NotFound:
    """A target's corners in a (h, w) grey image, to sub-pixel accuracy, or why there are none."""
    return kind_of(target).find(image, target)


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
    blur_px = float(kind_of(target).refine(image, target, ids, px).blur_px.max())
    return blur_px if np.isfinite(blur_px) else blur_at_corners(image, px)
