"""How well the noise's levels are known."""

import numpy as np
from scipy.optimize import brentq

from visioncal.estimator.closure import (
    RATIO_PRIOR,
    Closure,
    Edges,
    Noise,
    components_of,
    knowledge_of,
    noise_likelihood,
    residual_blocks,
)
from visioncal.estimator.variance import LEAST_SIGMA, estimate_sigmas
from visioncal.types import FloatArray

# Twice the log-likelihood that a 95 % interval of one unknown gives away (chi-square), and how far
# it is followed, in logarithms.
_SURPRISE_95, _WIDEST = 3.84, 4.0


def noise_intervals(data: Closure, edges: Edges, noise: Noise) -> FloatArray:
    """95 % intervals of the noise's levels by the profile likelihood.

    Args:
        data: The views.
        edges: The answer.
        noise: The most likely levels.

    Returns:
        (2, 2): low and high of the rotation's sigma [rad], then of the translation's [m]; a low of
        zero where the residuals do not speak against no noise at all, and a high of fifty times the
        level where they do not speak against that.
    """
    residuals, jacobian, _ = residual_blocks(data, edges, noise)
    components, known = components_of(data, edges.z), knowledge_of(data, edges)
    lowest = noise_likelihood(data, edges)[1]
    intervals = np.empty((2, 2))

    def surprise(level: int, logarithm: float) -> float:
        start, others = noise.sigmas.copy(), np.arange(2) != level
        start[level] = np.exp(logarithm)
        value = estimate_sigmas(residuals, jacobian, components, known, start, RATIO_PRIOR, others)[
            1
        ]
        return 2.0 * (value - lowest) - _SURPRISE_95

    for level, sigma in enumerate(np.log(np.maximum(noise.sigmas, LEAST_SIGMA))):
        for side, end in enumerate((sigma - _WIDEST, sigma + _WIDEST)):
            if surprise(level, end) > 0.0:
                crossing = brentq(
                    lambda at, level=level: surprise(level, at), sigma, end, xtol=0.02
                )
                intervals[level, side] = np.exp(crossing)
            else:
                intervals[level, side] = np.exp(end) if side else 0.0
    return intervals
