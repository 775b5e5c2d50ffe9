"""Detection of tags whose corners are known points."""

from collections.abc import Mapping

import numpy as np

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.finders.layout import LAYOUT_MISFIT, layout_misfit, read_markers
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.finders.template import refine_tags
from visioncal.vision.targets import aruco_dictionary, corner_positions, tag_corners

# Minimum number of complete tags in one plane for a check of the layout.
_LEAST_TAGS = 2


def find_tags(image: Image, target: Target) -> DetectedCorners | NotFound:
    """Corners of a rig's tags in a (h, w) grey image, or why there are none."""
    if min(image.shape) < 2:
        return NotFound("the image is a line")
    numbers, found_px = read_markers(image, target.dictionary)
    corner_ids = tag_corners(target)
    quads = {
        number: px
        for number, px in zip(numbers, found_px, strict=True)
        if number in corner_ids and numbers.count(number) == 1
    }
    if not quads:
        seen = f"; seen instead: {', '.join(map(str, numbers[:5]))}" if numbers else ""
        return NotFound(
            f"no tag of the target's, of {target.dictionary}, is seen{seen}", misfit=bool(numbers)
        )
    places = _in_plane(target, quads)
    if places is not None:
        side = float(np.linalg.norm(places[:, 1] - places[:, 0], axis=1).mean())
        if layout_misfit(places / side, np.array(list(quads.values()))) > LAYOUT_MISFIT:
            return NotFound("the tags do not lie as the target describes them", misfit=True)
    modules = int(aruco_dictionary(target.dictionary).markerSize) + 2
    if places is None:
        parts = [refine_tags(image, modules, quad[None]) for quad in quads.values()]
    else:
        parts = [refine_tags(image, modules, np.array(list(quads.values())), places)]
    points = np.concatenate([corner_ids[quad] for quad in quads])
    fitted = np.array([not reason for part in parts for reason in part.reasons]) & (points >= 0)
    if not fitted.any():
        return NotFound("no corner of the tags seen is like the print")
    px = np.concatenate([part.px for part in parts])[fitted]
    order = np.argsort(points[fitted])
    blur_px = float(np.nanmedian([part.blur_px.max() for part in parts]))
    return DetectedCorners(points[fitted][order], px[order], blur_px=blur_px)


def _in_plane(target: Target, quads: Mapping[int, FloatArray]) -> FloatArray | None:
    """(t, 4, 2) positions of at least two complete tags in the plane z = 0 [m]; else None."""
    known = tag_corners(target)
    numbers = np.array([known[quad] for quad in quads])
    places = corner_positions(target)
    if len(quads) < _LEAST_TAGS or (numbers < 0).any() or np.ptp(places[:, 2]) > 0.0:
        return None
    return np.asarray(places[numbers, :2])
