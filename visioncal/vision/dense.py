"""Corners of a board in a blurred image that the template refuses, by a fit to all its pixels.

The board's print is drawn by its own kind and registered to the image (`register`), through a lens
whose focal length, centre and radial distortion are free, as they are not known yet. A corner's own
position is that of a patch around it, half way to the next corner, so that corners are independent.

The start is the detector's corners where it has enough, a pose that is known otherwise, or else a
search for the grid in reduced copies, where even the markers of a ChArUco board are blurred to grey
squares.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.distance import pdist

from visioncal.core.types import Camera, FloatArray, Image, IntArray, Target
from visioncal.vision.boards import DetectedCorners, find_target, kind_of
from visioncal.vision.patches import places_of, started, usual_lens, usual_sigma
from visioncal.vision.printing.pattern import light_of
from visioncal.vision.register.fit import Registered, register
from visioncal.vision.register.image_model import Print, Seen, moved_px
from visioncal.vision.targets import corner_positions, extent_m

# Texels of a square or of the distance of corners, and white paper around the print [squares].
_TEXELS, _PAPER = 24, 0.5
# Side of a square that images are reduced to [px]: a blur of such a share leaves nothing finer.
_SQUARE_PX = 16.0
# Least share of the variance that a board explains, as another one's markers or rim differ, and of
# its pixels that are free.
_EXPLAINED, _SHOWN = 0.9, 0.3
# Searches for the grid: reduced side of the image, and sigma of the smoothing after it [px].
_SEARCHES = ((320, 0.0), (320, 1.5), (640, 0.0), (640, 2.0), (640, 3.0), (640, 6.0))


@dataclass(frozen=True, eq=False)
class DenseCorners:
    """Corners of one image, and what blurs it."""

    ids: IntArray  # (n,) corner ids, ascending.
    px: FloatArray  # (n, 2) positions [px].
    sigma_px: FloatArray  # (n,) standard deviation of a coordinate, from the residuals [px].
    width_px: float  # Edge width as a Gaussian's sigma, across the widest edges [px].
    motion_px: float  # Length of the motion during the exposure [px].
    motion_m: float  # The same at the board [m].


def find_densely(image: Image, target: Target) -> DenseCorners | None:
    """Corners of a flat board by all pixels of a (h, w) grey image.

    Returns:
        The corners; None where no start is found, or the board explains too little of the image.
    """
    drawn, points = drawn_print(target), corner_positions(target)
    for lens, pose in _starts(image, target):
        depth_m = float(drawn.middle_at(pose)[2])
        side_px = _TEXELS * drawn.texel_m * float(lens.matrix[:2].mean()) / depth_m
        factor = max(1, round(side_px / _SQUARE_PX))
        fits = [
            register(
                image, drawn, lens, Seen(pose), lens_sigma=usual_sigma(lens), moving=moving,
                factors=(2 * factor, factor), rough=True,
            )
            for moving in (False, True)
        ]  # fmt: skip
        # Six more unknowns explain some more of anything.
        left = [
            (1.0 - fit.explained) * (1.1 if fit.seen.twist.any() else 1.0)
            if fit is not None and fit.shown > _SHOWN
            else 1.0
            for fit in fits
        ]
        best = fits[int(np.argmin(left))]
        if best is not None and min(left) < 1.0 - _EXPLAINED:
            corners = _corners(best, target, drawn, points)
            if corners is not None:
                return corners
    return None


def _corners(
    found: Registered, target: Target, drawn: Print, points: FloatArray
) -> DenseCorners | None:
    ids, px, sigma_px = places_of(found, points, float(pdist(points).min()) / 2)
    if len(ids) < min(kind_of(target).fewest, len(points)):
        return None
    seen, level = found.seen, found.look.level
    motion_px = moved_px(level.camera, drawn, seen)
    width_px = np.sqrt(seen.gauss_px**2 + seen.disc_px**2 / 4 + motion_px**2 / 12)
    depth_m = drawn.middle_at(seen.cam_from_target)[2]
    motion_m = motion_px * depth_m / (level.camera.matrix[:2].mean() + seen.lens[0])
    return DenseCorners(ids, px, sigma_px, float(width_px), motion_px, float(motion_m))


def _starts(image: Image, target: Target) -> Iterator[tuple[Camera, FloatArray]]:
    """Possible lenses and poses (4, 4); the likeliest first."""
    points = corner_positions(target)
    for ids, px in _pixels(image, target):
        flat, _ = cv2.findHomography(points[ids, :2], px, cv2.LMEDS)
        if flat is not None and np.linalg.matrix_rank(points[ids] - points[ids].mean(axis=0)) == 2:
            yield started(np.asarray(flat, float), points[ids], px, usual_lens(image))


def _pixels(image: Image, target: Target) -> Iterator[tuple[IntArray, FloatArray]]:
    """Possible positions of corners, to a third of a square; the likeliest first."""
    seen = find_target(image, target)
    if isinstance(seen, DetectedCorners) and len(seen.ids) >= kind_of(target).fewest:
        yield seen.ids, seen.px
        return
    if not kind_of(target).is_dense:
        return
    places = corner_positions(target)
    ids, columns = np.arange(len(places)), len(np.unique(places[:, 0]))
    for side_px, sigma_px in _SEARCHES:
        factor = max(1, round(max(image.shape) / side_px))
        small = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
        if sigma_px:
            small = cv2.GaussianBlur(small, (0, 0), sigma_px)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, px = cv2.findChessboardCornersSB(small, (columns, len(ids) // columns), flags=flags)
        if found:
            px = factor * np.asarray(px, float).reshape(-1, 2) + (factor - 1) / 2
            # The grid looks alike when turned by half a turn.
            yield from ((ids, px), (ids, px[::-1]))


@lru_cache(maxsize=8)
def drawn_print(target: Target, texels: int = _TEXELS) -> Print:
    """A board's print with paper around it, of so many texels a square, or a picture's own."""
    picture = kind_of(target).picture(target)
    if picture is not None:
        return Print.of_picture(picture, target.square_m)
    low, high = extent_m(target)
    low, high = low - _PAPER * target.square_m, high + _PAPER * target.square_m
    texel_m = min(target.square_m, float(pdist(corner_positions(target)).min())) / texels
    size = np.ceil((high - low) / texel_m).astype(int).tolist()
    return Print(light_of(target, low, texel_m, (size[1], size[0])), texel_m, low)
