"""Limits that chance passes seldom: upper quantiles of the distributions of squared errors.

By scipy.special: scipy.stats takes longer to load than a calibration takes to run.
"""

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, fdtri, stdtr

from visioncal.core.types import FloatArray


def chi2_limit(chance: npt.ArrayLike, freedom: npt.ArrayLike) -> FloatArray:
    """What a sum of so many squared standard normal deviates exceeds with a given chance."""
    return np.asarray(chdtri(freedom, chance), dtype=float)


def f_limit(chance: float, freedom: npt.ArrayLike, of_noise: float) -> FloatArray:
    """What the ratio of two mean squares exceeds with a given chance (Fisher's F).

    Args:
        chance: Between 0 and 1.
        freedom: Degrees of freedom of the mean square above the line.
        of_noise: Those of the one below.
    """
    # The reciprocal's lower tail keeps its digits where the chance is small.
    return np.asarray(1.0 / fdtri(of_noise, freedom, chance), dtype=float)


def t_chance(value: float, freedom: float) -> float:
    """The chance that Student's t with some degrees of freedom is at least so far from zero."""
    return float(2.0 * stdtr(freedom, -abs(value)))
