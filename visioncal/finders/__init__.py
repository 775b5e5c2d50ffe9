"""Finding a target's corners in an image: one module a kind of target."""

from visioncal.finders.board import find_board
from visioncal.finders.charuco import fitting_layouts
from visioncal.finders.marker import find_marker
from visioncal.finders.result import NotFound, Seen
from visioncal.types import Image, Target

__all__ = ["NotFound", "Seen", "find_target", "fitting_layouts"]


def find_target(image: Image, target: Target) -> Seen | NotFound:
    """Finds a target's corners to sub-pixel accuracy.

    Args:
        image: (h, w) grey image.
        target: What to look for.

    Returns:
        The corners, or why there are none.
    """
    match target.kind:
        case "charuco" | "checkerboard":
            return find_board(image, target)
        case "marker":
            return find_marker(image, target)
        case "points":
            return NotFound(
                f"target {target.name} is a rig of points, which no image is searched for: "
                "corners.csv has no rows of this view"
            )
