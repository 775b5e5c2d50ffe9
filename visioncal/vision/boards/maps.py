"""Maps from pixels to the board around each corner, determined by its neighbours."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self

import cv2
import numpy as np
from scipy.spatial import cKDTree

from visioncal.core.types import FloatArray, IntArray, Mask

# Ridge towards a plain homography, which keeps a map determined with few corners.
_RIDGE = np.diag([1e-6, 1e-4, 1e-4, *[1e-2] * 7])
# Prior sigmas of radial distortion: two coefficients, and the axis relative to the image's centre.
_RADIAL_SIGMAS = np.array([0.5, 0.5, 0.1, 0.1])


@dataclass(frozen=True, eq=False)
class OpticalAxis:
    """Approximate axis of a lens's radial distortion."""

    px: FloatArray  # (2,) centre of the image, near which it is [px].
    reach_px: float  # Half the image's diagonal [px].
    # (4,) distortion from which the search begins: coefficients, and the axis less `px` [reach].
    lens: FloatArray = field(default_factory=lambda: np.zeros(4))

    @classmethod
    def of(cls, shape: tuple[int, ...], origin: FloatArray | IntArray) -> Self:
        """Axis for an image of this shape, relative to a part of it that starts at `origin`."""
        middle = (np.array(shape[::-1]) - 1) / 2
        return cls(middle - origin, float(np.linalg.norm(middle)))


def maps_about(
    board: FloatArray, px: FloatArray, good: Mask, chosen: IntArray, axis: OpticalAxis | None = None
) -> tuple[Callable[[FloatArray], FloatArray], IntArray, FloatArray, OpticalAxis | None]:
    """Maps around m chosen corners: a common homography, and a cubic polynomial for each.

    Args:
        board: (n, 2) corners on the board [squares].
        px: (n, 2) their positions in the image [px].
        good: (n,) mask of the corners that determine the maps.
        chosen: (m,) indices of the corners to map.
        axis: Axis of the lens, whose radial distortion is removed before the homography; None
            leaves it to the polynomials.

    Returns:
        Function that maps pixels (m, k, 2) to the board relative to each corner; (m, k) neighbours
        of each corner; the linear operators (m, 10, k) from their values to polynomial
        coefficients; and the axis with the distortion that was found.

    Raises:
        numpy.linalg.LinAlgError: The corners do not form a board.
    """
    undistorted = None if axis is None else _undistorted(px[good], board[good], axis)
    flatten, axis = undistorted or (_homography(px, board), axis)
    origin = flatten(px[chosen])[:, None]
    distances, neighbours = cKDTree(board).query(board[chosen], min(25, len(px)))
    offsets = flatten(px)[neighbours] - origin
    terms = _terms(offsets)
    # Half weight at 1.5 squares.
    weighted = terms * (good[neighbours] / (1.0 + (distances / 1.5) ** 2))[..., None]
    weighted = weighted.transpose(0, 2, 1)
    smoother = np.linalg.solve(weighted @ terms + _RIDGE, weighted)
    coefficients = smoother @ (board[neighbours] - board[chosen, None] - offsets)
    # A map is zero at its own corner.
    coefficients[:, 0] = 0.0

    def on_board(places: FloatArray) -> FloatArray:
        offsets = flatten(places) - origin
        return np.asarray(offsets + _terms(offsets) @ coefficients)

    return on_board, neighbours, smoother, axis


def _homography(places: FloatArray, board: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Function that maps (n, 2) points to the board by a homography of normalised points."""
    centre, scale = places.mean(axis=0), float(np.abs(places - places.mean(axis=0)).max())
    homography = cv2.findHomography((places - centre) / scale, board)[0]
    if homography is None:
        raise np.linalg.LinAlgError
    flat_from_places = np.asarray(homography, float)
    return lambda at: _mapped(flat_from_places, (at - centre) / scale)


def _undistorted(
    px: FloatArray, board: FloatArray, axis: OpticalAxis
) -> tuple[Callable[[FloatArray], FloatArray], OpticalAxis] | None:
    """Homography after removal of radial distortion; None if that is not determined.

    A point o relative to the axis, at distance r, maps to o / (1 + a r^2 + b r^4) (Fitzgibbon
    2001). Each Gauss-Newton step of a, b and the axis is followed by a least-squares homography;
    the first begins at those that are given, and the axis is returned with what was found.
    """
    if len(px) < 8:
        return None

    def undistort(
        points: FloatArray, lens: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        offsets = (points - axis.px) / axis.reach_px - lens[2:]
        powers = np.sum(offsets**2, axis=-1, keepdims=True) ** [1, 2]
        divisor = 1.0 + powers @ lens[:2, None]
        return offsets / divisor, powers, divisor

    lens, cost, least, best = axis.lens, np.inf, np.inf, None
    for _ in range(6):
        flat, powers, divisor = undistort(px, lens)
        # The smallest divisor of the distortion model.
        if not np.all(divisor > 0.1):
            break
        homography = np.asarray(cv2.findHomography(flat, board)[0], float)
        if homography.shape != (3, 3):
            break
        predicted = _mapped(homography, flat)
        residuals = board - predicted
        previous, cost = cost, float(np.sum(residuals**2))
        if cost < least:
            least, best = cost, (lens, homography)
        if abs(previous - cost) < 0.01 * previous:
            break
        depth = (flat @ homography[2, :2] + homography[2, 2])[:, None]
        ones = np.column_stack([flat, np.ones(len(flat))]) / depth
        numerator = homography[:2, :2] - predicted[..., None] * homography[2, :2]
        jacobian_flat = numerator / depth[..., None]
        outward = 2.0 * (lens[0] + 2.0 * lens[1] * powers[:, :1]) * flat
        jacobian_axis = flat[..., None] * outward[:, None] - np.eye(2) / divisor[..., None]
        jacobian = np.zeros((len(px), 2, 12))
        jacobian[:, 0, :3] = jacobian[:, 1, 3:6] = ones
        jacobian[:, :, 6:8] = -predicted[..., None] * ones[:, None, :2]
        jacobian[:, :, 8:10] = jacobian_flat @ flat[..., None] * (-powers / divisor)[:, None]
        jacobian[:, :, 10:] = jacobian_flat @ jacobian_axis
        prior = np.sqrt(np.mean(residuals**2)) / _RADIAL_SIGMAS[:, None] * np.eye(4, 12, 8)
        system = np.concatenate([jacobian.reshape(-1, 12), prior])
        right_side = np.concatenate([residuals.ravel(), -prior[:, 8:] @ lens])
        lens = lens + np.linalg.lstsq(system, right_side)[0][8:]
    if best is None:
        return None
    lens, flat_from_places = best
    return lambda at: _mapped(flat_from_places, undistort(at, lens)[0]), replace(axis, lens=lens)


def _mapped(homography: FloatArray, places: FloatArray) -> FloatArray:
    """Maps (..., 2) points by a (3, 3) homography."""
    depth = places @ homography[2, :2] + homography[2, 2]
    return np.asarray((places @ homography[:2, :2].T + homography[:2, 2]) / depth[..., None])


def _terms(at: FloatArray) -> FloatArray:
    """(..., 10) monomials of (..., 2) coordinates up to the third order."""
    x, y = at[..., 0], at[..., 1]
    ones, xx, xy, yy = np.ones_like(x), x * x, x * y, y * y
    return np.stack([ones, x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y], axis=-1)
