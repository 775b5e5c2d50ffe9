"""Uncertainty budget: contributions of the error sources, and uncertainty at a work point."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.linalg import covariance_among, gram
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Linear, Problem
from visioncal.estimation.problem_parts import Noise, State


@dataclass(frozen=True, eq=False)
class Sources:
    """Names of the error sources; sources with the same name are merged."""

    # The source of each observing frame's measurement noise, by the frame.
    sensors: Mapping[str, str]
    # The source of each robot's flange error from stop to stop, by the robot.
    robots: Mapping[str, str]
    # The problem's columns with the prior uncertainty of effects, by the source. Columns of no
    # source do not count.
    columns: Mapping[str, IntArray] = field(default_factory=dict)
    priors: str = "priors"  # The source of hand-measured frames.


def covariance_by_source(
    problem: Problem, state: State, noise: Noise, sources: Sources
) -> dict[str, FloatArray]:
    """Splits the covariance of the edges into contributions (6 e, 6 e) of the sources.

    The estimate is linear in the errors of observations, flanges, effects and priors: each
    contributes its own covariance through the same gain, and the parts add up to the total. Priors
    of effects may be correlated, as of lens and board that are known from the same corners: each
    takes half of the cross terms, which may make one contribution negative where they compensate
    each other.
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    linear, own = problem.linear(state, ideal=True), problem.covariance(noise)
    gain = _weighted_jacobian(problem, linear, own, noise) @ fitted[:, : 6 * len(problem.unknown)]
    parts: dict[str, FloatArray] = defaultdict(lambda: np.zeros((gain.shape[2],) * 2))
    for frame in dict.fromkeys(problem.observations.observers):
        rows = np.array([observer == frame for observer in problem.observations.observers])
        # If the observations' own noise is unknown, the robot's noise includes it.
        if own[rows].any():
            parts[sources.sensors[frame]] += gram(gain[rows], own[rows] @ gain[rows])
    for name, part in _by_errors(problem, linear, gain, noise, sources):
        parts[name] += part
    edge_columns = fitted[:, : 6 * len(problem.unknown)]
    prior_info = problem.prior_information(state).information
    owned = np.concatenate([*sources.columns.values(), np.zeros(0, np.int64)])
    for prior in problem.priors:
        _, jacobian = problem.prior_rows(prior, state)
        prior_info = prior_info - jacobian.T @ jacobian
        response = jacobian @ edge_columns
        parts[sources.priors] += response.T @ response
    for name, columns in sources.columns.items():
        share = np.where(np.isin(owned, columns), 0.5, 0.0)
        part = (share[:, None] + share) * prior_info[np.ix_(owned, owned)]
        parts[name] += edge_columns[owned].T @ part @ edge_columns[owned]
    return dict(parts)


def less_noise(
    problem: Problem, state: State, noise: Noise, robot: str, white: FloatArray
) -> FloatArray:
    """Change (p, p) of a fit's covariance if a robot's noise differs from that of the weights.

    `noise` is that of the weights, and `white` (2,) the robot's, of rotation [rad] and position
    [m].
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    linear, index = problem.linear(state, ideal=True), problem.robots.index(robot)
    gain = _weighted_jacobian(problem, linear, problem.covariance(noise), noise) @ fitted
    robot_gain = _of_flange(problem, linear, gain, index)
    change = np.repeat(white**2 - noise.robots[index] ** 2, 3)
    return gram(robot_gain, change[:, None] * robot_gain)


def _weighted_jacobian(
    problem: Problem, linear: Linear, own: FloatArray, noise: Noise
) -> FloatArray:
    """Inverse covariance (n, 6, p) of all residuals times their Jacobian."""
    weighted_jacobian, alone, (unit_of, _) = linear.jacobian, problem.alone, problem.units
    total = problem.total_covariance(linear, noise)
    weighted_jacobian[alone] = np.linalg.solve(total[alone], weighted_jacobian[alone])
    rest = np.flatnonzero(~alone)
    if not len(rest):
        return weighted_jacobian
    weights = np.linalg.inv(own[rest])
    weighted_jacobian[rest] = weights @ weighted_jacobian[rest]
    errors = problem.error_covariance(noise)
    shared, units = rest[unit_of[rest] >= 0], unit_of[rest][unit_of[rest] >= 0]
    jacobian = linear.by_errors[shared]
    transposed = np.swapaxes(jacobian, 1, 2)
    weighted = weights[unit_of[rest] >= 0] @ jacobian
    shape = errors.shape
    information, right = np.zeros(shape), np.zeros((len(errors), shape[1], linear.size))
    np.add.at(information, units, transposed @ weighted)
    np.add.at(right, units, transposed @ weighted_jacobian[shared])
    correction = np.linalg.solve(np.eye(shape[1]) + errors @ information, errors @ right)
    weighted_jacobian[shared] -= weighted @ correction[units]
    return weighted_jacobian


def _by_errors(
    problem: Problem, linear: Linear, gain: FloatArray, noise: Noise, sources: Sources
) -> list[tuple[str, FloatArray]]:
    """Contributions of the flanges' errors, and of errors that repeats share, by source."""
    _, members = problem.units
    errors = problem.error_covariance(noise)
    parts = []
    for index, robot in enumerate(problem.robots):
        robot_gain = _of_flange(problem, linear, gain, index)
        variances = np.repeat(noise.robots[index] ** 2, 3)
        parts.append((sources.robots[robot], gram(robot_gain, variances[:, None] * robot_gain)))
    by_unit = _by_unit(problem, linear, gain)
    first = len(members) - len(problem.repeats)
    for unit, repeated in enumerate(problem.repeats, start=first):
        frame = problem.observations.observers[repeated[0]]
        part = by_unit[unit].T @ errors[unit] @ by_unit[unit]
        parts.append((sources.sensors[frame], part))
    return parts


def _of_flange(problem: Problem, linear: Linear, gain: FloatArray, robot: int) -> FloatArray:
    """(u, 6, c) gain of a robot's flange error at each unit that contains it."""
    units, slots = np.nonzero(problem.units[1] == robot)
    columns = 6 * slots[:, None] + np.arange(6)
    return np.asarray(_by_unit(problem, linear, gain)[units[:, None], columns])


def _by_unit(problem: Problem, linear: Linear, gain: FloatArray) -> FloatArray:
    """(u, 6 w, c) gain of the errors that the observations of a unit share."""
    unit_of, members = problem.units
    rows = unit_of >= 0
    gains = np.zeros((len(members), linear.by_errors.shape[2], gain.shape[2]))
    np.add.at(gains, unit_of[rows], np.swapaxes(linear.by_errors[rows], 1, 2) @ gain[rows])
    return gains


def radius95(covariance: FloatArray) -> float:
    """Radius of the ball that contains a Gaussian with 95 % (three-moment fit of Imhof 1961)."""
    values = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    first, second, third = (float(np.sum(values**power)) for power in (1, 2, 3))
    if not third > 0.0:
        return 0.0
    freedom = second**3 / third**2
    quantile = (chi2_limit(0.05, freedom) - freedom) * np.sqrt(second / freedom) + first
    return float(np.sqrt(max(quantile, 0.0)))


def point_covariance(edge: FloatArray, covariance: FloatArray, point: FloatArray) -> FloatArray:
    """Covariance of a point mapped by an uncertain transform.

    Args:
        edge: (4, 4) `a_from_b`.
        covariance: (6, 6) of its right perturbation (rotation, translation).
        point: (3,) in frame b, exact [m].

    Returns:
        (3, 3) of the point in frame a [m^2].
    """
    jacobian = edge[:3, :3] @ np.concatenate([-skew(point), np.eye(3)], axis=1)
    return np.asarray(jacobian @ covariance @ jacobian.T)
