"""Corners of a flat print in a blurred image that its detector refuses, by all pixels.

The print is drawn by its own kind and registered to the image (`register`): from a pose and a lens
that are known otherwise, or through a lens whose focal length, centre and radial distortion are
free, from the detector's corners where it has enough, or a search for the grid in reduced copies,
where even the markers of a ChArUco board are blurred to grey squares. A corner's own position is
that of a patch around it, half way to the next corner, so that corners are independent.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import cv2
import numpy as np
from scipy.spatial.distance import pdist

from visioncal.core.types import Camera, FloatArray, Image, IntArray, Target
from visioncal.vision.boards import DetectedCorners, find_target, kind_of
from visioncal.vision.boards.imaging import resized
from visioncal.vision.patches import places_of, started, usual_lens, usual_sigma
from visioncal.vision.printing.pattern import light_of
from visioncal.vision.register.fit import Registered, register
from visioncal.vision.register.image_model import Print, Seen, moved_px
from visioncal.vision.targets import corner_positions, extent_m

# Texels of a square or of the distance of corners, and white paper around the print [squares].
_TEXELS, _PAPER = 24, 0.5
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


def find_densely(
    image: Image, target: Target, known: tuple[Camera, FloatArray] | None = None
) -> DenseCorners | None:
    """Corners of a flat print by all pixels of a (h, w) grey image.

    Args:
        image: Grey levels.
        target: What it shows: no rig.
        known: The lens, and the (4, 4) pose to some millimetres, where these are known.

    Returns:
        The corners; None where no start is found, or the print explains too little of the image.
    """
    drawn, points = drawn_print(target), corner_positions(target)
    side_m = min(target.square_m, float(pdist(points).min()))
    # A lens that is known needs no columns of its own, as patches have their own shifts.
    first = [] if known is None else [(*known, None)]
    for lens, pose, lens_sigma in chain(first, _starts(image, target)):
        depth_m = float(drawn.middle_at(pose)[2])
        side_px = side_m * float(lens.matrix[:2].mean()) / depth_m
        # Side of a square that images are reduced to [px]: a blur of such a share leaves nothing
        # finer.
        factor = max(1, round(side_px / 16.0))
        # A few pixels of a pose that is known from elsewhere are few of the coarsest copy.
        factors = (4 * factor, 2 * factor, factor)[lens_sigma is not None :]
        fits = [
            register(
                image, drawn, lens, Seen(pose), moving=moving, factors=factors, rough=True,
                lens_sigma=lens_sigma,
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
            corners = _corners(best, target, drawn, points, side_m / 2)
            if corners is not None:
                return corners
    return None


def _corners(
    found: Registered, target: Target, drawn: Print, points: FloatArray, half_m: float
) -> DenseCorners | None:
    ids, px, sigma_px = places_of(found, points, half_m)
    if len(ids) < min(kind_of(target).fewest, len(points)):
        return None
    seen, level = found.seen, found.look.level
    motion_px = moved_px(level.camera, drawn, seen)
    width_px = np.hypot(seen.blur_px, motion_px / np.sqrt(12))
    depth_m = drawn.middle_at(seen.cam_from_target)[2]
    motion_m = motion_px * depth_m / (level.camera.matrix[:2].mean() + sum(seen.lens[:1]))
    return DenseCorners(ids, px, sigma_px, float(width_px), motion_px, float(motion_m))


def _starts(image: Image, target: Target) -> Iterator[tuple[Camera, FloatArray, FloatArray]]:
    """Possible lenses, poses (4, 4) and sigmas of the lenses; the likeliest first."""
    points = corner_positions(target)
    for ids, px in _pixels(image, target):
        flat, _ = cv2.findHomography(points[ids, :2], px, cv2.LMEDS)
        if flat is not None and np.linalg.matrix_rank(points[ids] - points[ids].mean(axis=0)) == 2:
            lens, pose = started(np.asarray(flat, float), points[ids], px, usual_lens(image))
            yield lens, pose, usual_sigma(lens)


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
        small = resized(image, 1 / factor)
        if sigma_px:
            small = np.asarray(cv2.GaussianBlur(small, (0, 0), sigma_px), np.uint8)
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
