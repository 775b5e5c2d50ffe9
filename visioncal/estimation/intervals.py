"""How well the noise's levels are known."""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import RATIO_PRIOR, robot_likelihood
from visioncal.estimation.variance import profile_interval

# Logarithms of the scales at which levels are weighed, from a hundredth, under which they add
# nothing to a variance, to nine: dense at one, as a level of thousands of stops is known to 1 %.
_SCALES = 0.02 * np.sinh(np.linspace(-6.2, 5.4, 59))
# Levels under a tenth of a micrometre or microradian are none. They are then weighed about this
# one: arms repeat to some hundredths of a millimetre [m].
_NOTHING, _LEAST_MIDDLE_M = 1e-7, 5e-5
# The normal quantile that a 95 % interval reaches to.
_TWO_SIDED_95 = 1.96
# Steps of the other levels' logarithms after which an interval's end moves by less than 1 %.
_SETTLED = 1e-2
# Noise that does not differ from none is known as well as by a handful of stops, at the least.
_LEAST_FREEDOM = 8.0


def expected_levels(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Roots of the variances to be expected of the robots' noise, by its levels' likelihood.

    The most likely level of a few stops is too low as often as too high, and may be zero; what it
    is too low by counts more in a covariance. The mean of the variance over the likelihood, with
    the logarithm of the level as likely everywhere (Jeffreys 1946), is what a covariance grows
    with: of a level with n degrees of freedom n / (n - 2) times the most likely one.

    Args:
        problem: The observations.
        state: The answer.
        noise: The most likely levels.

    Returns:
        (r, 2) by robot: the rotation's [rad] and the translation's [m], no lower than in `noise`.
        A robot's two levels are scaled together, the others' being as they are.
    """
    robots = noise.robots.copy()
    if not len(problem.units[1]):
        return robots
    robots_likelihood = robot_likelihood(problem, state, noise)
    for robot in np.flatnonzero(robots_likelihood.seen).tolist():
        turn, shift = noise.robots[robot]
        ratio = shift / turn
        if min(turn, shift) < _NOTHING:
            typical, width = RATIO_PRIOR.ratio, np.exp(RATIO_PRIOR.log_sigma)
            ratio = np.clip(ratio, typical / width, typical * width)
        middle, levels = max(float(shift), _LEAST_MIDDLE_M), noise.robots.copy()
        levels[robot] = middle / ratio, middle
        values = robots_likelihood.scaled(robot, levels, np.exp(_SCALES))
        shifts = middle * np.exp(_SCALES)
        weights = np.exp(values.min() - values) * np.gradient(_SCALES)
        expected = float(np.sqrt(weights @ shifts**2 / weights.sum()))
        robots[robot] = np.maximum(robots[robot], [expected / ratio, expected])
    return robots


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
    lowest = likelihood.white[1]
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
