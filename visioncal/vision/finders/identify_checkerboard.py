"""Detection of a checkerboard of unknown size."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image
from visioncal.vision.finders.identify_plane import (
    BENDS,
    Plane,
    alternating,
    contrasts,
    distorted_plane,
    lens_of,
    robust_plane,
    typical_contrast,
)

# Image size of the search: OpenCV takes a second for ten million pixels, and needs squares of about
# ten.
_SEARCH_PIXELS = 1.5e6
_SEED = (3, 3)
_MOST = 100
# Distance from a corner at which its four squares are sampled [squares].
_REACH = 0.25
# Likewise beyond the last corners, where the image may show little white around the board.
_REACHES_OUT = (_REACH, 0.1, 0.05)
# Share of alternating corners at which a further line belongs to the board.
_MOST_OF = 0.8
# Share of corners in the image that is needed to decide whether the board continues.
_ENOUGH = 0.5
_OUTWARD = {"left": (-1.0, 0.0), "top": (0.0, -1.0), "right": (1.0, 0.0), "bottom": (0.0, 1.0)}
# Sample positions in a square where a marker would be, from its centre [squares].
_INSIDE = np.stack(np.meshgrid(*2 * [np.linspace(-0.3, 0.3, 7)]), axis=-1).reshape(-1, 2)
# Excess scatter of light squares over dark ones, as a share of the contrast, that is not shading.
_TEXTURE = 0.1
# Tolerance of a board's corners [squares].
_OFF = 0.15
_ATTEMPTS = (0, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE)


@dataclass(frozen=True)
class Squares:
    """A checkerboard."""

    columns: int  # Number of inner corners along its longer side.
    rows: int  # Likewise along the other.
    cut: bool  # Whether it may continue outside the image.
    found: bool  # Whether the corner detector finds a board of exactly this size.
    filled: bool  # Whether the light squares are not plain, as with markers too blurred to read.
    square_px: float  # Approximate side of a square [px].


@dataclass(frozen=True)
class _Extent:
    """First and last lines of corners on the board, numbered as in the first grid, inclusive."""

    left: int
    top: int
    right: int
    bottom: int

    def corners(self) -> FloatArray:
        x, y = np.meshgrid(
            np.arange(self.left, self.right + 1), np.arange(self.top, self.bottom + 1)
        )
        return np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)

    @property
    def size(self) -> tuple[int, int]:
        return self.right - self.left + 1, self.bottom - self.top + 1


def find_squares(image: Image) -> Squares | None:
    """The largest checkerboard in a (h, w) grey image, with its inner corners counted, or None.

    The corner detector (Duda and Frese 2018, through OpenCV) may return a larger board than
    requested, but then often stops early or continues over the rim. Its grid is therefore only a
    start: lines of corners are removed and added by the colours around them, and the result is
    preferably confirmed by an exact search.
    """
    scale = min(1.0, float(np.sqrt(_SEARCH_PIXELS / image.size)))
    small = image
    if scale < 1.0:
        small = np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    best: Squares | None = None
    for flags in _ATTEMPTS:
        found, px, meta = cv2.findChessboardCornersSBWithMeta(
            small, _SEED, cv2.CALIB_CB_LARGER | flags
        )
        if not found:
            continue
        grid = np.asarray(px, dtype=float).reshape(*np.asarray(meta).shape[:2], 2)
        candidate = _counted(small, grid, scale)
        if candidate is not None and (best is None or _rank(candidate) > _rank(best)):
            best = candidate
        if best is not None and best.found:
            break
    return best


def _rank(squares: Squares) -> tuple[bool, int]:
    return squares.found, squares.columns * squares.rows


def _counted(image: Image, grid: FloatArray, scale: float) -> Squares | None:
    """Counts a board's corners, starting from a detected (rows, columns, 2) grid."""
    rows, columns = grid.shape[:2]
    extent = _Extent(0, 0, columns - 1, rows - 1)
    plane = _plane(image, extent.corners(), grid.reshape(-1, 2))
    if plane is None:
        return None
    corners = extent.corners()
    typical = typical_contrast(contrasts(image, plane, corners, _REACH), corners)
    if typical == 0.0:
        return None
    shrunk = _shrunk(image, plane, extent, typical)
    if shrunk is None:
        return None
    grown, cut = _grown(image, plane, shrunk)
    columns, rows = max(grown.size), min(grown.size)
    if rows < _SEED[1]:
        return None
    is_found = any(
        cv2.findChessboardCornersSB(image, (columns, rows), flags=flags)[0] for flags in _ATTEMPTS
    )
    filled = _filled(image, plane, shrunk, typical)
    return Squares(columns, rows, cut, is_found, filled, _side_px(plane, grown) / scale)


def _plane(image: Image, corners: FloatArray, px: FloatArray) -> Plane | None:
    """Fits the view of the board that has the most inliers."""
    tolerance_px = _OFF * float(np.median(np.linalg.norm(np.diff(px, axis=0), axis=1)))
    planes = [robust_plane(lens_of(image, bend), corners, px, tolerance_px) for bend in BENDS]
    candidates = [plane for plane in planes if plane is not None]
    if not candidates:
        return None
    plane, inliers = max(candidates, key=lambda pair: int(pair[1].sum()))
    return distorted_plane(plane, corners[inliers], px[inliers])


def _side_px(plane: Plane, extent: _Extent) -> float:
    px = plane.to_px(extent.corners()).reshape(*extent.size[::-1], 2)
    sides = [np.linalg.norm(np.diff(px, axis=axis), axis=2).ravel() for axis in (0, 1)]
    return float(np.median(np.concatenate(sides)))


def _outermost(extent: _Extent, side: str) -> _Extent:
    """The line of corners on one side."""
    opposite = {"left": "right", "right": "left", "top": "bottom", "bottom": "top"}[side]
    return replace(extent, **{opposite: getattr(extent, side)})


def _moved(extent: _Extent, side: str, outward: int) -> _Extent:
    step = outward if side in ("right", "bottom") else -outward
    return replace(extent, **{side: getattr(extent, side) + step})


def _share_alternating(image: Image, plane: Plane, corners: FloatArray, typical: float) -> float:
    values = contrasts(image, plane, corners, _REACH)
    return float(alternating(values, corners, typical).mean())


def _alternate_as(
    image: Image, plane: Plane, extent: _Extent, corners: FloatArray, reach: float
) -> bool:
    """Whether enough corners alternate as those of the board do at the same distance."""
    inner = extent.corners()
    typical = typical_contrast(contrasts(image, plane, inner, reach), inner)
    values = contrasts(image, plane, corners, reach)
    return bool(alternating(values, corners, typical).mean() >= _MOST_OF)


def _shrunk(image: Image, plane: Plane, extent: _Extent, typical: float) -> _Extent | None:
    """Removes outer lines that do not alternate, the worst first."""
    while min(extent.size) >= _SEED[0]:
        shares = {
            side: _share_alternating(image, plane, _outermost(extent, side).corners(), typical)
            for side in _OUTWARD
        }
        worst = min(shares, key=shares.__getitem__)
        if shares[worst] >= _MOST_OF:
            return extent
        extent = _moved(extent, worst, -1)
    return None


def _grown(image: Image, plane: Plane, extent: _Extent) -> tuple[_Extent, bool]:
    """Adds further lines that alternate, and says whether the image cuts off one of them."""
    cut = False
    sides = list(_OUTWARD)
    while sides and max(extent.size) < _MOST:
        side = sides[0]
        wider = _moved(extent, side, 1)
        corners = _outermost(wider, side).corners()
        for reach in _REACHES_OUT:
            seen = plane.shows(image, corners + reach * np.array(_OUTWARD[side]))
            enough = seen.mean() >= _ENOUGH
            if enough:
                break
        goes_on = enough and _alternate_as(image, plane, extent, corners[seen], reach)
        if goes_on and seen.all():
            extent = wider
            continue
        cut = cut or goes_on or not enough
        sides.pop(0)
    return extent, cut


def _filled(image: Image, plane: Plane, extent: _Extent, typical: float) -> bool:
    """Whether grey levels scatter more within light squares than within dark ones."""
    inner = replace(extent, right=extent.right - 1, bottom=extent.bottom - 1)
    squares = inner.corners()
    scatter = plane.levels(image, squares[:, None] + 0.5 + _INSIDE).std(axis=1)
    # The square below and right of an even corner has the brightness given by the sign of
    # `typical`.
    even = squares.sum(axis=1) % 2 == 0
    light = even if typical > 0 else ~even
    excess = np.median(scatter[light]) - np.median(scatter[~light])
    return bool(excess > _TEXTURE * abs(typical))
