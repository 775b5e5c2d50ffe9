"""Probability that a pose error stays within tolerances of position, rotation, or both.

An error x = L z has the covariance L L^T. Written as x = r L w, w is a uniform direction on the
unit sphere, and r^2 is chi-square of d degrees of freedom, independent of it. x lies within a ball
of radius m, and its rotation part within another, where r^2 is below the smaller of the squared
ratios of radius to length of L w. So the probability is the mean over all w of the chi-square
distribution there (Deak 1980; Genz and Bretz 2009, chapter 4): one smooth integral over a sphere,
exact in r, also for correlated errors of position and rotation. It is evaluated at 4,096 evenly
distributed points of the sphere. For a covariance whose scale was estimated with n degrees of
freedom, r^2 / d is F of (d, n).
"""

import numpy as np
from scipy.optimize import brentq
from scipy.special import fdtr, ndtri

from visioncal.core.types import FloatArray

_POINTS, _SIZE = 4096, 6
# F equals chi-square beyond, and its series lose digits.
_MOST_FREEDOM = 1e6
# Search range of radii about a first guess, as a factor, and relative tolerance.
_FAR, _TOLERANCE = 1e3, 1e-9
# So many times fewer points give them to this share.
_FEW, _NEAR = 16, 0.03
_ROUNDS = 40
_EXACT, _FAR_WITHIN = 1e-60, 1e30


def chance_within(
    spreads: FloatArray, turn_rad: float, shift_m: float, freedom: float = np.inf
) -> float:
    """Probability that an error's rotation and position both stay within limits.

    Args:
        spreads: (k, 6, 6) covariances (rotation [rad], position [m]) at k equally likely poses.
        turn_rad: The limit of the rotation's angle; infinite for none.
        shift_m: The limit of the distance; likewise.
        freedom: Degrees of freedom of their scale; infinite where it is known.
    """
    rotations_sq, positions_sq = _lengths(spreads)
    squares = np.minimum(_ratio(turn_rad, rotations_sq), _ratio(shift_m, positions_sq))
    return _mean_chance(squares, freedom)


def radius_within(spreads: FloatArray, share: float, freedom: float = np.inf) -> float:
    """The least radius within which a share of the position errors stays [m].

    Other arguments are those of `chance_within`.
    """
    positions_sq = _lengths(spreads)[1]
    guess = float(np.sqrt(positions_sq.max()))
    if not guess > 0.0:
        return 0.0

    def missing(logarithm: float, among: FloatArray) -> float:
        return _mean_chance(_ratio(guess * float(np.exp(logarithm)), among), freedom) - share

    low, high = -np.log(_FAR), np.log(_FAR)
    # A few of the points bracket the root, all of them give it exactly.
    about = brentq(missing, low, high, (positions_sq[::_FEW],), xtol=_NEAR)
    low, high = (
        limit if missing(near, positions_sq) * side < 0.0 else near
        for near, limit, side in ((about - _NEAR, low, -1.0), (about + _NEAR, high, 1.0))
    )
    root = brentq(missing, low, high, (positions_sq,), xtol=_TOLERANCE)
    # Rounded up, so that the share is reached at the radius.
    return guess * float(np.exp(root + 2.0 * _TOLERANCE))


def _mean_chance(squares: FloatArray, freedom: float) -> float:
    return float(np.mean(fdtr(_SIZE, min(freedom, _MOST_FREEDOM), squares / _SIZE)))


def _ratio(limit: float, squares: FloatArray) -> FloatArray:
    """Squared limits over squared lengths, bounded for exact errors and infinite limits."""
    return np.asarray(np.minimum(limit**2 / np.maximum(squares, _EXACT), _FAR_WITHIN))


def _lengths(spreads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared lengths (n,) of rotation and position in even directions, cycling through poses."""
    values, vectors = np.linalg.eigh(spreads)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    points = _directions()
    errors = np.einsum("nij,nj->ni", roots[np.arange(len(points)) % len(roots)], points)
    squares = errors**2
    return squares[:, :3].sum(axis=1), squares[:, 3:].sum(axis=1)


def _directions() -> FloatArray:
    """(n, 6) evenly distributed unit vectors, by an additive recurrence (Roberts 2018).

    Its steps are powers of the root of x^7 = x + 1, which generalises the golden ratio to six
    dimensions.
    """
    ratio = 1.0
    for _ in range(_ROUNDS):
        ratio = (1.0 + ratio) ** (1.0 / (_SIZE + 1))
    steps = ratio ** -np.arange(1.0, _SIZE + 1.0)
    even = (0.5 + np.arange(1, _POINTS + 1)[:, None] * steps) % 1.0
    normal = ndtri(even)
    return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])
