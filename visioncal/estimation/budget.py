"""Where the uncertainty of a result comes from, and how it looks at a place of work."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.linalg import covariance_among, gram
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Linear, Problem
from visioncal.estimation.solve import fisher_information


@dataclass(frozen=True, eq=False)
class Sources:
    """What the sources of uncertainty are called; those of one name are one.

    Attributes:
        sensors: The noise of what each frame observed, by the frame.
        robots: The error of each robot's flange from stop to stop, by the robot.
        columns: The prior uncertainty of effects, by the source: which of the problem's
            columns these are. Those of no source count for nothing.
        priors: What was measured of frames by hand.
    """

    sensors: Mapping[str, str]
    robots: Mapping[str, str]
    columns: Mapping[str, IntArray] = field(default_factory=dict)
    priors: str = "priors"


def covariance_by_source(
    problem: Problem, state: State, noise: Noise, sources: Sources
) -> dict[str, FloatArray]:
    """Splits the covariance of the edges into the parts that its sources contribute.

    The estimate is linear in the errors of observations, flanges, effects and priors: each
    contributes its own covariance through the same gain, and the parts add up to the whole. What is
    known of effects together hangs together, as of lens and board that are known from the same
    corners: each takes half of what is common, which may leave one of them less than nothing where
    they make up for each other.

    Args:
        problem: The observations.
        state: The answer.
        noise: Its levels.
        sources: What is to be distinguished.

    Returns:
        (6 e, 6 e) by source.
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    linear, own = problem.linear(state, ideal=True), problem.covariance(noise)
    gain = _weighted_jacobian(problem, linear, own, noise) @ fitted[:, : 6 * len(problem.unknown)]
    found: dict[str, FloatArray] = defaultdict(lambda: np.zeros((gain.shape[2],) * 2))
    for frame in dict.fromkeys(problem.observations.observers):
        mine = np.array([observer == frame for observer in problem.observations.observers])
        # Where nothing is known of the observations' own noise, that and the robot's are one.
        if own[mine].any():
            found[sources.sensors[frame]] += gram(gain[mine], own[mine] @ gain[mine])
    for name, part in _by_errors(problem, linear, gain, noise, sources):
        found[name] += part
    carried = fitted[:, : 6 * len(problem.unknown)]
    known = problem.knowledge(state).information
    owned = np.concatenate([*sources.columns.values(), np.zeros(0, np.int64)])
    for prior in problem.priors:
        _, jacobian = problem.prior_rows(prior, state)
        known = known - jacobian.T @ jacobian
        pulled = jacobian @ carried
        found[sources.priors] += pulled.T @ pulled
    for name, columns in sources.columns.items():
        share = np.where(np.isin(owned, columns), 0.5, 0.0)
        part = (share[:, None] + share) * known[np.ix_(owned, owned)]
        found[name] += carried[owned].T @ part @ carried[owned]
    return dict(found)


def less_noise(
    problem: Problem, state: State, noise: Noise, robot: str, white: FloatArray
) -> FloatArray:
    """What a fit's covariance changes by where a robot has another noise than it was weighted with.

    Args:
        problem: The observations.
        state: The answer.
        noise: The levels that it was weighted with.
        robot: The robot.
        white: (2,) its noise, of rotation [rad] and place [m].

    Returns:
        (p, p) among the unknowns.
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    linear, place = problem.linear(state, ideal=True), problem.robots.index(robot)
    gain = _weighted_jacobian(problem, linear, problem.covariance(noise), noise) @ fitted
    mine = _of_flange(problem, linear, gain, place)
    change = np.repeat(white**2 - noise.robots[place] ** 2, 3)
    return gram(mine, change[:, None] * mine)


def _weighted_jacobian(
    problem: Problem, linear: Linear, own: FloatArray, noise: Noise
) -> FloatArray:
    """(n, 6, p) the inverse covariance of all residuals times their Jacobian."""
    found, alone, (of, _) = linear.jacobian, problem.alone, problem.units
    total = problem.total_covariance(linear, noise)
    found[alone] = np.linalg.solve(total[alone], found[alone])
    rest = np.flatnonzero(~alone)
    if not len(rest):
        return found
    weights = np.linalg.inv(own[rest])
    found[rest] = weights @ found[rest]
    errors = problem.error_covariance(noise)
    joined, units = rest[of[rest] >= 0], of[rest][of[rest] >= 0]
    jacobian = linear.by_errors[joined]
    turned = np.swapaxes(jacobian, 1, 2)
    weighted = weights[of[rest] >= 0] @ jacobian
    shape = errors.shape
    known, asked = np.zeros(shape), np.zeros((len(errors), shape[1], linear.size))
    np.add.at(known, units, turned @ weighted)
    np.add.at(asked, units, turned @ found[joined])
    taken = np.linalg.solve(np.eye(shape[1]) + errors @ known, errors @ asked)
    found[joined] -= weighted @ taken[units]
    return found


def _by_errors(
    problem: Problem, linear: Linear, gain: FloatArray, noise: Noise, sources: Sources
) -> list[tuple[str, FloatArray]]:
    """What flanges' errors contribute, and those that repeats share, by their sources."""
    _, members = problem.units
    errors = problem.error_covariance(noise)
    found = []
    for at, robot in enumerate(problem.robots):
        mine = _of_flange(problem, linear, gain, at)
        variances = np.repeat(noise.robots[at] ** 2, 3)
        found.append((sources.robots[robot], gram(mine, variances[:, None] * mine)))
    by_unit = _by_unit(problem, linear, gain)
    first = len(members) - len(problem.repeats)
    for unit, repeated in enumerate(problem.repeats, start=first):
        frame = problem.observations.observers[repeated[0]]
        part = by_unit[unit].T @ errors[unit] @ by_unit[unit]
        found.append((sources.sensors[frame], part))
    return found


def _of_flange(problem: Problem, linear: Linear, gain: FloatArray, robot: int) -> FloatArray:
    """(u, 6, c) how the estimate moves with a robot's flange at each unit that it has a part in."""
    units, slots = np.nonzero(problem.units[1] == robot)
    places = 6 * slots[:, None] + np.arange(6)
    return np.asarray(_by_unit(problem, linear, gain)[units[:, None], places])


def _by_unit(problem: Problem, linear: Linear, gain: FloatArray) -> FloatArray:
    """(u, 6 w, c) how the estimate moves with the errors that the observations of a unit share."""
    of, members = problem.units
    rows = of >= 0
    found = np.zeros((len(members), linear.by_errors.shape[2], gain.shape[2]))
    np.add.at(found, of[rows], np.swapaxes(linear.by_errors[rows], 1, 2) @ gain[rows])
    return found


def radius95(covariance: FloatArray) -> float:
    """Radius of the ball that holds a Gaussian with 95 % (three-moment fit of Imhof 1961)."""
    values = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    first, second, third = (float(np.sum(values**power)) for power in (1, 2, 3))
    if not third > 0.0:
        return 0.0
    freedom = second**3 / third**2
    quantile = (chi2_limit(0.05, freedom) - freedom) * np.sqrt(second / freedom) + first
    return float(np.sqrt(max(quantile, 0.0)))


def point_covariance(edge: FloatArray, covariance: FloatArray, point: FloatArray) -> FloatArray:
    """Covariance of a point that an uncertain transform carries.

    Args:
        edge: (4, 4) `a_from_b`.
        covariance: (6, 6) of its right perturbation (rotation, translation).
        point: (3,) in frame b, exact [m].

    Returns:
        (3, 3) of the point in frame a [m^2].
    """
    slope = edge[:3, :3] @ np.concatenate([-skew(point), np.eye(3)], axis=1)
    return np.asarray(slope @ covariance @ slope.T)
