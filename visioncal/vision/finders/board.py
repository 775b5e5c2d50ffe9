"""Finding a board by a quick search where that sees all of it, and its corners in the image."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np

from visioncal.core.types import Corners, FloatArray, Image, IntArray, Target, TargetKind
from visioncal.vision.finders.aprilgrid import find_aprilgrid
from visioncal.vision.finders.charuco import find_charuco
from visioncal.vision.finders.checkerboard import find_checkerboard
from visioncal.vision.finders.circles import find_circles
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.finders.template import refine
from visioncal.vision.targets import corner_positions

_Finder: TypeAlias = Callable[[Image, Target], DetectedCorners | NotFound]

# Images with longer sides are halved first, and at twice as much once more: detectors take as long
# as there are pixels. Smaller images lose markers and gain nothing; a checkerboard has none.
_LONG_SIDE_PX: Mapping[TargetKind, int] = {
    "charuco": 2000,
    "checkerboard": 1000,
    "aprilgrid": 2000,
    "circles": 2000,
}
# Corners that the template does not fit are left out: a detector is off there by up to a pixel. Of
# views where fewer than these fit, the detector's corners serve, all of them, with a tenth of the
# weight: so much less exact they are in the median of what was measured.
_FEWEST_FITTED, _LEAST_FITTED, DETECTED_WEIGHT = 6, 0.5, 0.1

FINDERS: dict[TargetKind, _Finder] = {
    "charuco": find_charuco,
    "checkerboard": find_checkerboard,
    "aprilgrid": find_aprilgrid,
    "circles": find_circles,
}
# Searches that take a third of the time and see less.
QUICK: dict[TargetKind, _Finder] = {
    "charuco": partial(find_charuco, quick=True),
    "checkerboard": partial(find_checkerboard, quick=True),
}


def find_board(image: Image, target: Target, *, quick: bool = False) -> DetectedCorners | NotFound:
    """Finds the corners of a board whose corners the template fits.

    OpenCV finds them, by a quick search or in a small copy where that sees the whole board; the
    template of `refine` says where they are.

    Args:
        image: (h, w) grey image.
        target: A target of one of the kinds of `FINDERS`.
        quick: Whether nothing more is searched where the first of these finds nothing.

    Returns:
        The corners, or why there are none.
    """
    for find, by in _quick_searches(image, target.kind):
        small = image if by == 1 else _shrunk(image, by)
        seen = find(small, target)
        if isinstance(seen, DetectedCorners) and not len(hidden_corners(seen, small.shape, target)):
            # Where a pixel of the small image has its centre in the large one.
            px = by * seen.px + (by - 1) / 2
            refined = _refined(image, target, DetectedCorners(seen.ids, px))
            if refined.weights is None:
                return refined
        if quick and isinstance(seen, NotFound):
            return seen
    seen = FINDERS[target.kind](image, target)
    return seen if isinstance(seen, NotFound) else _refined(image, target, seen)


def _quick_searches(image: Image, kind: TargetKind) -> Iterator[tuple[_Finder, int]]:
    """What to search with first, and how many times smaller a copy of the image."""
    find = QUICK.get(kind, FINDERS[kind])
    for by in (4, 2):
        if max(image.shape) > by // 2 * _LONG_SIDE_PX[kind] and min(image.shape) >= by:
            yield find, by
    if kind in QUICK:
        yield find, 1


def _refined(image: Image, target: Target, seen: DetectedCorners) -> DetectedCorners:
    refined = refine(image, target, seen.ids, seen.px)
    fitted = np.array([not reason for reason in refined.reasons])
    if fitted.sum() < max(min(_FEWEST_FITTED, len(fitted)), _LEAST_FITTED * len(fitted)):
        return replace(seen, weights=np.full(len(fitted), DETECTED_WEIGHT))
    return DetectedCorners(
        seen.ids[fitted], refined.px[fitted], blur_px=float(refined.blur_px.max())
    )


def _shrunk(image: Image, by: int) -> Image:
    height, width = (by * (side // by) for side in image.shape)
    size = (width // by, height // by)
    small = cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def hidden_corners(
    seen: DetectedCorners | Corners, shape: tuple[int, ...], target: Target
) -> IntArray:
    """Finds the corners that an image should show with the squares around them, and does not.

    Args:
        seen: Those that are found; where too few to say where the board lies, all others are taken.
        shape: Height and width of the image [px].
        target: A board of squares.

    Returns:
        (n,) their numbers, ascending.
    """
    places: FloatArray = corner_positions(target)[:, :2] / target.square_m
    missing = np.setdiff1d(np.arange(len(places)), seen.ids)
    if not len(missing):
        return missing
    homography = cv2.findHomography(places[seen.ids], seen.px)[0] if len(seen.ids) > 3 else None
    if homography is None:
        return missing
    # A corner takes both markers beside it.
    around = places[missing, None] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    ahead = around @ homography[2, :2] + homography[2, 2]
    px = (around @ homography[:2, :2].T + homography[:2, 2]) / ahead[..., None]
    inside = (ahead > 0) & ((px > 0) & (px < np.array(shape[::-1]) - 1)).all(axis=-1)
    return np.asarray(missing[inside.all(axis=1)])
