"""What each stop is worth: how much worse the arm would be known without it."""

import numpy as np

from visioncal.estimation.closure import Closure, Edges, Noise, closure_information, weighted_slopes
from visioncal.estimation.linalg import covariance, gram
from visioncal.types import FloatArray, IntArray


def stop_worth(
    data: Closure, edges: Edges, noise: Noise, place: FloatArray, free: IntArray
) -> FloatArray:
    """By which share the mean variance of some places would grow without each stop.

    The mean variance over a region is the criterion of I-optimality (Atkinson, Donev and Tobias
    2007, section 10.6). Leaving a stop out takes six rows away, so the covariance without it
    follows from that of all stops (Woodbury's identity) exactly, with the noise and the knowledge
    beforehand as they are.

    Args:
        data: The views, one a stop.
        edges: The answer.
        noise: Of the flange, or of both together.
        place: (k, 3, f) derivatives of the places by the free unknowns.
        free: (f,) which of the unknowns these are; others are held, such as the board's size, of
            which no stop tells much.

    Returns:
        (m,) shares; large where a stop alone tells something.
    """
    weighted, camera, robot = weighted_slopes(data, edges, noise)
    spread = camera + robot
    slopes = (spread @ weighted)[:, :, free]
    fitted = covariance(closure_information(data, edges, noise)[np.ix_(free, free)])
    mean = gram(place, place) / len(place)
    gain = slopes @ fitted
    left = spread - gain @ np.swapaxes(slopes, 1, 2)
    growth = np.einsum("mij,mji->m", covariance(left), gain @ mean @ np.swapaxes(gain, 1, 2))
    return np.asarray(growth / np.sum(fitted * mean))
