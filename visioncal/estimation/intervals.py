"""How well the noise's levels are known."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import robot_levels, robot_likelihood, starting_noise
from visioncal.estimation.variance import profile_interval

# The normal quantile that a 95 % interval reaches to.
_TWO_SIDED_95 = 1.96
# Steps of the other levels' logarithms after which an interval's end moves by less than 1 %.
_SETTLED = 1e-2
# Noise that does not differ from none is known as well as by a handful of stops, at the least.
_LEAST_FREEDOM = 8.0


def noise_intervals(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """95 % intervals of the robots' levels by the profile likelihood.

    Args:
        problem: The observations.
        state: The answer.
        noise: The most likely levels.

    Returns:
        (r, 2, 2) by robot: low and high of the rotation's sigma [rad], then of the translation's
        [m]; a low of zero where the residuals do not speak against no noise at all, and a high of
        fifty times the level where they do not speak against that.
    """
    likelihood = robot_likelihood(problem, state, noise)
    start = replace(noise, robots=starting_noise(problem).robots)
    lowest = robot_levels(problem, state, start, from_above=True)[1]
    sigmas = noise.robots.ravel()

    def profile(level: int, logarithm: float) -> float:
        at, others = sigmas.copy(), np.arange(len(sigmas)) != level
        at[level] = np.exp(logarithm)
        return likelihood.most_likely(at.reshape(noise.robots.shape), others, settled=_SETTLED)[1]

    found = [
        profile_interval(partial(profile, level), sigma, lowest)
        for level, sigma in enumerate(sigmas.tolist())
    ]
    return np.array(found).reshape(*noise.robots.shape, 2)


def freedom_of(intervals: Iterable[Sequence[float]]) -> float:
    """Degrees of freedom of levels by the width of their 95 % intervals, low and high.

    A level with n degrees of freedom has a logarithm known to 1 / sqrt(2 n). Rotation and
    translation contribute about alike at half a metre from the flange, where arms err by 0.6 mm
    for each mrad, so that their degrees add up (Satterthwaite 1946). One of which the residuals
    say little adds little.
    """
    found = [
        2.0 * (_TWO_SIDED_95 / np.log(high / low)) ** 2
        for low, high in intervals
        if 0.0 < low < high
    ]
    return max(float(sum(found)), _LEAST_FREEDOM)
