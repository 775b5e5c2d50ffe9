"""Restricted likelihood (REML) of the robots' noise levels at a fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.mixed import (
    LEAST_SIGMA,
    LITTLE,
    MOST_SIGMA,
    MixedModel,
    PriorInformation,
    SizePrior,
    Units,
)
from visioncal.estimation.normal_equations import reduce
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State

# Lower bound of the initial noise levels of robots [rad and m]: the search starts from above.
START_SIGMA = 5e-4


@dataclass(frozen=True, eq=False)
class RobotLikelihood:
    """Restricted likelihood of the robots' noise levels."""

    by_flanges: FloatArray  # See `Reduced`.
    cost: float  # Likewise.
    # Their likelihood by the free unknowns. The first sizes are the robots' levels of rotation and
    # translation, robot by robot.
    model: MixedModel
    members: IntArray  # (u, w) the robots of each unit; see `Problem.units`.
    stops: IntArray  # (u,) the stop of each unit that has observations.
    before: FloatArray  # (r, 2) the robots' previous levels.

    @cached_property
    def seen(self) -> Mask:
        """(r,) mask of the robots with observations."""
        return np.isin(np.arange(len(self.before)), self.members)

    @property
    def jacobian(self) -> FloatArray:
        """(u, 6 w, q) Jacobian of the flange errors by the free unknowns."""
        return self.model.units.jacobian

    @property
    def rms(self) -> FloatArray:
        """(2,) RMS of the flange errors' rotation [rad] and translation [m]."""
        squares = self.model.units.residuals.reshape(-1, 2, 3) ** 2
        return np.asarray(np.sqrt(np.mean(squares, axis=(0, 2))))

    def most_likely(
        self,
        start: FloatArray,
        free: Mask,
        least: FloatArray | float = LEAST_SIGMA,
        little: float = LITTLE,
    ) -> tuple[FloatArray, float]:
        """Finds the maximum-likelihood levels, and the negative log-likelihood there.

        Args:
            start: (r, 2) initial levels; or (2 r + k,) with k more sizes.
            free: (2 r + k,) mask of the sizes to estimate, robot by robot.
            least: Lower bound of the sizes.
            little: See `mixed.maximised`.
        """
        logs = np.log(np.maximum(start.ravel(), LEAST_SIGMA))
        low, high = (np.where(free, np.log(bound), logs) for bound in (least, MOST_SIGMA))
        found = self.model.maximised(logs, low, high, little)
        return np.exp(found.logs).reshape(start.shape), found.value

    def levels(self, *, from_above: bool) -> FloatArray:
        """Estimates the robots' levels (r, 2); see `estimate_noise`."""
        if from_above:
            return self.white[0]
        # From zero, levels cannot grow.
        return self._levels(np.maximum(self.before, 2e-5))[0]

    @cached_property
    def white(self) -> tuple[FloatArray, float]:
        """Levels (r, 2) from a search from above, and the negative log-likelihood there."""
        return self._levels(np.maximum(self.rms, START_SIGMA) * np.ones_like(self.before))

    def start_beside(self, moved: Sequence[FloatArray], least: FloatArray) -> FloatArray:
        """Initial sigmas (2 r + g,) with g groups of additional random effects.

        The sizes explain all residuals, beside little noise: a search from much noise may stay
        there, with sizes of next to nothing.

        Args:
            moved: (m, 6 w, p) Jacobian of a robot's units by the effects of each group.
            least: (g,) least sizes.
        """
        levels = np.maximum(0.1 * self.rms, LEAST_SIGMA)
        motion = [np.sqrt(np.sum(np.mean(columns[:, :6] ** 2, axis=0))) for columns in moved]
        sizes = np.maximum(least, np.linalg.norm(self.rms) / np.maximum(motion, LEAST_SIGMA))
        return np.append(np.tile(levels, len(self.before)), sizes)

    @property
    def negative_log_likelihood(self) -> float:
        """Negative log-likelihood at the levels `white`, including the cost no level affects."""
        return self.white[1] + 0.5 * self.cost

    def _levels(self, start: FloatArray) -> tuple[FloatArray, float]:
        if not len(self.members):
            return self.before, 0.0
        start = np.where(self.seen[:, None], start, self.before)
        return self.most_likely(start, np.repeat(self.seen, 2))

    def with_moves(
        self,
        robot: int,
        moves: FloatArray,
        shares: FloatArray | None = None,
        typical: FloatArray | None = None,
    ) -> Self:
        """Appends k unknowns that move a robot's flange.

        The unknowns affect the units' flange error estimates only, in which the errors are
        eliminated.

        Args:
            robot: Index of the robot.
            moves: (s, 6, k) Jacobian of its flange by them at each stop.
            shares: (k, g) variance of each by the square of each of g more sizes; flat if None.
            typical: (g,) logarithms of typical sizes, which are their prior within a factor of e;
                no prior if None.
        """
        units, known, count = self.model.units, self.model.common, moves.shape[2]
        jacobian = np.zeros((*units.residuals.shape, count))
        jacobian[(self.members == robot).any(axis=1)] = self.moved(robot, moves)
        units = replace(units, jacobian=np.concatenate([units.jacobian, jacobian], axis=2))
        new_shares, prior = np.zeros((count, 0)) if shares is None else shares, self.model.prior
        # A prior of infinite width is none.
        if prior is not None:
            prior = prior.with_sizes(
                np.zeros(new_shares.shape[1]) if typical is None else typical,
                np.inf if typical is None else 1.0,
            )
        model = replace(
            self.model,
            prior=prior,
            units=units,
            common=PriorInformation(
                np.pad(known.information, (0, count)), np.pad(known.gradient, (0, count))
            ),
            shares=np.asarray(block_diag(self.model.shares, new_shares)),
        )
        return replace(self, model=model)

    def moved(self, robot: int, moves: FloatArray) -> FloatArray:
        """Jacobian (m, 6 w, k) of the estimates of a robot's m units, for `moves` (s, 6, k)."""
        units, slots = np.nonzero(self.members == robot)
        places = 6 * slots[:, None, None] + np.arange(6)
        by_flange = np.take_along_axis(self.by_flanges[units], places, axis=2)
        return np.asarray(by_flange @ moves[self.stops[units]])


def robot_likelihood(problem: Problem, state: State, noise: Noise) -> RobotLikelihood:
    """Restricted likelihood of the robots' levels, with those of the sensors held."""
    # A fit, its tests and the arm models of all robots use the same one.
    for last_state, last_noise, cached in problem.last_likelihood:
        is_same = last_state is state and np.array_equal(last_noise.sensors, noise.sensors)
        if is_same and isinstance(cached, RobotLikelihood):
            alike = np.array_equal(last_noise.robots, noise.robots)
            return cached if alike else replace(cached, before=noise.robots)
    cached = _reduced_likelihood(problem, state, noise)
    problem.last_likelihood[:] = [(state, noise, cached)]
    return cached


def _reduced_likelihood(problem: Problem, state: State, noise: Noise) -> RobotLikelihood:
    unit_of, members = problem.units
    stops = np.zeros(len(members), dtype=np.int64)
    stops[unit_of[unit_of >= 0]] = problem.observations.stops[unit_of >= 0]
    reduced = reduce(problem, state, noise)
    count, width = len(problem.robots), members.shape[1]
    parts = np.zeros((2 * count, len(members), 6 * width, 6 * width))
    for robot in range(count):
        rows, slots = np.nonzero(members == robot)
        for axis in range(3):
            at = 6 * slots + axis
            parts[2 * robot, rows, at, at] = parts[2 * robot + 1, rows, at + 3, at + 3] = 1.0
    moving = problem.moving
    jacobian = np.ascontiguousarray(reduced.jacobian[:, :, moving])
    levels = np.arange(2 * count)
    seen = np.intersect1d(np.arange(count), members).tolist()
    model = MixedModel(
        Units(reduced.errors, jacobian, reduced.covariance, parts, levels),
        PriorInformation(reduced.information[np.ix_(moving, moving)], reduced.gradient[moving]),
        np.zeros((jacobian.shape[2], len(levels))),
        SizePrior.of_ratios([(2 * robot, 2 * robot + 1) for robot in seen], len(levels)),
    )
    return RobotLikelihood(reduced.by_flanges, reduced.cost, model, members, stops, noise.robots)
