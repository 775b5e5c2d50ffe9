"""The influence of each stop: how much worse the arm would be known without it."""

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.linalg import covariance_among, covariance_from, gram
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fisher_information, whitened


def stop_influence(
    problem: Problem,
    state: State,
    noise: Noise,
    stops: IntArray,
    place: FloatArray,
    free: IntArray,
) -> FloatArray:
    """By which share the mean variance of some places would grow without each stop.

    The mean variance over a region is the criterion of I-optimality (Atkinson, Donev and Tobias
    2007, section 10.6). Leaving a stop out takes its rows away, so the covariance without it
    follows from that of all stops (Woodbury's identity) exactly, with the noise and the knowledge
    beforehand as they are.

    Args:
        problem: The observations.
        state: The answer.
        noise: Its levels.
        stops: (m,) the stops to be left out in turn.
        place: (k, 3, f) derivatives of the places by the free unknowns.
        free: (f,) which of the unknowns these are; others are held, such as the board's size, of
            which no stop determines much.

    Returns:
        (m,) shares; large where a stop alone determines something.
    """
    moving = np.isin(np.arange(problem.size), free) & problem.counted
    fitted = covariance_among(fisher_information(problem, state, noise), moving)
    fitted = fitted[np.ix_(free, free)]
    jacobian = whitened(problem, state, noise)[1][:, :, free]
    mean = gram(place, place) / len(place)
    growth = np.zeros(len(stops))
    for at, stop in enumerate(stops.tolist()):
        rows = jacobian[problem.observations.stops == stop].reshape(-1, len(free))
        gain = rows @ fitted
        left = covariance_from(np.eye(len(rows)) - gain @ rows.T)
        growth[at] = np.sum(left * (gain @ mean @ gain.T))
    return np.asarray(growth / np.sum(fitted * mean))
