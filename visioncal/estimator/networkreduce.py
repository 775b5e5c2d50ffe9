"""Taking the flanges' errors out of a whole cell, stop by stop.

By a Schur complement (Triggs et al. 2000, section 6.1): what all observations of a stop together
say of a flange is one 6-vector a robot, and what is left says something of the unknowns whatever
the robots do.
"""

from dataclasses import dataclass

import numpy as np

from visioncal.estimator.linalg import gram
from visioncal.estimator.network import ANYTHING, Linear, Network
from visioncal.estimator.sightings import State
from visioncal.types import FloatArray

# Eigenvalues of the information on a flange below this share of the largest are none.
_NULL = 1e-9


@dataclass(frozen=True, eq=False)
class Reduced:
    """The observations once the flanges' errors have been taken out, unit by unit.

    Attributes:
        information: (p, p) on the unknowns, whatever the robots do.
        pull: (p,) half its gradient.
        cost: Its squared error.
        flanges: (u, 6 w) what each unit says of its flanges' errors.
        slopes: (u, 6 w, p) how that moves with the unknowns.
        spread: (u, 6 w, 6 w) its covariance, by the observations alone.
    """

    information: FloatArray
    pull: FloatArray
    cost: float
    flanges: FloatArray
    slopes: FloatArray
    spread: FloatArray


def reduce(network: Network, state: State, linear: Linear, weights: FloatArray) -> Reduced:
    """Takes the flanges' errors out.

    Args:
        network: The network.
        state: Where it was linearised.
        linear: The residuals there.
        weights: (n, 6, 6) inverse covariances of the observations' own noise.
    """
    of, members = network.units
    every = np.concatenate([linear.jacobian, linear.residuals[:, :, None]], axis=2)
    weighted = weights @ every
    total = gram(every, weighted)
    width, size = linear.slack.shape[2], len(total) - 1
    own, cross = np.zeros((len(members), width, width)), np.zeros((len(members), width, size + 1))
    rows = of >= 0
    slack = np.swapaxes(linear.slack[rows], 1, 2)
    np.add.at(own, of[rows], slack @ weights[rows] @ linear.slack[rows])
    np.add.at(cross, of[rows], slack @ weighted[rows])
    inverse, blind = _pseudo_inverse(own)
    answer = inverse @ cross
    total = total - gram(cross, answer)
    known, shared = network.common, state.shared
    edges = 6 * len(state.edges)
    total[edges:size, edges:size] += known.information
    total[np.arange(size), np.arange(size)] += network.chosen
    pull = known.information @ shared + known.pull
    total[edges:size, -1] += pull
    cost = float(total[-1, -1] + shared @ (known.pull + pull))
    # A residual is what the flange's error made of it: the error itself has the other sign.
    return Reduced(
        total[:-1, :-1], total[:-1, -1], cost, answer[:, :, -1], answer[:, :, :-1], inverse + blind
    )


def _pseudo_inverse(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses (u, w, w) where there is information, and what is open where there is none."""
    values, vectors = np.linalg.eigh(information)
    most = values[:, -1:] if values.shape[1] else values
    told = values > _NULL * np.maximum(most, np.finfo(float).tiny)
    inverse = np.where(told, 1.0 / np.where(told, values, 1.0), 0.0)
    turned = np.swapaxes(vectors, 1, 2)
    blind = np.where(told, 0.0, ANYTHING)
    return (vectors * inverse[:, None, :]) @ turned, (vectors * blind[:, None, :]) @ turned
