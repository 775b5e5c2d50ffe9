"""The chance that an error stays within what is needed: of a place, of a rotation, of both.

An error x = L z has the covariance L L^T. Written as x = r L w, w is a direction, even over the
unit sphere, and r^2 is chi-square of d degrees of freedom, independent of it. x lies within a ball
of radius m, and its rotation part within another, where r^2 is under the lesser of the squares of
radius over length of L w. So the chance is the mean over all w of chi-square's distribution there
(Deak 1980; Genz and Bretz 2009, chapter 4): one smooth integral over a sphere, exact in r, whether
the errors of place and rotation hang together or not. It is taken by 4,096 even points of the
sphere. Of a covariance whose scale was estimated with n degrees of freedom, r^2 / d is F of (d, n).
"""

import numpy as np
from scipy.optimize import brentq
from scipy.special import fdtr, ndtri

from visioncal.core.types import FloatArray

_POINTS, _SIZE = 4096, 6
# Beyond, F does not differ from chi-square, and its series lose digits.
_MOST_FREEDOM = 1e6
# Radii are sought within this factor about a first guess, to this share of them.
_FAR, _TOLERANCE = 1e3, 1e-9
# So many times fewer points give them to this share.
_FEW, _NEAR = 16, 0.03
_ROUNDS = 40
_EXACT, _FAR_WITHIN = 1e-60, 1e30


def chance_within(
    spreads: FloatArray, turn_rad: float, shift_m: float, freedom: float = np.inf
) -> float:
    """The chance that an error's rotation and its place both stay within limits.

    Args:
        spreads: (k, 6, 6) covariances (rotation [rad], place [m]) at k places, all as likely.
        turn_rad: The limit of the rotation's angle; infinite for none.
        shift_m: The limit of the distance; likewise.
        freedom: Degrees of freedom that their scale was estimated with; infinite where known.
    """
    turned, shifted = _lengths(spreads)
    squares = np.minimum(_ratio(turn_rad, turned), _ratio(shift_m, shifted))
    return _mean_chance(squares, freedom)


def radius_within(spreads: FloatArray, share: float, freedom: float = np.inf) -> float:
    """The least distance within which a share of the errors' places stays [m].

    Args:
        spreads: (k, 6, 6) as in `chance_within`.
        share: Between 0 and 1.
        freedom: As there.
    """
    shifted = _lengths(spreads)[1]
    guess = float(np.sqrt(shifted.max()))
    if not guess > 0.0:
        return 0.0

    def missing(logarithm: float, among: FloatArray) -> float:
        return _mean_chance(_ratio(guess * float(np.exp(logarithm)), among), freedom) - share

    low, high = -np.log(_FAR), np.log(_FAR)
    # A few of the points say where it is, all of them where exactly.
    about = brentq(missing, low, high, (shifted[::_FEW],), xtol=_NEAR)
    low, high = (
        limit if missing(near, shifted) * side < 0.0 else near
        for near, limit, side in ((about - _NEAR, low, -1.0), (about + _NEAR, high, 1.0))
    )
    found = brentq(missing, low, high, (shifted,), xtol=_TOLERANCE)
    # At the radius itself the share must be reached, so that a need of it is met.
    return guess * float(np.exp(found + 2.0 * _TOLERANCE))


def _mean_chance(squares: FloatArray, freedom: float) -> float:
    return float(np.mean(fdtr(_SIZE, min(freedom, _MOST_FREEDOM), squares / _SIZE)))


def _ratio(limit: float, squares: FloatArray) -> FloatArray:
    """Squared limits over squared lengths; what is exact, or has no limit, is far within."""
    return np.asarray(np.minimum(limit**2 / np.maximum(squares, _EXACT), _FAR_WITHIN))


def _lengths(spreads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared lengths (n,) of rotation and place in even directions, the k places by turns."""
    values, vectors = np.linalg.eigh(spreads)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    points = _directions()
    away = np.einsum("nij,nj->ni", roots[np.arange(len(points)) % len(roots)], points)
    squares = away**2
    return squares[:, :3].sum(axis=1), squares[:, 3:].sum(axis=1)


def _directions() -> FloatArray:
    """(n, 6) even points of the unit sphere, by a sequence of additive recurrence (Roberts 2018).

    Its steps are powers of the root of x^7 = x + 1, the golden ratio's like in six dimensions.
    """
    ratio = 1.0
    for _ in range(_ROUNDS):
        ratio = (1.0 + ratio) ** (1.0 / (_SIZE + 1))
    steps = ratio ** -np.arange(1.0, _SIZE + 1.0)
    even = (0.5 + np.arange(1, _POINTS + 1)[:, None] * steps) % 1.0
    normal = ndtri(even)
    return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])
