"""Detection of boards, first by quick searches that suffice if they find the whole board."""

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
from visioncal.vision.finders.imaging import shrunk
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.finders.template import refine
from visioncal.vision.targets import corner_positions

_Finder: TypeAlias = Callable[[Image, Target], DetectedCorners | NotFound]

# Images with longer sides are searched at half size first, and above twice that at a quarter:
# detection time is proportional to pixels. A checkerboard has no markers that get lost.
_LONG_SIDE_PX: Mapping[TargetKind, int] = {
    "charuco": 2000,
    "checkerboard": 1000,
    "aprilgrid": 2000,
    "circles": 2000,
}
# Corners that the template does not fit are dropped, as detectors err there by up to a pixel. If
# fewer than these fit, all corners of the detector are used, with a tenth of the weight: their
# accuracy relative to the template's in the median.
_FEWEST_FITTED, _LEAST_FITTED, DETECTED_WEIGHT = 6, 0.5, 0.1

FINDERS: dict[TargetKind, _Finder] = {
    "charuco": find_charuco,
    "checkerboard": find_checkerboard,
    "aprilgrid": find_aprilgrid,
    "circles": find_circles,
}
# Searches that take a third of the time and detect less.
QUICK: dict[TargetKind, _Finder] = {
    "charuco": partial(find_charuco, quick=True),
    "checkerboard": partial(find_checkerboard, quick=True),
}


def find_board(image: Image, target: Target, *, quick: bool = False) -> DetectedCorners | NotFound:
    """Corners of a board in a (h, w) grey image, or why there are none.

    OpenCV detects them, by a quick search or in a reduced copy if that finds the whole board;
    `refine` then measures their positions. With `quick`, detection stops if the first search fails.
    """
    for find, factor in _quick_searches(image, target.kind):
        small = image if factor == 1 else shrunk(image, factor)
        seen = find(small, target)
        if isinstance(seen, DetectedCorners) and not len(hidden_corners(seen, small.shape, target)):
            # From pixel centres of the small image to those of the large one.
            px = factor * seen.px + (factor - 1) / 2
            refined = _refined(image, target, DetectedCorners(seen.ids, px))
            if refined.weights is None:
                return refined
        if quick and isinstance(seen, NotFound):
            return seen
    seen = FINDERS[target.kind](image, target)
    return seen if isinstance(seen, NotFound) else _refined(image, target, seen)


def _quick_searches(image: Image, kind: TargetKind) -> Iterator[tuple[_Finder, int]]:
    """Quick searches, each with the factor by which the image is reduced."""
    find = QUICK.get(kind, FINDERS[kind])
    for factor in (4, 2):
        if max(image.shape) > factor // 2 * _LONG_SIDE_PX[kind] and min(image.shape) >= factor:
            yield find, factor
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


def hidden_corners(
    seen: DetectedCorners | Corners, shape: tuple[int, ...], target: Target
) -> IntArray:
    """Ids (n,) of undetected corners that the image should contain with the squares around them.

    If the detected corners are too few to locate the board, these are all others.
    """
    places: FloatArray = corner_positions(target)[:, :2] / target.square_m
    missing = np.setdiff1d(np.arange(len(places)), seen.ids)
    if not len(missing):
        return missing
    homography = cv2.findHomography(places[seen.ids], seen.px)[0] if len(seen.ids) > 3 else None
    if homography is None:
        return missing
    # Detecting a corner requires both markers beside it.
    around = places[missing, None] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    depth = around @ homography[2, :2] + homography[2, 2]
    px = (around @ homography[:2, :2].T + homography[:2, 2]) / depth[..., None]
    inside = (depth > 0) & ((px > 0) & (px < np.array(shape[::-1]) - 1)).all(axis=-1)
    return np.asarray(missing[inside.all(axis=1)])
