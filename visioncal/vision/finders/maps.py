"""Maps from pixels to a board about each of its corners, which those around it determine."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from scipy.spatial import cKDTree

from visioncal.core.types import FloatArray, IntArray, Mask

# Corners around a corner that shape its map, and how far away they count half [squares].
_AROUND, _NEAR = 25, 1.5
# Held by so much to a plain homography, a map stays determined where corners are few.
_RIDGE = np.diag([1e-6, 1e-4, 1e-4, *[1e-2] * 7])
# Radial distortion has two coefficients and an axis near the image's middle, of about so much. So
# many corners determine it in so many steps, or until the squares change by less than a share of
# them, and no place is drawn further from the axis than by the inverse of the last.
_RADIAL_SIGMAS = np.array([0.5, 0.5, 0.1, 0.1])
_RADIAL_CORNERS, _RADIAL_STEPS, _RADIAL_STEADY, _LEAST_RADIAL = 8, 6, 0.01, 0.1


@dataclass(frozen=True, eq=False)
class OpticalAxis:
    """About what a lens distorts radially.

    Attributes:
        px: (2,) the middle of the image, near which it is [px].
        reach_px: How far the image reaches from there [px].
    """

    px: FloatArray
    reach_px: float

    @classmethod
    def of(cls, shape: tuple[int, ...], origin: FloatArray | IntArray) -> Self:
        """That of an image of so many rows and columns, a part of which begins at `origin`."""
        middle = (np.array(shape[::-1]) - 1) / 2
        return cls(middle - origin, float(np.linalg.norm(middle)))


def maps_about(
    board: FloatArray, px: FloatArray, good: Mask, chosen: IntArray, axis: OpticalAxis | None = None
) -> tuple[Callable[[FloatArray], FloatArray], IntArray, FloatArray]:
    """The maps about the chosen m corners: a homography of all, and a cubic polynomial on top.

    Args:
        board: (n, 2) the corners on the board [squares].
        px: (n, 2) where they are, to a part of a pixel [px].
        good: (n,) those that make the maps.
        chosen: (m,) those about which they are made.
        axis: The lens's, whose radial distortion is taken off before the homography; None leaves it
            to the polynomials.

    Returns:
        What maps pixels (m, k, 2) to the board, from each corner; the (m, k) corners around each;
        and what makes polynomials of values there, (m, 10, k).

    Raises:
        numpy.linalg.LinAlgError: The corners lie as no board's do.
    """
    undistorted = None if axis is None else _undistorted(px[good], board[good], axis)
    flat = undistorted or _homography(px, board)
    own = flat(px[chosen])[:, None]
    distances, around = cKDTree(board).query(board[chosen], min(_AROUND, len(px)))
    off = flat(px)[around] - own
    terms = _terms(off)
    weighed = terms * (good[around] / (1.0 + (distances / _NEAR) ** 2))[..., None]
    weighed = weighed.transpose(0, 2, 1)
    smoother = np.linalg.solve(weighed @ terms + _RIDGE, weighed)
    bends = smoother @ (board[around] - board[chosen, None] - off)
    # The corner itself is where its map is zero.
    bends[:, 0] = 0.0

    def on_board(places: FloatArray) -> FloatArray:
        off = flat(places) - own
        return np.asarray(off + _terms(off) @ bends)

    return on_board, around, smoother


def _homography(places: FloatArray, board: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Maps places to a board (n, 2) as a pinhole's image of it is; for numbers about one."""
    middle, scale = places.mean(axis=0), float(np.abs(places - places.mean(axis=0)).max())
    found = cv2.findHomography((places - middle) / scale, board)[0]
    if found is None:
        raise np.linalg.LinAlgError
    flat_from_places = np.asarray(found, float)
    return lambda at: _mapped(flat_from_places, (at - middle) / scale)


def _undistorted(
    px: FloatArray, board: FloatArray, axis: OpticalAxis
) -> Callable[[FloatArray], FloatArray] | None:
    """Likewise, the radial distortion of a lens taken off; None where it is not determined.

    A place o from the axis, of length r, goes to o / (1 + a r^2 + b r^4) (Fitzgibbon 2001). Each
    Gauss-Newton step of a, b and the axis is followed by the homography's own least squares.
    """
    if len(px) < _RADIAL_CORNERS:
        return None

    def straight(at: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        off = (at - axis.px) / axis.reach_px - lens[2:]
        powers = np.sum(off**2, axis=-1, keepdims=True) ** [1, 2]
        shrink = 1.0 + powers @ lens[:2, None]
        return off / shrink, powers, shrink

    lens, cost, least, best = np.zeros(4), np.inf, np.inf, None
    for _ in range(_RADIAL_STEPS):
        flat, powers, shrink = straight(px, lens)
        if not np.all(shrink > _LEAST_RADIAL):
            break
        homography = np.asarray(cv2.findHomography(flat, board)[0], float)
        if homography.shape != (3, 3):
            break
        seen = _mapped(homography, flat)
        rest = board - seen
        before, cost = cost, float(np.sum(rest**2))
        if cost < least:
            least, best = cost, (lens, homography)
        if abs(before - cost) < _RADIAL_STEADY * before:
            break
        ahead = (flat @ homography[2, :2] + homography[2, 2])[:, None]
        ones = np.column_stack([flat, np.ones(len(flat))]) / ahead
        by_flat = (homography[:2, :2] - seen[..., None] * homography[2, :2]) / ahead[..., None]
        outward = 2.0 * (lens[0] + 2.0 * lens[1] * powers[:, :1]) * flat
        by_axis = flat[..., None] * outward[:, None] - np.eye(2) / shrink[..., None]
        jacobian = np.zeros((len(px), 2, 12))
        jacobian[:, 0, :3] = jacobian[:, 1, 3:6] = ones
        jacobian[:, :, 6:8] = -seen[..., None] * ones[:, None, :2]
        jacobian[:, :, 8:10] = by_flat @ flat[..., None] * (-powers / shrink)[:, None]
        jacobian[:, :, 10:] = by_flat @ by_axis
        held = np.sqrt(np.mean(rest**2)) / _RADIAL_SIGMAS[:, None] * np.eye(4, 12, 8)
        system = np.concatenate([jacobian.reshape(-1, 12), held])
        wanted = np.concatenate([rest.ravel(), -held[:, 8:] @ lens])
        lens = lens + np.linalg.lstsq(system, wanted)[0][8:]
    return None if best is None else lambda at: _mapped(best[1], straight(at, best[0])[0])


def _mapped(homography: FloatArray, places: FloatArray) -> FloatArray:
    """Maps (..., 2) places by a (3, 3) homography."""
    ahead = places @ homography[2, :2] + homography[2, 2]
    return np.asarray((places @ homography[:2, :2].T + homography[:2, 2]) / ahead[..., None])


def _terms(at: FloatArray) -> FloatArray:
    """(..., 10) powers and products of (..., 2) places, up to the third order."""
    x, y = at[..., 0], at[..., 1]
    ones, xx, xy, yy = np.ones_like(x), x * x, x * y, y * y
    return np.stack([ones, x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y], axis=-1)


def map_of_all(board: FloatArray, places: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """One map from places to the whole board: a homography and a cubic polynomial on top.

    Args:
        board: (n, 2) corners on the board [squares].
        places: (n, 2) where they are, by any two coordinates of a plane.

    Returns:
        What maps places (..., 2) to the board.

    Raises:
        numpy.linalg.LinAlgError: The corners lie as no board's do.
    """
    flattened = _homography(places, board)
    centre, size = board.mean(axis=0), float(np.abs(board - board.mean(axis=0)).max())

    def flat(at: FloatArray) -> FloatArray:
        return np.asarray((flattened(at) - centre) / size)

    off = (board - centre) / size - flat(places)
    terms = _terms(flat(places))
    ridge = len(board) * _RIDGE
    bends = np.linalg.solve(terms.T @ terms + ridge, terms.T @ off)

    def on_board(at: FloatArray) -> FloatArray:
        near = flat(at)
        return np.asarray(centre + size * (near + _terms(near) @ bends))

    return on_board
