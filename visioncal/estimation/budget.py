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
        columns: What is open about effects beforehand, by the source: which of the problem's
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
        sources: What is to be told apart.

    Returns:
        (6 e, 6 e) by source.
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    linear, own = problem.linear(state, ideal=True), problem.covariance(noise)
    gain = weighted_jacobian(problem, linear, own, noise) @ fitted[:, : 6 * len(problem.unknown)]
    found: dict[str, FloatArray] = defaultdict(lambda: np.zeros((gain.shape[2],) * 2))
    for frame in dict.fromkeys(problem.observations.observers):
        mine = np.array([it == frame for it in problem.observations.observers])
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


def weighted_jacobian(
    problem: Problem, linear: Linear, own: FloatArray, noise: Noise
) -> FloatArray:
    """The inverse covariance of all residuals times their Jacobian.

    Args:
        problem: The observations.
        linear: Their residuals and Jacobian.
        own: (n, 6, 6) covariances of the observations' own noise.
        noise: The levels.

    Returns:
        (n, 6, p).
    """
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
    told, asked = np.zeros(shape), np.zeros((len(errors), shape[1], linear.size))
    np.add.at(told, units, turned @ weighted)
    np.add.at(asked, units, turned @ found[joined])
    taken = np.linalg.solve(np.eye(shape[1]) + errors @ told, errors @ asked)
    found[joined] -= weighted @ taken[units]
    return found


def _by_errors(
    problem: Problem, linear: Linear, gain: FloatArray, noise: Noise, sources: Sources
) -> list[tuple[str, FloatArray]]:
    """What flanges' errors contribute, and those that repeats share, by their sources."""
    of, members = problem.units
    errors = problem.error_covariance(noise)
    rows = of >= 0
    by_unit = np.zeros((len(members), errors.shape[1], gain.shape[2]))
    np.add.at(by_unit, of[rows], np.swapaxes(linear.by_errors[rows], 1, 2) @ gain[rows])
    found = []
    for at, robot in enumerate(problem.robots):
        units, slots = np.nonzero(members == at)
        places = 6 * slots[:, None] + np.arange(6)
        mine = by_unit[units[:, None], places]
        variances = errors[units[:, None], places, places]
        found.append((sources.robots[robot], gram(mine, variances[:, :, None] * mine)))
    first = len(members) - len(problem.repeats)
    for unit, repeated in enumerate(problem.repeats, start=first):
        frame = problem.observations.observers[repeated[0]]
        part = by_unit[unit].T @ errors[unit] @ by_unit[unit]
        found.append((sources.sensors[frame], part))
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
