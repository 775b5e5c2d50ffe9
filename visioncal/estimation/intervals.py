"""Uncertainty of the noise levels: expected variances, intervals, degrees of freedom."""

from functools import partial

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.mixed import LEAST_SIGMA, RATIO_LOG_SIGMA, TYPICAL_RATIO, profile_interval
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import robot_likelihood

# Logarithms of the integration's ends, from a hundredth, below which levels add nothing to a
# variance, to nine; and the number of steps between, short ones near the most likely level.
_ENDS, _STEPS = (-4.6, 2.2), 25


def expected_levels(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Roots of the expected variances of the robots' noise, by its levels' likelihood.

    The most likely level of a few stops is too low as often as too high, and may be zero; too low
    is worse for a covariance. The mean of the variance over the likelihood, with a flat prior on
    the logarithm of the level (Jeffreys 1946), scales the covariance correctly: for n degrees of
    freedom it is n / (n - 2) times the most likely variance.

    Returns:
        (r, 2) by robot: the rotation's [rad] and the translation's [m], no lower than in `noise`. A
        robot's two levels are scaled together, with the others held.
    """
    robots = noise.robots.copy()
    if not len(problem.units[1]):
        return robots
    likelihood = robot_likelihood(problem, state, noise)
    for robot in np.flatnonzero(likelihood.seen).tolist():
        rotation, translation = noise.robots[robot]
        ratio, middle, width = translation / rotation, float(translation), 1.0
        at, levels = np.log(np.maximum(noise.robots, LEAST_SIGMA)).ravel(), 2 * robot + np.arange(2)
        # Levels under a tenth of a micrometre or microradian count as zero. They are then
        # integrated about this one: arms repeat to some hundredths of a millimetre [m].
        if min(rotation, translation) < 1e-7:
            factor = np.exp(RATIO_LOG_SIGMA)
            ratio = np.clip(ratio, TYPICAL_RATIO / factor, TYPICAL_RATIO * factor)
            middle = max(middle, 5e-5)
            at[levels] = np.log([middle / ratio, middle])
        else:
            curvature = likelihood.model.at(at).curvature[np.ix_(levels, levels)]
            width = max(float(np.sum(curvature)), 1.0) ** -0.5
        first, last = np.arcsinh(np.array(_ENDS) / width).tolist()
        steps = width * np.sinh(np.linspace(first, last, _STEPS))
        logs = np.tile(at, (_STEPS, 1))
        logs[:, levels] += steps[:, None]
        values = np.array([likelihood.model.at(row, is_sloped=False).value for row in logs])
        translations = middle * np.exp(steps)
        weights = np.exp(values.min() - values) * np.gradient(steps)
        expected = float(np.sqrt(weights @ translations**2 / weights.sum()))
        robots[robot] = np.maximum(robots[robot], [expected / ratio, expected])
    return robots


def noise_intervals(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """95 % intervals of the robots' noise levels by the profile likelihood.

    Returns:
        (r, 2, 2) by robot: low and high of the rotation's sigma [rad], then of the translation's
        [m]; a low of zero where the residuals do not exclude zero noise, and a high of fifty times
        the level where they do not exclude that.
    """
    likelihood = robot_likelihood(problem, state, noise)
    lowest = likelihood.white[1]
    sigmas = noise.robots.ravel()

    def profile(level: int, logarithm: float) -> float:
        at, others = sigmas.copy(), np.arange(len(sigmas)) != level
        at[level] = np.exp(logarithm)
        # Gain in log-likelihood of the other levels after which an interval's end moves by less
        # than 1 %.
        return likelihood.most_likely(at.reshape(noise.robots.shape), others, little=1e-3)[1]

    intervals = [
        profile_interval(partial(profile, level), sigma, lowest)
        for level, sigma in enumerate(sigmas.tolist())
    ]
    return np.array(intervals).reshape(*noise.robots.shape, 2)
