"""Upper quantiles of chi-square and F, and tail probability of t.

By scipy.special, because scipy.stats takes longer to import than a calibration to run.
"""

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
