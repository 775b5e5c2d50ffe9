"""Influence of each stop: growth of the arm's uncertainty without it."""

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.linalg import covariance_among, covariance_from, gram
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import whitened


def stop_influence(
    problem: Problem,
    state: State,
    noise: Noise,
    stops: IntArray,
    place: FloatArray,
    free: IntArray,
) -> FloatArray:
    """Relative growth of the mean variance of some positions without each stop.

    The mean variance over a region is the criterion of I-optimality (Atkinson, Donev and Tobias
    2007, section 10.6). Leaving a stop out removes its rows, so the covariance without it follows
    exactly from that of all stops (Woodbury's identity), with the noise and the priors unchanged.

    Args:
        problem: The observations.
        state: The solution.
        noise: Its levels.
        stops: (m,) the stops to be left out in turn.
        place: (k, 3, f) derivatives of the positions by the free unknowns.
        free: (f,) columns of these; others are held, such as the board's size, which single stops
            hardly determine.

    Returns:
        (m,) shares; large where a stop alone determines something.
    """
    moving = np.isin(np.arange(problem.size), free) & problem.counted
    fitted = covariance_among(fisher_information(problem, state, noise), moving)
    fitted = fitted[np.ix_(free, free)]
    jacobian = whitened(problem, state, noise)[1][:, :, free]
    mean = gram(place, place) / len(place)
    growth = np.zeros(len(stops))
    for index, stop in enumerate(stops.tolist()):
        rows = jacobian[problem.observations.stops == stop].reshape(-1, len(free))
        gain = rows @ fitted
        remaining = covariance_from(np.eye(len(rows)) - gain @ rows.T)
        growth[index] = np.sum(remaining * (gain @ mean @ gain.T))
    return np.asarray(growth / np.sum(fitted * mean))
