"""How large a ChArUco board's markers are, against its squares."""

from itertools import product

import numpy as np

from visioncal.core.types import FloatArray, Image
from visioncal.vision.finders.identify_plane import Plane

# Where the edge of a marker is crossed, along its side, in half sides.
_ALONG = np.linspace(-0.7, 0.7, 9)
_SAMPLES = 60
# One marker has no scatter.
_LEAST_MARKERS = 2
# Over-exposure and ink move a marker's two outlines by so much together [px].
_BLOOM_PX = 0.5
# Photographs of boards whose sizes are known were off by 2 % of the share on average and by 6 % at
# most, in lens and paper that the plane does not describe.
_RELATIVE_SIGMA = 0.03
# A crossing between levels that differ less is noise [grey levels].
_LEAST_STEP = 20.0


def marker_share(
    image: Image, plane: Plane, squares: FloatArray, modules: int, guess: float
) -> tuple[float, float]:
    """Measures a marker's side over a square's.

    A marker's outline is where the grey between its dark border and the white around it passes
    the middle, which blur does not move; corners that are refined in the image are moved inwards.

    Args:
        image: (h, w) grey image.
        plane: How the board lies.
        squares: (n, 2) squares that hold a marker.
        modules: Modules along a marker's side, its border included.
        guess: The share, to a tenth.

    Returns:
        The share and its standard deviation, from the scatter between markers, from what bright
        light and ink take off or add, and from what other photographs were off by; the guess and a
        tenth of it where fewer than two markers show their outline.
    """
    shares = [_share(image, plane, square + 0.5, modules, guess) for square in squares]
    known = np.array([it for it in shares if it > 0.0])
    if len(known) < _LEAST_MARKERS:
        return guess, 0.1 * guess
    middle = float(np.median(known))
    # The median of n values scatters 1.25 times as much as their mean; 1.48 makes the median
    # deviation a standard deviation.
    sigma = 1.25 * 1.48 * float(np.median(np.abs(known - middle))) / np.sqrt(len(known))
    diagonals_px = np.linalg.norm(plane.to_px(squares + 1.0) - plane.to_px(squares), axis=1)
    square_px = float(np.median(diagonals_px)) / np.sqrt(2)
    bloom = _BLOOM_PX / square_px
    return middle, float(np.linalg.norm([sigma, bloom, _RELATIVE_SIGMA * middle]))


def _share(image: Image, plane: Plane, centre: FloatArray, modules: int, guess: float) -> float:
    """The share by one marker; 0 where its outline is not seen on all sides."""
    # From the middle of its dark border to the middle of the white around it.
    inner, outer = 0.5 * guess * (1 - 1 / modules), (0.5 + 0.5 * guess) / 2
    away = np.linspace(inner, outer, _SAMPLES)
    along = 0.5 * guess * _ALONG
    halves = []
    for axis, sign in product((0, 1), (-1.0, 1.0)):
        places = np.empty((len(along), _SAMPLES, 2))
        places[..., axis] = centre[axis] + sign * away
        places[..., 1 - axis] = centre[1 - axis] + along[:, None]
        halves.append(_crossing(away, plane.levels(image, places).mean(axis=0)))
    return 0.5 * sum(halves) if min(halves) > 0.0 else 0.0


def _crossing(away: FloatArray, levels: FloatArray) -> float:
    """Where a profile passes the middle between its darkest and its lightest; 0 where nowhere."""
    dark, light = float(levels.min()), float(levels.max())
    above = levels > (dark + light) / 2
    first = int(np.argmax(above))
    if light - dark < _LEAST_STEP or first == 0:
        return 0.0
    before, after = levels[first - 1], levels[first]
    share = ((dark + light) / 2 - before) / (after - before)
    return float(away[first - 1] + share * (away[first] - away[first - 1]))
