"""Upper quantiles of chi-square and F, tail probability of t, and roots of such functions.

By scipy.special, because SciPy's statistics and optimisers take longer to import than these to run.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, fdtri, stdtr

from visioncal.core.types import FloatArray

# False-alarm probability of findings: one sound session of ten thousand has one by chance.
FALSE_ALARM = 1e-4
# Probability that noise alone rejects a row, of all that are compared, or an order of points.
FALSE_REJECTION = 1e-3


def chi2_limit(chance: npt.ArrayLike, freedom: npt.ArrayLike) -> FloatArray:
    """Upper quantile of chi-square: exceeded with probability `chance` at `freedom` degrees."""
    return np.asarray(chdtri(freedom, chance), dtype=float)


def f_limit(chance: float, freedom: npt.ArrayLike, of_noise: float) -> FloatArray:
    """Upper quantile of F at degrees of freedom of numerator and denominator (`of_noise`)."""
    # The lower quantile of the reciprocal is accurate for small probabilities.
    return np.asarray(1.0 / fdtri(of_noise, freedom, chance), dtype=float)


def t_chance(value: float, freedom: float) -> float:
    """Two-sided tail probability of Student's t."""
    return float(2.0 * stdtr(freedom, -abs(value)))


def root_of(rising: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Where a rising function is zero between two bounds, by bisection."""
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (low, middle) if rising(middle) > 0.0 else (middle, high)
    return (low + high) / 2
