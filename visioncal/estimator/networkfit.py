"""Fitting a whole cell: all unknown edges, what is shared, and every robot's and sensor's noise."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimator.closure import RATIO_PRIOR
from visioncal.estimator.descend import Linearised, descend
from visioncal.estimator.linalg import covariance, damped_step, gram, squared_lengths
from visioncal.estimator.network import Linear, Network
from visioncal.estimator.networkreduce import Reduced, reduce
from visioncal.estimator.sightings import Noise, State
from visioncal.estimator.variance import Components, Knowledge, estimate_sigmas
from visioncal.types import FloatArray, Mask

_ROUNDS, _SETTLED = 20, 1e-8
# Noise levels that change by less have settled, far below what is known of them.
_LEVELS_SETTLED = 1e-2
# Robots' noise levels are started from above: at least here [rad and m].
_START_SIGMA = 5e-4
# Where they are sought again, it is from so much above where they were.
_ABOVE = 1.5
# ... and never from nothing, which no residuals would lift them from.
_ABOVE_NOTHING = 2e-5
# A sensor may be this much better or worse than is said of it, at the most.
_SENSOR_RANGE = (1e-3, 1e4)
# Levels below this are none [rad and m].
_FLOOR = 1e-9


@dataclass(frozen=True, eq=False)
class NetworkFit:
    """The unknowns, the noise, and whether the fit came to rest."""

    state: State
    noise: Noise
    settled: bool = True


def starting_noise(network: Network) -> Noise:
    """Noise to start from: robots from above, sensors as they are said to be."""
    sensors = int(network.sightings.sensors.max(initial=-1)) + 1
    return Noise(np.full((len(network.robots), 2), _START_SIGMA), np.ones(sensors))


def fit_network(network: Network, state: State, noise: Noise | None = None) -> NetworkFit:
    """Minimises the whitened residuals, estimating the noise's levels too.

    Args:
        network: The observations that agree.
        state: Where to start.
        noise: Its levels to start from; those from above where None.
    """
    settled = False
    if noise is None:
        noise = estimate_noise(network, state, starting_noise(network), from_above=True)
    for _ in range(_ROUNDS):
        state, settled = solve_network(network, state, noise)
        before, noise = noise, estimate_noise(network, state, noise)
        if _alike(before.robots, noise.robots) and _alike(before.sensors, noise.sensors):
            break
    return NetworkFit(state, noise, settled)


def _alike(before: FloatArray, after: FloatArray) -> bool:
    return bool(np.allclose(before, after, rtol=_LEVELS_SETTLED, atol=_FLOOR))


def solve_network(network: Network, state: State, noise: Noise) -> tuple[State, bool]:
    """Minimises the residuals whitened by a known noise.

    Returns:
        The unknowns, and whether they came to rest.
    """
    weights = np.asarray(np.linalg.inv(network.spread(noise)))
    between = network.flange_spread(noise)

    def linearise(at: State) -> Linearised[State]:
        reduced = reduce(network, at, network.linear(at), weights)
        whole = _whole(reduced, between)
        information, gradient, cost = whole
        return Linearised(
            at, cost, lambda damping: at.moved(damped_step(information, gradient, damping))
        )

    return descend(state, linearise, _SETTLED)


def _whole(reduced: Reduced, between: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Information (p, p), gradient (p,) and cost with what the units say, flanges erring."""
    weights = np.linalg.inv(reduced.spread + between[:, :, None] * np.eye(between.shape[1]))
    weighted = weights @ reduced.slopes
    cost = np.einsum("ui,uij,uj->", reduced.flanges, weights, reduced.flanges)
    return (
        reduced.information + gram(reduced.slopes, weighted),
        reduced.pull + gram(weighted, reduced.flanges),
        reduced.cost + float(cost),
    )


def normal_equations(network: Network, state: State, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Information (p, p) and gradient (p,) of half the whitened squared error."""
    return _equations(network, state, noise, network.linear(state))


def _equations(
    network: Network, state: State, noise: Noise, linear: Linear
) -> tuple[FloatArray, FloatArray]:
    weights = np.asarray(np.linalg.inv(network.spread(noise)))
    reduced = reduce(network, state, linear, weights)
    return _whole(reduced, network.flange_spread(noise))[:2]


def network_information(network: Network, state: State, noise: Noise) -> FloatArray:
    """Fisher information (p, p) on the unknowns, where all chains close exactly."""
    return _equations(network, state, noise, network.linear(state, ideal=True))[0]


def estimate_noise(
    network: Network, state: State, noise: Noise, *, from_above: bool = False
) -> Noise:
    """Estimates the noise's levels from the residuals at some state.

    Robots' by restricted likelihood; a sensor's by the share of its residuals that the fit has left
    of it (Foerstner and Wrobel 2016, section 4.2.4), the others being known.

    Args:
        network: The observations.
        state: The unknowns, near the best ones.
        noise: The levels to start from.
        from_above: Whether robots' levels are to be sought from above what the residuals show,
            since they may be anything: a start that is too low may stay there.
    """
    robots = _robots(network, state, noise, from_above=from_above)
    if not len(noise.sensors):
        return replace(noise, robots=robots)
    noise = replace(noise, robots=robots)
    squares, left = posterior(network, state, noise)
    sensors = noise.sensors.copy()
    for at in range(len(sensors)):
        mine = network.sightings.sensors == at
        redundancy = float(left[mine].sum())
        if redundancy > 1.0:
            factor = np.sqrt(float(squares[mine].sum()) / redundancy)
            sensors[at] = np.clip(sensors[at] * factor, *_SENSOR_RANGE)
    if len(network.least_levels):
        sensors = np.maximum(sensors, network.least_levels)
    return replace(noise, sensors=sensors)


def _robots(network: Network, state: State, noise: Noise, *, from_above: bool) -> FloatArray:
    _, members = network.units
    if not len(members):
        return noise.robots
    weights = np.asarray(np.linalg.inv(network.spread(noise)))
    reduced = reduce(network, state, network.linear(state), weights)
    count, width = len(network.robots), members.shape[1]
    parts = np.zeros((2 * count, len(members), 6 * width, 6 * width))
    for robot in range(count):
        rows, slots = np.nonzero(members == robot)
        for axis in range(3):
            at = 6 * slots + axis
            parts[2 * robot, rows, at, at] = parts[2 * robot + 1, rows, at + 3, at + 3] = 1.0
    seen = np.array([(members == it).any() for it in range(count)])
    places = tuple((2 * it, 2 * it + 1) for it in np.flatnonzero(seen).tolist())
    start = np.maximum(_ABOVE * noise.robots.ravel(), _ABOVE_NOTHING)
    if from_above:
        squares = np.mean(reduced.flanges.reshape(-1, 2, 3) ** 2, axis=(0, 2))
        start = np.tile(np.maximum(np.sqrt(squares), _START_SIGMA), count)
    sigmas, _ = estimate_sigmas(
        reduced.flanges,
        reduced.slopes,
        Components(reduced.spread, parts),
        Knowledge(reduced.information, reduced.pull),
        np.where(np.repeat(seen, 2), start, noise.robots.ravel()),
        replace(RATIO_PRIOR, places=places),
        np.repeat(seen, 2),
    )
    return sigmas.reshape(count, 2)


def posterior(network: Network, state: State, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """What the fit leaves of each observation once its flange's error is known as well as it is.

    Returns:
        (n,) squared residuals in units of their own noise, and (n,) how many of each observation's
        directions were left over to judge by, of which those squares are an estimate.
    """
    spread = network.spread(noise)
    weights = np.asarray(np.linalg.inv(spread))
    linear = network.linear(state)
    reduced = reduce(network, state, linear, weights)
    between = network.flange_spread(noise)
    known = covariance(_whole(reduced, between)[0])
    of, _ = network.units
    residuals, slopes, gone = linear.residuals.copy(), linear.jacobian.copy(), np.zeros_like(spread)
    rows = of >= 0
    if rows.any():
        # The flanges' errors as their prior and their observations have them together.
        shrink = np.linalg.inv(reduced.spread + between[:, :, None] * np.eye(between.shape[1]))
        gain = between[:, :, None] * shrink
        left = between[:, :, None] * np.eye(between.shape[1]) - gain * between[:, None, :]
        slack = linear.slack[rows]
        flange = (gain @ reduced.flanges[:, :, None])[of[rows]]
        residuals[rows] -= (slack @ flange)[:, :, 0]
        slopes[rows] -= slack @ (gain @ reduced.slopes)[of[rows]]
        gone[rows] = slack @ left[of[rows]] @ np.swapaxes(slack, 1, 2)
    gone = gone + slopes @ known @ np.swapaxes(slopes, 1, 2)
    squares = np.einsum("ni,nij,nj->n", residuals, weights, residuals)
    told = np.where(network.sightings.turned, 6.0, 3.0)
    return squares, told - np.einsum("nij,nji->n", weights, gone)


def surprises(network: Network, used: Mask, fit: NetworkFit) -> tuple[FloatArray, FloatArray]:
    """How far each observation is from what the others predict, its flange's error being free.

    Args:
        network: All n observations.
        used: (n,) those that the fit was made from.
        fit: The unknowns and the noise.

    Returns:
        (n,) squared Mahalanobis distances, and (n,) in how many directions they were measured.
    """
    linear = network.linear(fit.state)
    known = covariance(normal_equations(network.subset(used), fit.state, fit.noise)[0])
    spread = network.total(linear, fit.noise)
    taken = linear.jacobian @ known @ np.swapaxes(linear.jacobian, 1, 2)
    left = spread + np.where(used, -1.0, 1.0)[:, None, None] * taken
    squares, directions = squared_lengths(linear.residuals, left, spread)
    return squares, np.asarray(directions - np.where(network.sightings.turned, 0, 3), dtype=float)


def by_noise_alone(network: Network, fit: NetworkFit) -> FloatArray:
    """Squared distances (n,) from what is predicted, the unknowns being as they are."""
    linear = network.linear(fit.state)
    spread = network.total(linear, fit.noise)
    white = np.linalg.solve(spread, linear.residuals[:, :, None])[:, :, 0]
    return np.asarray(np.sum(linear.residuals * white, axis=1))


def equations_by_stop(network: Network, fit: NetworkFit) -> tuple[FloatArray, FloatArray]:
    """Information (s, p, p) and gradient (s, p) of each stop's observations by themselves."""
    state, noise = fit.state, fit.noise
    weights = np.asarray(np.linalg.inv(network.spread(noise)))
    linear = network.linear(state)
    every = np.concatenate([linear.jacobian, linear.residuals[:, :, None]], axis=2)
    weighted = weights @ every
    stops, of = network.sightings.stops, network.units[0]
    total = np.zeros((int(stops.max()) + 1, every.shape[2], every.shape[2]))
    np.add.at(total, stops, np.swapaxes(every, 1, 2) @ weighted)
    rows = of >= 0
    if rows.any():
        between = network.flange_spread(noise)
        slack = np.swapaxes(linear.slack[rows], 1, 2)
        own = np.array([np.diag(it) for it in 1.0 / between])
        cross = np.zeros((len(own), own.shape[1], every.shape[2]))
        np.add.at(own, of[rows], slack @ weights[rows] @ linear.slack[rows])
        np.add.at(cross, of[rows], slack @ weighted[rows])
        stop_of = np.zeros(len(own), dtype=np.int64)
        stop_of[of[rows]] = stops[rows]
        np.subtract.at(total, stop_of, np.swapaxes(cross, 1, 2) @ np.linalg.solve(own, cross))
    return total[:, :-1, :-1], total[:, :-1, -1]
