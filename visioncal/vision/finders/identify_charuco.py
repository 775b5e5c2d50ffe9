"""Identification of a ChArUco board from the ids, positions and sizes of its markers.

The ids of a ChArUco board count its white squares row by row. The number of columns and the colour
of the first square therefore predict the position of each id, whatever the number of rows. A
hypothesis is right if a homography maps these positions to the image, and maps the markers back to
squares of one size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Mask
from visioncal.vision.finders.identify_markers import Marker, modules_along
from visioncal.vision.finders.identify_plane import (
    BENDS,
    Lens,
    Plane,
    alternating,
    contrasts,
    distorted_plane,
    lens_of,
    robust_plane,
    typical_contrast,
)

# Largest number of columns tried; printable boards have fewer.
_MOST_COLUMNS = 40
_LEAST_COLUMNS = 3
_MOST_ROWS = 100
# Share of markers at which no further lens is tried.
_NEARLY_ALL = 0.95
# Misfit ratio of boards that fit about as well as the best one, and their largest number.
_SAME_MISFIT, _MOST_TIED = 1.2, 4
# A homography takes four points; the markers' squareness is a check.
LEAST_MARKERS = 4
# Largest distance of a marker's corners from their prediction [squares]. Lens distortion stays
# under 0.05; a wrong column moves them by a whole square.
_MISFIT = 0.12
_SHARES = (0.25, 0.98)
# Corners of a marker around its centre.
_AROUND = 0.5 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
# Share of corners along a line between two rows that accepts or rejects it.
_HALF = 0.5
# Positions along a marker's side where its edge is sampled, in half sides.
_ALONG = np.linspace(-0.7, 0.7, 9)
_SAMPLES = 60
# Minimum number of markers for a scatter.
_LEAST_MARKERS = 2
# Sum of the shifts of a marker's two outlines by over-exposure and ink [px].
_BLOOM_PX = 0.5
# On photographs of known boards the share's error was 2 % on average and 6 % at most, due to lens
# and paper that the plane does not model.
_RELATIVE_SIGMA = 0.03
# Smallest step of an edge above noise [grey levels].
_LEAST_STEP = 20.0


@dataclass(frozen=True, eq=False)
class Lattice:
    """Layout of a board's markers."""

    columns: int  # Number of squares along x.
    rows: int  # Number of squares along y; possibly more unless `rows_certain`.
    rows_certain: bool  # Whether the board's end is visible.
    legacy: bool  # Whether square 0 holds a marker.
    share: float  # Marker side over square side.
    share_sigma: float  # Its standard deviation.
    markers: tuple[Marker, ...]  # Markers that fit.


@dataclass(frozen=True, eq=False)
class _Fit:
    columns: int
    legacy: bool
    plane: Plane
    share: float
    fits: Mask
    misfit: float

    @property
    def score(self) -> tuple[int, float]:
        return int(self.fits.sum()), -self.misfit


def find_lattices(image: Image, markers: Sequence[Marker]) -> tuple[Lattice, ...]:
    """Identifies a board from markers of one family.

    Args:
        image: (h, w) grey image.
        markers: Markers of one family, possibly with false positives.

    Returns:
        The boards that fit the most markers: several if too few rows are visible to determine the
        number of columns, none if the markers do not form a ChArUco board.
    """
    fits: list[_Fit] = []
    for bend in BENDS:
        lens = lens_of(image, bend)
        for columns in range(_LEAST_COLUMNS, _MOST_COLUMNS + 1):
            for legacy in (False, True):
                fit = _fit(lens, columns, legacy, markers)
                if fit is not None:
                    fits.append(fit)
        if any(fit.fits.mean() > _NEARLY_ALL for fit in fits):
            break
    # At most half of the markers may be false positives.
    least = max(LEAST_MARKERS, len(markers) / 2)
    best = max(fits, key=lambda value: value.score, default=None)
    if best is None or best.score[0] < least:
        return ()
    # With the same markers at the same positions, misfits differ by noise only.
    tied = [
        fit
        for fit in fits
        if fit.score[0] == best.score[0] and fit.misfit < _SAME_MISFIT * best.misfit
    ]
    first = {(fit.columns, fit.legacy): fit for fit in sorted(tied, key=lambda value: value.misfit)}
    return tuple(_lattice(image, markers, fit) for fit in list(first.values())[:_MOST_TIED])


def _lattice(image: Image, markers: Sequence[Marker], fit: _Fit) -> Lattice:
    fitting = tuple(marker for marker, fits in zip(markers, fit.fits, strict=True) if fits)
    squares = _places(np.array([marker.number for marker in fitting]), fit.columns, fit.legacy)
    on_board = (squares + 0.5)[:, None] + fit.share * _AROUND
    in_image = np.concatenate([marker.px for marker in fitting])
    fit = replace(fit, plane=distorted_plane(fit.plane, on_board.reshape(-1, 2), in_image))
    rows, certain = _rows(image, fit, int(squares[:, 1].max()) + 1)
    modules = modules_along(fitting[0].family)
    share, sigma = marker_share(image, fit.plane, squares, modules, fit.share)
    return Lattice(fit.columns, rows, certain, fit.legacy, share, sigma, fitting)


def _places(ids: IntArray, columns: int, legacy: bool) -> FloatArray:
    """Squares (x, y) of the markers with these ids, (n, 2)."""
    # Two rows together have one marker per column, the first row the smaller half unless legacy.
    first = (columns + legacy) // 2
    pair, within = np.divmod(ids, columns)
    lower = within >= first
    place = np.where(lower, within - first, within)
    # In the upper row of a pair the markers are in the odd columns, or the even ones if legacy.
    start = np.where(lower == legacy, 1, 0)
    return np.stack([2 * place + start, 2 * pair + lower], axis=1).astype(float)


def _fit(lens: Lens, columns: int, legacy: bool, markers: Sequence[Marker]) -> _Fit | None:
    """Fits one hypothesis; None if the markers cannot be on such a board."""
    places = _places(np.array([marker.number for marker in markers]), columns, legacy)
    if np.ptp(places, axis=0).min() < 1:
        return None
    centres = np.array([marker.centre for marker in markers])
    # Half a marker's side away is another square, or a false positive.
    tolerance_px = 0.5 * float(np.median([marker.side_px for marker in markers]))
    robust = robust_plane(lens, places + 0.5, centres, tolerance_px)
    if robust is None or robust[1].sum() < LEAST_MARKERS:
        return None
    plane, inliers = robust
    plane = distorted_plane(plane, places[inliers] + 0.5, centres[inliers]) if lens.bend else plane
    corners = np.array([marker.px for marker in markers])
    offsets = plane.to_board(corners.reshape(-1, 2)).reshape(-1, 4, 2) - (places + 0.5)[:, None]
    # Projections onto an ideal marker's corners, whose squared norm is two.
    shares = (offsets * _AROUND).sum(axis=(1, 2)) / 2
    share = float(np.median(shares[inliers]))
    if not _SHARES[0] < share < _SHARES[1]:
        return None
    distances = np.sqrt(((offsets - share * _AROUND) ** 2).sum(axis=2).mean(axis=1))
    fits = distances < _MISFIT
    if fits.sum() < LEAST_MARKERS or np.ptp(places[fits], axis=0).min() < 1:
        return None
    return _Fit(columns, legacy, plane, share, fits, float(distances[fits].mean()))


def _rows(image: Image, fit: _Fit, least: int) -> tuple[int, bool]:
    """Counts rows beyond the decoded markers, and whether the board ends there.

    Below the last row the squares do not alternate; the line below it must be in the image.
    """
    reach = (1.0 - fit.share) / 4
    inner = _line(fit.columns, np.arange(1, least))
    typical = typical_contrast(contrasts(image, fit.plane, inner, reach), inner)
    rows, certain = least, False
    while rows < _MOST_ROWS:
        below = _line(fit.columns, np.array([rows]))
        below = below[fit.plane.shows(image, below + np.array([0.0, reach]))]
        if len(below) < _HALF * (fit.columns - 1):
            break
        seen = alternating(contrasts(image, fit.plane, below, reach), below, typical)
        if seen.mean() < _HALF:
            certain = True
            break
        rows += 1
    if fit.legacy and rows % 2:
        # A legacy board with an odd number of rows does not start with a marker.
        return rows + 1, False
    return rows, certain


def _line(columns: int, rows: IntArray) -> FloatArray:
    """Corners (n, 2) between the columns on the lines above the given rows."""
    x, y = np.meshgrid(np.arange(1, columns), rows)
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)


def marker_share(
    image: Image, plane: Plane, squares: FloatArray, modules: int, guess: float
) -> tuple[float, float]:
    """Measures a marker's side over a square's.

    A marker's outline is where the grey level between its dark border and the white around it is
    the mean of both, which blur does not shift; corners refined in the image are biased inwards.

    Args:
        image: (h, w) grey image.
        plane: Pose of the board.
        squares: (n, 2) squares with a marker.
        modules: Modules along a marker's side, including its border.
        guess: Approximate share, to a tenth.

    Returns:
        The share and its standard deviation, from the scatter between markers, over-exposure and
        ink, and the errors on other photographs; the guess and a tenth of it if fewer than two
        markers show their outline.
    """
    shares = [_share(image, plane, square + 0.5, modules, guess) for square in squares]
    valid = np.array([share for share in shares if share > 0.0])
    if len(valid) < _LEAST_MARKERS:
        return guess, 0.1 * guess
    median = float(np.median(valid))
    # The median of n values has 1.25 times the standard deviation of their mean; 1.48 converts the
    # median absolute deviation to a standard deviation.
    sigma = 1.25 * 1.48 * float(np.median(np.abs(valid - median))) / np.sqrt(len(valid))
    diagonals_px = np.linalg.norm(plane.to_px(squares + 1.0) - plane.to_px(squares), axis=1)
    square_px = float(np.median(diagonals_px)) / np.sqrt(2)
    bloom = _BLOOM_PX / square_px
    return median, float(np.linalg.norm([sigma, bloom, _RELATIVE_SIGMA * median]))


def _share(image: Image, plane: Plane, centre: FloatArray, modules: int, guess: float) -> float:
    """The share by one marker; 0 if its outline is not visible on all sides."""
    # From the centre of its dark border to the centre of the white around it.
    inner, outer = 0.5 * guess * (1 - 1 / modules), (0.5 + 0.5 * guess) / 2
    distances = np.linspace(inner, outer, _SAMPLES)
    along = 0.5 * guess * _ALONG
    halves = []
    for axis, sign in product((0, 1), (-1.0, 1.0)):
        places = np.empty((len(along), _SAMPLES, 2))
        places[..., axis] = centre[axis] + sign * distances
        places[..., 1 - axis] = centre[1 - axis] + along[:, None]
        halves.append(_crossing(distances, plane.levels(image, places).mean(axis=0)))
    return 0.5 * sum(halves) if min(halves) > 0.0 else 0.0


def _crossing(distances: FloatArray, levels: FloatArray) -> float:
    """Position where a profile crosses the mean of its darkest and lightest level; 0 if nowhere."""
    dark, light = float(levels.min()), float(levels.max())
    above = levels > (dark + light) / 2
    first = int(np.argmax(above))
    if light - dark < _LEAST_STEP or first == 0:
        return 0.0
    before, after = levels[first - 1], levels[first]
    share = ((dark + light) / 2 - before) / (after - before)
    return float(distances[first - 1] + share * (distances[first] - distances[first - 1]))
