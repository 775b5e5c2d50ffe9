"""Limits that chance passes seldom: upper quantiles of the distributions of squared errors.

By scipy.special: scipy.stats takes longer to load than a calibration takes to run, and
scipy.optimize a tenth of a second.
"""

import math
from collections.abc import Callable
from itertools import pairwise

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


def crossing(
    of: Callable[[float], float], low: float, high: float, tolerance: float = 1e-12
) -> float:
    """Where a continuous function is zero, between two places where its signs differ.

    By Ridders' method (1979): an exponential factor makes the function straight through both ends
    and the middle, and the interval halves at least.

    Args:
        of: The function.
        low: Where one sign is.
        high: Where the other is.
        tolerance: Of the place.

    Raises:
        ValueError: The signs are alike.
    """
    at_low, at_high, last = of(low), of(high), math.inf
    if at_low * at_high > 0.0:
        raise ValueError(f"no change of sign between {low:g} and {high:g}")
    if at_low * at_high == 0.0:
        return high if at_low else low
    while True:
        middle = 0.5 * (low + high)
        at_middle = of(middle)
        share = at_middle / math.sqrt(at_middle**2 - at_low * at_high)
        place = middle + (middle - low) * math.copysign(share, at_low * at_middle)
        at_place = of(place)
        if at_place == 0.0 or abs(place - last) <= tolerance:
            return place
        last = place
        ends = sorted([(low, at_low), (middle, at_middle), (place, at_place), (high, at_high)])
        ((low, at_low), (high, at_high)) = next(
            (one, other) for one, other in pairwise(ends) if one[1] * other[1] <= 0.0
        )


def t_chance(value: float, freedom: float) -> float:
    """The chance that Student's t with some degrees of freedom is at least so far from zero."""
    return float(2.0 * stdtr(freedom, -abs(value)))
