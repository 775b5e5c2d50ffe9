"""Probability that a pose error stays within tolerances of position, rotation, or both.

An error x = o + L z has the known part o and the covariance L L^T. Written as x = o + r L w, w is a
uniform direction on the unit sphere, and r^2 is chi-square of d degrees of freedom, independent of
it. x lies within a ball of radius m, and its rotation part within another, where r is between the
roots of two quadratic equations. So the probability is the mean over all w of the chi-square
distribution between them (Deak 1980; Genz and Bretz 2009, chapter 4): one smooth integral over a
sphere, exact in r, also for correlated errors of position and rotation. It is evaluated at 4,096
evenly distributed points of the sphere. For a covariance whose scale was estimated with n degrees
of freedom, r^2 / d is F of (d, n).
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.special import fdtr, ndtri

from visioncal.core.quantiles import root_of
from visioncal.core.types import FloatArray

_POINTS, _SIZE = 4096, 6  # Even directions, and components of an error.
# In place of infinity: degrees of freedom, radii, and the ratio of a radius to a first guess.
_INFINITE = 1e6
# Relative tolerance of a radius.
_TOLERANCE = 1e-9


def chance_within(
    spreads: FloatArray,
    turn_rad: float,
    shift_m: float,
    freedom: float = np.inf,
    offsets: FloatArray | None = None,
) -> float:
    """Probability that an error's rotation and position both stay within limits.

    Args:
        spreads: (k, 6, 6) covariances (rotation [rad], position [m]) at k equally likely poses.
        turn_rad: The limit of the rotation's angle; infinite for none.
        shift_m: The limit of the distance; likewise.
        freedom: Degrees of freedom of their scale; infinite where it is known.
        offsets: (k, 6) known part of the error there.
    """
    errors, known = _errors(spreads, offsets)
    return _mean_chance(
        [
            _crossings(errors[:, :3], known[:, :3], turn_rad),
            _crossings(errors[:, 3:], known[:, 3:], shift_m),
        ],
        freedom,
    )


def radius_within(
    spreads: FloatArray, share: float, freedom: float = np.inf, offsets: FloatArray | None = None
) -> float:
    """The least radius within which a share of the position errors stays [m].

    Other arguments are those of `chance_within`.
    """
    errors, known = (part[:, 3:] for part in _errors(spreads, offsets))
    guess = float(np.linalg.norm(errors, axis=1).max() + np.linalg.norm(known, axis=1).max())
    if not guess > 0.0:
        return 0.0

    def missing(logarithm: float) -> float:
        limit = guess * float(np.exp(logarithm))
        return _mean_chance([_crossings(errors, known, limit)], freedom) - share

    root = root_of(missing, -np.log(_INFINITE), np.log(_INFINITE), _TOLERANCE)
    # Rounded up, so that the share is reached at the radius.
    return guess * float(np.exp(root + 2.0 * _TOLERANCE))


def _mean_chance(crossings: Sequence[tuple[FloatArray, FloatArray]], freedom: float) -> float:
    """Mean probability of an r between all lower and upper crossings (n,)."""
    lowest = np.max([low for low, _ in crossings], axis=0)
    highest = np.maximum(np.min([high for _, high in crossings], axis=0), lowest)
    below, above = (
        fdtr(_SIZE, min(freedom, _INFINITE), radius**2 / _SIZE) for radius in (lowest, highest)
    )
    return float(np.mean(above - below))


def _crossings(
    errors: FloatArray, known: FloatArray, limit: float
) -> tuple[FloatArray, FloatArray]:
    """(n,) lower and upper r at which |known + r error| (n, 3) is the limit; equal for none."""
    length = np.maximum(np.linalg.norm(errors, axis=1), np.finfo(float).tiny)
    along = np.einsum("ni,ni->n", known, errors) / length
    across_sq = np.maximum(np.sum(known**2, axis=1) - along**2, 0.0)
    half = np.sqrt(np.maximum(limit**2 - across_sq, 0.0))
    # Of an error of next to nothing they are infinite.
    with np.errstate(over="ignore"):
        low, high = ((root - along) / length for root in (-half, half))
    return np.clip(low, 0.0, _INFINITE), np.clip(high, 0.0, _INFINITE)


def _errors(spreads: FloatArray, offsets: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """(n, 6) errors in even directions, cycling through poses, and the known parts there."""
    values, vectors = np.linalg.eigh(spreads)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    points = _directions()
    at = np.arange(len(points)) % len(roots)
    errors = np.einsum("nij,nj->ni", roots[at], points)
    return errors, np.zeros_like(errors) if offsets is None else offsets[at]


@cache
def _directions() -> FloatArray:
    """(n, 6) evenly distributed unit vectors, by an additive recurrence (Roberts 2018)."""
    # Steps are powers of the root of x^7 = x + 1, a golden ratio of six dimensions.
    ratio = float(np.max(np.real(np.roots([1.0, *np.zeros(_SIZE - 1), -1.0, -1.0]))))
    steps = ratio ** -np.arange(1.0, _SIZE + 1.0)
    even = (0.5 + np.arange(1, _POINTS + 1)[:, None] * steps) % 1.0
    normal = ndtri(even)
    return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])
