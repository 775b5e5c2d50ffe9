"""Uncertainty budget: contributions of the error sources, and uncertainty at a work point."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.linalg import covariance_among, gram
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.normal_equations import Whitening, fisher_information
from visioncal.estimation.problem import Problem
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


@dataclass(frozen=True, eq=False)
class _Gain:
    """Jacobian of the unknowns' estimates by all errors: V^-1 X C."""

    rows: FloatArray  # (n, 6, p) by the observations.
    units: FloatArray  # (u, 6 w, p) by the errors that the observations of a unit share.
    columns: FloatArray  # (p, p) covariance of the unknowns.

    @classmethod
    def of(cls, problem: Problem, state: State, noise: Noise) -> "_Gain":
        """The gain of a problem at a state."""
        columns = covariance_among(fisher_information(problem, state, noise), problem.counted)
        linear = problem.linear(state, ideal=True)
        white = Whitening.of(problem, noise, linear.by_errors)
        rows, unit_of = white.inverse(linear.jacobian @ columns), problem.units[0]
        errors = np.zeros((white.count, linear.by_errors.shape[2], len(columns)))
        in_unit = unit_of >= 0
        by_errors = np.swapaxes(linear.by_errors[in_unit], 1, 2)
        np.add.at(errors, unit_of[in_unit], by_errors @ rows[in_unit])
        return cls(rows, errors, columns)

    def of_flange(self, problem: Problem, robot: int, variances: FloatArray) -> FloatArray:
        """(p, p) contribution of a robot's flange errors of (2,) variances [rad^2, m^2]."""
        units, slots = np.nonzero(problem.units[1] == robot)
        gain = self.units[units[:, None], 6 * slots[:, None] + np.arange(6)]
        return gram(gain, np.repeat(variances, 3)[:, None] * gain)


def covariance_by_source(
    problem: Problem, state: State, noise: Noise, sources: Sources
) -> dict[str, FloatArray]:
    """Splits the covariance of the unknowns into contributions (p, p) of the sources.

    The estimate is linear in the errors of observations, flanges, effects and priors: each
    contributes its own covariance through the same gain, C X' V^-1 V_k V^-1 X C, and the parts add
    up to the total. Priors of effects may be correlated, as of lens and board that are known from
    the same corners: each takes half of the cross terms, which may make one contribution negative
    where they compensate each other.
    """
    gain, sensor_covariance = _Gain.of(problem, state, noise), problem.covariance(noise)
    parts: dict[str, FloatArray] = defaultdict(lambda: np.zeros_like(gain.columns))
    observers = np.array(problem.observations.observers)
    for frame in dict.fromkeys(problem.observations.observers):
        rows = observers == frame
        # If the observations' own noise is unknown, the robot's noise includes it.
        if sensor_covariance[rows].any():
            parts[sources.sensors[frame]] += gram(
                gain.rows[rows], sensor_covariance[rows] @ gain.rows[rows]
            )
    for index, robot in enumerate(problem.robots):
        parts[sources.robots[robot]] += gain.of_flange(problem, index, noise.robots[index] ** 2)
    prior_info = problem.prior_information(state).information
    for prior in problem.priors:
        _, jacobian = problem.prior_rows(prior, state)
        prior_info = prior_info - jacobian.T @ jacobian
        response = jacobian @ gain.columns
        parts["priors"] += response.T @ response
    owned = np.concatenate([*sources.columns.values(), np.zeros(0, np.int64)])
    for name, columns in sources.columns.items():
        share = np.where(np.isin(owned, columns), 0.5, 0.0)
        part = (share[:, None] + share) * prior_info[np.ix_(owned, owned)]
        parts[name] += gain.columns[owned].T @ part @ gain.columns[owned]
    return dict(parts)


def less_noise(
    problem: Problem, state: State, noise: Noise, robot: str, white: FloatArray
) -> FloatArray:
    """Change (p, p) of a fit's covariance if a robot's noise differs from that of the weights.

    `noise` is that of the weights, and `white` (2,) the robot's, of rotation [rad] and position
    [m].
    """
    index = problem.robots.index(robot)
    change = white**2 - noise.robots[index] ** 2
    return _Gain.of(problem, state, noise).of_flange(problem, index, change)
