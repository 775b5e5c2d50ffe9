"""How well the noise's levels are known."""

from functools import partial

import numpy as np

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
from visioncal.estimator.variance import estimate_sigmas, profile_interval
from visioncal.types import FloatArray


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

    def profile(level: int, logarithm: float) -> float:
        start, others = noise.sigmas.copy(), np.arange(2) != level
        start[level] = np.exp(logarithm)
        fitted = estimate_sigmas(residuals, jacobian, components, known, start, RATIO_PRIOR, others)
        return fitted[1]

    return np.array(
        [
            profile_interval(partial(profile, level), sigma, lowest)
            for level, sigma in enumerate(noise.sigmas)
        ]
    )
