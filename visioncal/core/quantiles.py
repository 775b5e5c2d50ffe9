"""Upper quantiles of chi-square and F, tail probability of t, and roots of such functions.

By scipy.special, because SciPy's statistics and optimisers take longer to import than these to run.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, fdtri, stdtr

from visioncal.core.types import FloatArray

# False-alarm probability of findings: one sound session of ten thousand has one by chance.
FALSE_ALARM = 1e-4
# Probability that noise alone rejects a row, of all that are compared, or an order of points.
FALSE_REJECTION = 1e-3
# Standard deviation of normal noise, as a multiple of its median absolute deviation.
SIGMA_PER_MAD = 1.4826


def chi2_limit(chance: npt.ArrayLike, freedom: npt.ArrayLike) -> FloatArray:
    """Upper quantile of chi-square: exceeded with probability `chance` at `freedom` degrees."""
    return np.asarray(chdtri(freedom, chance), dtype=float)


# Square root of the likelihood-ratio limit of a 95 % interval of one unknown.
SURPRISE_95 = float(np.sqrt(chi2_limit(0.05, 1)))


def f_limit(chance: float, freedom: npt.ArrayLike, of_noise: float) -> FloatArray:
    """Upper quantile of F at degrees of freedom of numerator and denominator (`of_noise`)."""
    # The lower quantile of the reciprocal is accurate for small probabilities.
    return np.asarray(1.0 / fdtri(of_noise, freedom, chance), dtype=float)


def t_chance(value: float, freedom: float) -> float:
    """Two-sided tail probability of Student's t."""
    return float(2.0 * stdtr(freedom, -abs(value)))


def root_of(rising: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Where a rising function is zero between two bounds, to half a tolerance.

    Halves first, then by the chord between the bounds (Illinois: Dowell and Jarratt 1971), at least
    half a tolerance within them, so that both close in, and each fourth time by halving: half as
    many evaluations as by halving where a function is smooth, and never over four times as many.
    """
    wide, below, above, last, step = (high - low) / 16, np.nan, np.nan, 0, 0
    while high - low > tolerance:
        step += 1
        share = below / (below - above)
        chord = low + share * (high - low)
        by_chord = high - low < wide and 0.0 < share < 1.0 and step % 4
        at = chord if by_chord else (low + high) / 2
        at = min(max(at, low + tolerance / 2), high - tolerance / 2)
        value = rising(at)
        side = 1 if value > 0.0 else -1
        # The bound that stays a second time counts half.
        if side > 0:
            high, above, below = at, value, below / 2 if last == side else below
        else:
            low, below, above = at, value, above / 2 if last == side else above
        last = side
    return (low + high) / 2


def radius95(covariance: FloatArray) -> float:
    """Radius of the ball that contains a Gaussian with 95 % (three-moment fit of Imhof 1961)."""
    values = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    first, second, third = (float(np.sum(values**power)) for power in (1, 2, 3))
    if not third > 0.0:
        return 0.0
    freedom = second**3 / third**2
    quantile = (chi2_limit(0.05, freedom) - freedom) * np.sqrt(second / freedom) + first
    return float(np.sqrt(max(quantile, 0.0)))


def freedom_of(intervals: Iterable[Sequence[float]]) -> float:
    """Degrees of freedom of levels by the width of their 95 % intervals, low and high.

    The logarithm of a level with n degrees of freedom has a sigma of 1 / sqrt(2 n). Rotation and
    translation contribute about equally at half a metre from the flange, where arms err by 0.6 mm
    for each mrad, so that their degrees add up (Satterthwaite 1946). A poorly determined level adds
    little.
    """
    freedoms = [
        2.0 * (SURPRISE_95 / np.log(high / low)) ** 2 for low, high in intervals if 0.0 < low < high
    ]
    # Levels not significantly above zero have those of a handful of stops.
    return max(float(sum(freedoms)), 8.0)
