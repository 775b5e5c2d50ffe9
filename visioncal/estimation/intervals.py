"""How well the noise's levels are known."""

from functools import partial

import numpy as np

from visioncal.estimation.closure import Closure, Edges, Noise, noise_likelihood
from visioncal.estimation.solve import robot_likelihood
from visioncal.estimation.variance import profile_interval
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
    problem = data.problem
    likelihood = robot_likelihood(problem, edges.state, noise.levels)
    lowest = noise_likelihood(data, edges)[1]

    def profile(level: int, logarithm: float) -> float:
        start, others = noise.sigmas.copy(), np.arange(2) != level
        start[level] = np.exp(logarithm)
        return likelihood.most_likely(start[None], others)[1]

    return np.array(
        [
            profile_interval(partial(profile, level), sigma, lowest)
            for level, sigma in enumerate(noise.sigmas)
        ]
    )
