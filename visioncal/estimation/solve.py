"""Solving a problem: Levenberg-Marquardt on all unknowns, and the noise's levels by REML."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Self

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.levenberg_marquardt import (
    ITERATIONS,
    NEAR_DAMPING,
    START_DAMPING,
    Linearised,
    levenberg_marquardt,
)
from visioncal.estimation.linalg import (
    covariance_among,
    covariance_from,
    covariance_root,
    damped_step,
    gram,
    squared_lengths,
    weighted_gram,
)
from visioncal.estimation.problem import ANYTHING, Linear, Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.variance import (
    LEAST_SIGMA,
    SETTLED,
    Components,
    PriorInformation,
    RatioPrior,
    WeightedResiduals,
    estimate_sigmas,
)

# After shorter steps of frames [rad and m], first order is off by less than any noise.
_LINEAR = 1e-3
# Shares of the cost by which it still falls at rest, and while the noise is sought.
_ROUNDS, _SETTLED, _NEARLY = 20, 1e-10, 1e-7
# A healthy fit comes to rest within a few steps. One that creeps, as along the flat valley of an
# arm's errors that stand for another cause, gets other levels of noise after so many.
_STEPS = 30
# Noise levels that change by less have settled, far below what is known of them.
_LEVELS_SETTLED = 1e-3
# Arms and cameras err by some 0.6 mm for each mrad, give or take a factor of five.
RATIO_PRIOR = RatioPrior(ratio=0.6, log_sigma=1.5)


def ratio_prior(robots: Iterable[int], first: int = 0) -> RatioPrior:
    """What is known of both levels of some robots, the first one's levels standing at a place."""
    places = tuple((first + 2 * robot, first + 2 * robot + 1) for robot in robots)
    return replace(RATIO_PRIOR, places=places)


# Robots' noise levels are started from above: at least here [rad and m].
_START_SIGMA = 5e-4
# Where they are sought again, it is never from nothing, which no residuals would lift them from.
_ABOVE_NOTHING = 2e-5
# Shares of the levels of rotation and translation that may be left beside errors of an arm.
_LOWER = ((1.0, 1.0), (1.0, 0.25), (0.25, 1.0), (0.25, 0.25))
# A sensor may be this much better or worse than is said of it, at the most.
_SENSOR_RANGE = (1e-3, 1e4)
# Levels below this are none [rad and m].
_FLOOR = 1e-9
# Eigenvalues of the information on a flange below this share of the largest are none.
_NULL = 1e-9


@dataclass(frozen=True, eq=False)
class Solution:
    """The unknowns, the noise, and whether the fit converged."""

    state: State
    noise: Noise
    settled: bool = True


@dataclass(frozen=True, eq=False)
class Reduced:
    """The observations once the flanges' errors have been eliminated, unit by unit.

    Attributes:
        information: (p, p) on the unknowns, whatever the robots do.
        gradient: (p,) half the gradient of the squared error.
        cost: The squared error.
        errors: (u, 6 w) what each unit says of its flanges' errors.
        jacobian: (u, 6 w, p) how that moves with the unknowns.
        covariance: (u, 6 w, 6 w) of it, by the observations alone.
        by_flanges: (u, 6 w, 6 w) how it moves with the flanges themselves: as much, where anything
            was observed of them and the errors are theirs.
    """

    information: FloatArray
    gradient: FloatArray
    cost: float
    errors: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    by_flanges: FloatArray


def starting_noise(problem: Problem) -> Noise:
    """Noise to start from: robots from above, sensors as they are said to be."""
    sensors = int(problem.observations.sensors.max(initial=-1)) + 1
    return Noise(np.full((len(problem.robots), 2), _START_SIGMA), np.ones(sensors))


def fit_problem(problem: Problem, state: State, noise: Noise | None = None) -> Solution:
    """Minimises the whitened residuals, estimating the noise's levels too.

    Args:
        problem: The observations that agree.
        state: Where to start.
        noise: Its levels to start from; those from above where None.
    """
    is_near, given = noise is not None, noise or starting_noise(problem)
    # REML takes residuals as a step to their least would leave them: levels are near before it.
    noise = estimate_noise(problem, state, given, from_above=not is_near)
    is_known = is_near and _alike(given, noise)
    if is_known:
        noise = given
    for turn in range(0 if is_known else _ROUNDS):
        start, before = state, noise
        state, _ = solve_problem(
            problem, start, noise, is_near=is_near or turn > 0, most=_STEPS, settled=_NEARLY
        )
        if state is start:
            break
        noise = estimate_noise(problem, state, noise)
        if _alike(before, noise):
            break
    # Weights are those at the start of a solve: once more, from the answer.
    state, settled = solve_problem(problem, state, noise, is_near=True)
    return Solution(state, noise, settled)


def _alike(before: Noise, after: Noise) -> bool:
    pairs = (before.robots, after.robots), (before.sensors, after.sensors)
    return all(np.allclose(*pair, rtol=_LEVELS_SETTLED, atol=_FLOOR) for pair in pairs)


def solve_problem(
    problem: Problem,
    state: State,
    noise: Noise,
    *,
    is_near: bool = False,
    most: int = ITERATIONS,
    settled: float = _SETTLED,
) -> tuple[State, bool]:
    """Minimises the residuals whitened by a known noise.

    Args:
        problem: The observations.
        state: Where to start.
        noise: The noise.
        is_near: Whether that is the answer under another noise.
        most: So many steps.
        settled: See `levenberg_marquardt`.

    Returns:
        The unknowns, and whether they converged.
    """
    moving = problem.moving
    # Held at the start: weights that follow the unknowns would reward those with large noise.
    whitening = _Whitening.of(problem, noise, problem.ideal_errors(state))

    def linearise(at: State) -> Linearised[State]:
        information, gradient, cost = whitening.equations(problem, at, problem.linear(at))
        free, slope = information[np.ix_(moving, moving)], gradient[moving]

        @cache
        def move(damping: float) -> FloatArray:
            whole = np.zeros(len(moving))
            whole[moving] = damped_step(free, slope, damping)
            return whole

        return Linearised(
            at,
            cost,
            lambda damping: at.moved(move(damping)),
            lambda damping: -float(gradient @ move(damping)),
        )

    damping = NEAR_DAMPING if is_near else START_DAMPING
    return levenberg_marquardt(state, linearise, settled, damping, most)


def solve_without(problem: Problem, fit: Solution, kept: Mask) -> State:
    """Solves for the unknowns without some observations, by one step from the fit of all.

    Args:
        problem: The n observations.
        fit: Their fit, at rest.
        kept: (n,) those that stay.
    """
    linear, moving = problem.linear(fit.state), problem.moving
    whitening = _Whitening.of(problem, fit.noise, problem.ideal_errors(fit.state), kept)
    information, gradient, _ = whitening.equations(problem, fit.state, linear)
    step = np.zeros(len(moving))
    step[moving] = damped_step(information[np.ix_(moving, moving)], gradient[moving], NEAR_DAMPING)
    if np.abs(step[: 6 * len(problem.unknown)]).max() > _LINEAR:
        return solve_problem(problem.subset(kept), fit.state, fit.noise, is_near=True)[0]
    return fit.state.moved(step)


@dataclass(frozen=True, eq=False)
class _Whitening:
    """The inverse of the observations' covariance, with what flanges' errors take of it.

    Attributes:
        weights: (n, 6, 6) the inverse of each one's own noise; of what is alone with its flange's
            error, with that.
        taken: (n, 6 w, 6) of what shares its unit's errors, how it moves these in units of their
            root: summed over the unit and squared, that is taken off.
        units: (n,) these units; -1 where nothing is shared.
        count: How many there are.
    """

    weights: FloatArray
    taken: FloatArray
    units: IntArray
    count: int

    @classmethod
    def of(
        cls, problem: Problem, noise: Noise, by_errors: FloatArray, among: Mask | None = None
    ) -> "_Whitening":
        """The noise of observations that move with (n, 6, 6 w) their units' errors."""
        # Of what is not `among` them nothing is known.
        (of, members), alone = problem.units, problem.alone
        own, errors = problem.covariance(noise), problem.error_covariance(noise)
        single = by_errors[alone]
        own[alone] += single @ errors[of[alone]] @ np.swapaxes(single, 1, 2)
        weights, units = np.asarray(np.linalg.inv(own), dtype=float), np.where(alone, -1, of)
        if among is not None:
            weights[~among] = 0.0
        shared, width = units >= 0, by_errors.shape[2]
        taken = np.zeros((len(weights), width, 6))
        pulled = np.swapaxes(by_errors[shared], 1, 2) @ weights[shared]
        information = np.zeros((len(members), width, width))
        np.add.at(information, units[shared], pulled @ by_errors[shared])
        # Errors of flanges are independent; those of repeats are not.
        roots, first = np.sqrt(np.maximum(errors, 0.0)), len(members) - len(problem.repeats)
        roots[first:] = np.linalg.cholesky(errors[first:])
        turned = np.swapaxes(roots, 1, 2)
        left = np.linalg.cholesky(turned @ information @ roots + np.eye(width))
        taken[shared] = (np.linalg.inv(left) @ turned)[units[shared]] @ pulled
        return cls(weights, taken, units, len(members))

    def equations(
        self, problem: Problem, state: State, linear: Linear
    ) -> tuple[FloatArray, FloatArray, float]:
        """Information (p, p), gradient (p,) of half the whitened squared error, and that error."""
        size, width = linear.size, self.taken.shape[1]
        total, shared = np.zeros((size + 1, size + 1)), np.zeros((self.count, width, size + 1))
        for block in linear.blocks:
            # Residuals are the last column.
            columns, rows = np.append(block.columns, size), block.rows
            every = np.concatenate([block.jacobian, linear.residuals[rows, :, None]], axis=2)
            total[np.ix_(columns, columns)] += gram(every, self.weights[rows] @ every)
            inside = self.units[rows] >= 0
            if not inside.any():
                continue
            rows, every = rows[inside], every[inside]
            order = np.argsort(self.units[rows], kind="stable")
            units, first = np.unique(self.units[rows[order]], return_index=True)
            taken = np.add.reduceat(self.taken[rows[order]] @ every[order], first)
            shared[np.ix_(units, np.arange(width), columns)] += taken
        total -= gram(shared, shared)
        known = problem.prior_information(state)
        return (
            total[:-1, :-1] + known.information,
            total[:-1, -1] + known.gradient,
            float(total[-1, -1]) + problem.prior_cost(state),
        )


def reduce(problem: Problem, state: State, linear: Linear, covariance: FloatArray) -> Reduced:
    """Eliminates the flanges' errors, unit by unit.

    An observation that alone is a unit says what its flange's error is; of several, it is a Schur
    complement.

    Args:
        problem: The problem.
        state: Where it was linearised.
        linear: The residuals there.
        covariance: (n, 6, 6) of the observations' own noise.
    """
    of, members = problem.units
    width, size = linear.by_errors.shape[2], linear.size
    total, alone = np.zeros((size + 1, size + 1)), problem.alone
    own, inverse, blind, by_flanges = np.zeros((4, len(members), width, width))
    cross, answer = np.zeros((2, len(members), width, size + 1))
    for block in linear.blocks:
        # Residuals are the last column.
        columns = np.append(block.columns, size)
        every = np.concatenate([block.jacobian, linear.residuals[block.rows, :, None]], axis=2)
        single = alone[block.rows]
        if single.any():
            rows = block.rows[single]
            turned = np.linalg.inv(linear.by_errors[rows, :, :6])
            answer[np.ix_(of[rows], np.arange(6), columns)] = turned @ every[single]
            by_flanges[of[rows], :6, :6] = turned @ linear.by_flanges[rows, :, :6]
            turned_covariance = turned @ covariance[rows] @ np.swapaxes(turned, 1, 2)
            inverse[of[rows], :6, :6] = turned_covariance
            inverse[of[rows], 6:, 6:] = ANYTHING * np.eye(width - 6)
        rows, every = block.rows[~single], every[~single]
        if not len(rows):
            continue
        weights = np.linalg.inv(covariance[rows])
        weighted = weights @ every
        total[np.ix_(columns, columns)] += gram(every, weighted)
        if of[rows[0]] < 0:
            continue
        order = np.argsort(of[rows], kind="stable")
        units, first = np.unique(of[rows[order]], return_index=True)
        by_errors = linear.by_errors[rows[order]]
        turned = np.swapaxes(by_errors, 1, 2)
        own[units] += np.add.reduceat(turned @ weights[order] @ by_errors, first)
        of_both = np.ix_(units, np.arange(width), columns)
        cross[of_both] += np.add.reduceat(turned @ weighted[order], first)
    joined = np.setdiff1d(np.arange(len(members)), of[alone])
    inverse[joined], blind[joined] = _pseudo_inverse(own[joined])
    answer[joined] = inverse[joined] @ cross[joined]
    by_flanges[joined] = inverse[joined] @ own[joined]
    # A residual is what the flange's error made of it: the error itself has the other sign.
    total = total - gram(cross[joined], answer[joined])
    known = problem.prior_information(state)
    return Reduced(
        total[:-1, :-1] + known.information,
        total[:-1, -1] + known.gradient,
        float(total[-1, -1]) + problem.prior_cost(state),
        answer[:, :, -1],
        answer[:, :, :-1],
        inverse + blind,
        by_flanges,
    )


def _pseudo_inverse(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses (u, w, w) where there is information, and the prior where there is none."""
    values, vectors = np.linalg.eigh(information)
    most = values[:, -1:] if values.shape[1] else values
    seen = values > _NULL * np.maximum(most, np.finfo(float).tiny)
    inverse = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
    turned = np.swapaxes(vectors, 1, 2)
    blind = np.where(seen, 0.0, ANYTHING)
    return (vectors * inverse[:, None, :]) @ turned, (vectors * blind[:, None, :]) @ turned


def _whole(reduced: Reduced, errors: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Information (p, p), gradient (p,) and cost with what the units say, flanges erring."""
    weights = np.linalg.inv(reduced.covariance + errors)
    weighted = weights @ reduced.jacobian
    cost = np.einsum("ui,uij,uj->", reduced.errors, weights, reduced.errors)
    return (
        reduced.information + gram(reduced.jacobian, weighted),
        reduced.gradient + gram(weighted, reduced.errors),
        reduced.cost + float(cost),
    )


def fisher_information(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Fisher information (p, p) on the unknowns, where all chains close exactly.

    At the measured poses their noise would pass for information about directions that the motion
    leaves open.
    """
    return normal_equations(problem, state, noise, ideal=True)[0]


def normal_equations(
    problem: Problem,
    state: State,
    noise: Noise,
    *,
    ideal: bool = False,
    among: Mask | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Information (p, p) and gradient (p,) of half the whitened squared error.

    Args:
        problem: The observations.
        state: The point of linearisation.
        noise: Its levels.
        ideal: See `Problem.linear`.
        among: (n,) the observations that count; all where None.
    """
    return equations_and_cost(problem, state, noise, ideal=ideal, among=among)[:2]


def equations_and_cost(
    problem: Problem,
    state: State,
    noise: Noise,
    *,
    ideal: bool = False,
    among: Mask | None = None,
) -> tuple[FloatArray, FloatArray, float]:
    """What `normal_equations` gives, and the whitened squared error."""
    linear = problem.linear(state, ideal=ideal)
    return _Whitening.of(problem, noise, linear.by_errors, among).equations(problem, state, linear)


def fitted_covariance(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Covariance (p, p) of what a fit moves, where it was measured; zero of all else.

    It is that for tests of residuals, from which the fit has taken so much.
    """
    return covariance_among(normal_equations(problem, state, noise)[0], problem.moving)


def held_shift(problem: Problem, solution: Solution) -> FloatArray:
    """How far the unknowns (p,) would move if what is held moved as well, to first order.

    What is held is wrong by its uncertainty, and by how far the observations pull at it:
    beside the covariance, which counts the former, the square of this shift is the error of
    holding.
    """
    held = problem.counted & ~problem.moving
    if not held.any():
        return np.zeros(problem.size)
    gradient = normal_equations(problem, solution.state, solution.noise)[1]
    return np.asarray(-covariance_of(problem, solution) @ np.where(held, gradient, 0.0))


def covariance_of(problem: Problem, solution: Solution) -> FloatArray:
    """Covariance (p, p) of the unknowns, where all chains close exactly; zero of what is fixed.

    It is that of the result: held values count with what is known of them.
    """
    information = fisher_information(problem, solution.state, solution.noise)
    return covariance_among(information, problem.counted)


def estimate_noise(
    problem: Problem, state: State, noise: Noise, *, from_above: bool = False
) -> Noise:
    """Estimates the noise's levels from the residuals at some state.

    Robots' by restricted likelihood (REML); a sensor's by the share of its residuals that the fit
    has left of it (Foerstner and Wrobel 2016, section 4.2.4), the others being known.

    Args:
        problem: The observations.
        state: The unknowns, near the best ones.
        noise: The levels to start from.
        from_above: Whether robots' levels are to be sought from above what the residuals show,
            since they may be anything: a start that is too low may stay there.
    """
    of_robots = robot_likelihood(problem, state, noise)
    noise = replace(noise, robots=of_robots.levels(from_above=from_above)[0])
    if not len(noise.sensors):
        return noise
    # By the sensors' noise alone, which is still the same.
    squares, left = posterior(problem, state, noise, of_robots.reduced)
    sensors = noise.sensors.copy()
    for at in range(len(sensors)):
        mine = problem.observations.sensors == at
        redundancy = float(left[mine].sum())
        if redundancy > 1.0:
            factor = np.sqrt(float(squares[mine].sum()) / redundancy)
            sensors[at] = np.clip(sensors[at] * factor, *_SENSOR_RANGE)
    if len(problem.least_levels):
        sensors = np.maximum(sensors, problem.least_levels)
    return replace(noise, sensors=sensors)


def robot_levels(
    problem: Problem, state: State, noise: Noise, *, from_above: bool
) -> tuple[FloatArray, float]:
    """Estimates the robots' levels (r, 2); see `estimate_noise`.

    Returns:
        The levels, and the negative restricted log-likelihood there.
    """
    return robot_likelihood(problem, state, noise).levels(from_above=from_above)


@dataclass(frozen=True, eq=False)
class RobotLikelihood:
    """The restricted likelihood of the robots' levels.

    Attributes:
        reduced: What each unit says of its flanges' errors.
        components: What makes up the covariance of that.
        known: What is known of the unknowns that move without these errors.
        moving: (p,) the unknowns that move.
        members: (u, w) the robots of each unit; see `Problem.units`.
        stops: (u,) the stop of each unit that has any.
        before: (r, 2) the levels that the robots had before.
    """

    reduced: Reduced
    components: Components
    known: PriorInformation
    moving: Mask
    members: IntArray
    stops: IntArray
    before: FloatArray
    _weighed: dict[int, tuple[tuple[FloatArray, WeightedResiduals], ...]] = field(
        default_factory=dict, init=False, repr=False
    )

    @cached_property
    def seen(self) -> Mask:
        """(r,) which robots have been observed."""
        return np.isin(np.arange(len(self.before)), self.members)

    @cached_property
    def jacobian(self) -> FloatArray:
        """(u, 6 w, q) how the flanges' errors move with the unknowns that move."""
        return np.ascontiguousarray(self.reduced.jacobian[:, :, self.moving])

    @property
    def rms(self) -> FloatArray:
        """(2,) root mean square of the errors' rotation [rad] and translation [m]."""
        squares = self.reduced.errors.reshape(-1, 2, 3) ** 2
        return np.asarray(np.sqrt(np.mean(squares, axis=(0, 2))))

    def most_likely(
        self,
        start: FloatArray,
        free: Mask,
        least: FloatArray | float = LEAST_SIGMA,
        settled: float = SETTLED,
        enough: float = np.inf,
    ) -> tuple[FloatArray, float]:
        """The most likely levels, and the negative logarithm of their likelihood.

        Args:
            start: (r, 2) the levels to start from; or (2 r + k,) with those of k more components.
            free: (2 r + k,) which of them are sought, robot by robot.
            least: Below which they are not sought.
            settled: See `estimate_sigmas`.
            enough: See `variance.most_likely`.
        """
        sigmas, value = estimate_sigmas(
            self.reduced.errors,
            self.jacobian,
            self.components,
            self.known,
            start.ravel(),
            free,
            ratio_prior(np.flatnonzero(self.seen).tolist()),
            least,
            settled,
            enough,
        )
        return sigmas.reshape(start.shape), value

    def levels(self, *, from_above: bool) -> tuple[FloatArray, float]:
        """The robots' levels (r, 2), as `robot_levels` gives them."""
        if from_above:
            return self.white
        return self._levels(np.maximum(self.before, _ABOVE_NOTHING))

    @cached_property
    def white(self) -> tuple[FloatArray, float]:
        """The levels (r, 2) from above, and the negative logarithm of their likelihood."""
        return self._levels(np.maximum(self.rms, _START_SIGMA) * np.ones_like(self.before))

    def start_beside(self, robot: int, moves: FloatArray) -> tuple[FloatArray, float]:
        """Where to seek the levels beside random effects of a robot's flange, all of one size.

        Effects may make up for most of what the robot's levels are without them, of rotation, of
        translation, or of both: the likeliest of these cases is taken.

        Args:
            robot: The robot, by its place.
            moves: (s, 6, k) by stop, how its flange moves with the effects.

        Returns:
            The levels (r, 2), and the size of the effects; zero where none is likelier.
        """
        mine, moved = (self.members == robot).any(axis=1), self.moved(robot, moves)
        start, least = (self.white[0], 0.0), np.inf
        for levels, weighed in self._weighed_about(robot):
            size, gain = weighed.likely_size(moved, mine)
            if weighed.value - gain < least and (gain > 0.0 or least == np.inf):
                start, least = (levels, size), weighed.value - gain
        return start

    def _weighed_about(self, robot: int) -> tuple[tuple[FloatArray, WeightedResiduals], ...]:
        """What units say, weighed by `white`, and by lower levels of one robot."""
        if robot not in self._weighed:
            lower = np.ones((len(_LOWER), *self.before.shape))
            lower[:, robot] = _LOWER
            every = np.maximum(self.white[0] * lower, LEAST_SIGMA)
            given = self.reduced.errors, self.jacobian, self.components, self.known
            self._weighed[robot] = tuple(
                (levels, WeightedResiduals.of(*given, np.log(levels.ravel()))) for levels in every
            )
        return self._weighed[robot]

    @property
    def negative_log_likelihood(self) -> float:
        """The negative log-likelihood at the most likely levels, with what no level changes."""
        return self.white[1] + 0.5 * self.reduced.cost

    def _levels(self, start: FloatArray) -> tuple[FloatArray, float]:
        if not len(self.components.known):
            return self.before, 0.0
        start = np.where(self.seen[:, None], start, self.before)
        return self.most_likely(start, np.repeat(self.seen, 2))

    def beside(self, robot: int, moves: FloatArray) -> Self:
        """The likelihood with k more unknowns, the last ones, that move a robot's flange.

        What units say of their flanges' errors is all that they say of these: nothing is left of
        them once the errors are eliminated.

        Args:
            robot: The robot, by its place.
            moves: (s, 6, k) by stop, how its flange moves with them.
        """
        reduced, size = self.reduced, moves.shape[2]
        jacobian = np.zeros((*reduced.errors.shape, size))
        jacobian[(self.members == robot).any(axis=1)] = self.moved(robot, moves)
        return replace(
            self,
            reduced=replace(
                reduced,
                information=np.pad(reduced.information, (0, size)),
                gradient=np.pad(reduced.gradient, (0, size)),
                jacobian=np.concatenate([reduced.jacobian, jacobian], axis=2),
            ),
            known=self.known.beside(size),
            moving=np.pad(self.moving, (0, size), constant_values=True),
        )

    def moved(self, robot: int, moves: FloatArray) -> FloatArray:
        """(m, 6 w, k) how what a robot's m units say moves with its flange's `moves` (s, 6, k)."""
        units, slots = np.nonzero(self.members == robot)
        places = 6 * slots[:, None, None] + np.arange(6)
        by_flange = np.take_along_axis(self.reduced.by_flanges[units], places, axis=2)
        return np.asarray(by_flange @ moves[self.stops[units]])

    def scaled(self, robot: int, levels: FloatArray, scales: FloatArray) -> FloatArray:
        """The negative logarithm of the likelihood, up to a constant, as one robot's noise grows.

        In each unit the covariance at the levels and what the robot adds to it are made diagonal
        together; only their ratio then changes with the scale.

        Args:
            robot: The robot.
            levels: (r, 2) all robots' levels.
            scales: (k,) by how much this one's are larger.

        Returns:
            (k,) values.
        """
        total = self.components.total(np.maximum(levels.ravel(), LEAST_SIGMA))
        white = np.linalg.inv(np.linalg.cholesky(total))
        mine = (self.members == robot).any(axis=1)
        added = np.repeat(np.where(self.members == robot, 1.0, 0.0), 6, axis=1)
        added *= np.tile(np.repeat(levels[robot], 3), self.members.shape[1]) ** 2
        shares, axes = np.linalg.eigh((white * added[:, None]) @ np.swapaxes(white, 1, 2))
        white = np.swapaxes(axes, 1, 2) @ white
        jacobian, errors = white @ self.jacobian, (white @ self.reduced.errors[..., None])[..., 0]
        others, left = jacobian[~mine], errors[~mine]
        information = self.known.information + gram(others, others)
        gradient = self.known.gradient + gram(others, left)
        jacobian, errors, found = jacobian[mine], errors[mine], np.empty(len(scales))
        for at, scale in enumerate(scales.tolist()):
            grown = np.maximum(1.0 + (scale**2 - 1.0) * shares[mine], np.finfo(float).tiny)
            weighted = errors / grown
            root = covariance_root(information + weighted_gram(jacobian, 1.0 / grown))
            pull = root.T @ (gradient + gram(jacobian, weighted))
            squares = float(np.sum(errors * weighted) - pull @ pull)
            determinants = float(np.log(grown).sum() - 2.0 * np.linalg.slogdet(root)[1])
            found[at] = 0.5 * (squares + determinants)
        return found


def robot_likelihood(problem: Problem, state: State, noise: Noise) -> RobotLikelihood:
    """The likelihood of the robots' levels, those of the sensors being known."""
    # A fit, its tests and the arms of all robots ask for the same one.
    for there, before, found in problem.last_likelihood:
        is_same = there is state and np.array_equal(before.sensors, noise.sensors)
        if is_same and isinstance(found, RobotLikelihood):
            alike = np.array_equal(before.robots, noise.robots)
            return found if alike else replace(found, before=noise.robots)
    found = _robot_likelihood(problem, state, noise)
    problem.last_likelihood[:] = [(state, noise, found)]
    return found


def _robot_likelihood(problem: Problem, state: State, noise: Noise) -> RobotLikelihood:
    of, members = problem.units
    stops = np.zeros(len(members), dtype=np.int64)
    stops[of[of >= 0]] = problem.observations.stops[of >= 0]
    reduced = reduce(problem, state, problem.linear(state), problem.covariance(noise))
    count, width = len(problem.robots), members.shape[1]
    parts = np.zeros((2 * count, len(members), 6 * width))
    for robot in range(count):
        rows, slots = np.nonzero(members == robot)
        for axis in range(3):
            at = 6 * slots + axis
            parts[2 * robot, rows, at] = parts[2 * robot + 1, rows, at + 3] = 1.0
    moving, known = problem.moving, reduced.covariance.copy()
    if problem.repeats:
        first = len(members) - len(problem.repeats)
        known[first:] += problem.error_covariance(noise)[first:]
    return RobotLikelihood(
        reduced,
        Components(known, parts),
        PriorInformation(reduced.information[np.ix_(moving, moving)], reduced.gradient[moving]),
        moving,
        members,
        stops,
        noise.robots,
    )


def posterior(
    problem: Problem, state: State, noise: Noise, reduced: Reduced
) -> tuple[FloatArray, FloatArray]:
    """What the fit leaves of each observation once its flange's error is known as well as it is.

    Args:
        problem: The observations.
        state: The unknowns.
        noise: Its levels.
        reduced: What `reduce` gives of these.

    Returns:
        (n,) squared residuals in units of their own noise, after the step to their least, and (n,)
        the redundancy of each: how many of its directions were left over to judge by, of which
        those squares are an estimate.
    """
    own = problem.covariance(noise)
    weights, linear = np.linalg.inv(own), problem.linear(state)
    errors = problem.error_covariance(noise)
    information, gradient, _ = _whole(reduced, errors)
    known = covariance_among(information, problem.moving)
    step = -known @ gradient
    of, _ = problem.units
    residuals, gone = linear.residuals.copy(), np.zeros_like(weights)
    # The flanges' errors as their prior and their observations have them together.
    gain = errors @ np.linalg.inv(reduced.covariance + errors)
    flange = (gain @ (reduced.errors + reduced.jacobian @ step)[:, :, None])[:, :, 0]
    # All unknowns move the errors, and few an observation: what both make is by unit.
    taken = gain @ reduced.jacobian
    common = (taken.reshape(-1, taken.shape[2]) @ known).reshape(taken.shape)
    left = errors - gain @ errors + common @ np.swapaxes(taken, 1, 2)
    for block in linear.blocks:
        jacobian, columns = block.jacobian, block.columns
        spread = jacobian.reshape(-1, len(columns)) @ known[np.ix_(columns, columns)]
        gone[block.rows] = spread.reshape(jacobian.shape) @ np.swapaxes(jacobian, 1, 2)
        residuals[block.rows] += jacobian @ step[columns]
        inside = of[block.rows] >= 0
        rows = block.rows[inside]
        by_errors, units = linear.by_errors[rows], of[rows]
        turned = np.swapaxes(by_errors, 1, 2)
        residuals[rows] -= (by_errors @ flange[units][:, :, None])[:, :, 0]
        both = jacobian[inside] @ np.swapaxes(common[:, :, columns][units], 1, 2) @ turned
        gone[rows] += by_errors @ left[units] @ turned - both - np.swapaxes(both, 1, 2)
    squares = np.einsum("ni,nij,nj->n", residuals, weights, residuals)
    directions = np.where(problem.observations.has_rotation, 6.0, 3.0)
    return squares, directions - np.einsum("nij,nji->n", weights, gone)


def mahalanobis_sq(
    problem: Problem, used: Mask, solution: Solution
) -> tuple[FloatArray, FloatArray]:
    """How far each observation is from what the others predict, its flange's error being free.

    For a used one it is the deletion residual's, by the identity of Cook and Weisberg (1982,
    section 2.2).

    Args:
        problem: All n observations.
        used: (n,) those that the fit was made from.
        solution: The unknowns and the noise.

    Returns:
        (n,) squared Mahalanobis distances, and (n,) in how many directions they were measured.
    """
    linear = problem.linear(solution.state)
    information = normal_equations(problem, solution.state, solution.noise, among=used)[0]
    known = covariance_among(information, problem.moving)
    noise = problem.total_covariance(linear, solution.noise)
    left = noise + np.where(used, -1.0, 1.0)[:, None, None] * linear.covariance(known)
    squares, directions = squared_lengths(linear.residuals, left, noise)
    unmeasured = 6 - problem.observations.directions
    return squares, np.asarray(directions - unmeasured, dtype=float)


def left_out_residuals(
    problem: Problem, state: State, noise: Noise, among: Mask | None = None
) -> FloatArray:
    """Residuals (n, 6) of each observation from a fit without it, to first order.

    With it go all that share its flange's error. By the identity of Cook and Weisberg (1982,
    section 2.2), with the noise as it is.

    Args:
        problem: The observations.
        state: The answer.
        noise: Its levels.
        among: (n,) those that are asked for; all where None.
    """
    linear, fitted = problem.linear(state), fitted_covariance(problem, state, noise)
    asked = np.ones(len(problem), dtype=bool) if among is None else among
    found, residuals = np.full((len(problem), 6), np.nan), linear.residuals
    errors, own = problem.error_covariance(noise), problem.covariance(noise)
    alone = asked.copy()
    for unit, rows in problem.shared_units:
        alone[rows] = False
        if not asked[rows].any():
            continue
        by_errors, jacobian = (
            array.reshape(6 * len(rows), -1)
            for array in (linear.by_errors[rows], linear.jacobian_of(rows))
        )
        total = block_diag(*own[rows]) + by_errors @ errors[unit] @ by_errors.T
        without = covariance_from(total - jacobian @ fitted @ jacobian.T)
        found[rows] = (total @ without @ residuals[rows].ravel()).reshape(-1, 6)
    singles = problem.total_covariance(linear, noise)[alone]
    left = singles - linear.covariance(fitted)[alone]
    found[alone] = (singles @ covariance_from(left) @ residuals[alone, :, None])[:, :, 0]
    return found


def whitened(
    problem: Problem,
    state: State,
    noise: Noise,
    measured: Mask | None = None,
    *,
    ideal: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, d) of unit covariance, and their derivatives (n, d, p).

    The squares of the derivatives, summed, are all of the information but what is known beside the
    observations. Rows of one unit are made independent of those before them.

    Args:
        problem: The observations.
        state: The point of linearisation.
        noise: Its levels.
        measured: (6,) the d components of the poses that count; None for all.
        ideal: See `Problem.linear`.
    """
    linear, own = problem.linear(state, ideal=ideal), problem.covariance(noise)
    kept = np.flatnonzero(np.ones(6, dtype=bool) if measured is None else measured)
    rows = np.concatenate([linear.jacobian, linear.residuals[:, :, None]], axis=2)
    rows, by_errors = rows[:, kept], linear.by_errors[:, kept]
    own = own[:, kept][:, :, kept]
    total = problem.total_covariance(linear, noise)[:, kept][:, :, kept]
    found = np.asarray(np.linalg.solve(np.linalg.cholesky(total), rows))
    errors = problem.error_covariance(noise)
    for unit, of in problem.shared_units:
        jacobian = by_errors[of].reshape(len(of) * len(kept), -1)
        among = block_diag(*own[of]) + jacobian @ errors[unit] @ jacobian.T
        flat = rows[of].reshape(len(jacobian), -1)
        found[of] = np.linalg.solve(np.linalg.cholesky(among), flat).reshape(rows[of].shape)
    return found[:, :, -1], found[:, :, :-1]


def by_noise_alone(problem: Problem, solution: Solution) -> FloatArray:
    """Squared distances (n,) from what is predicted, the unknowns being as they are."""
    linear = problem.linear(solution.state)
    total = problem.total_covariance(linear, solution.noise)
    white = np.linalg.solve(total, linear.residuals[:, :, None])[:, :, 0]
    return np.asarray(np.sum(linear.residuals * white, axis=1))


@dataclass(frozen=True, eq=False)
class RepeatErrors:
    """The errors that repeats of one still frame by another share, as q more unknowns.

    Attributes:
        jacobian: (n, 6, q) by them.
        values: (q,) the most likely ones.
        covariance: (p + q, p + q) of all unknowns, these last.
    """

    jacobian: FloatArray
    values: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, problem: Problem, solution: Solution) -> "RepeatErrors":
        """Finds them beside a fit at rest."""
        state, noise, (of, members) = solution.state, solution.noise, problem.units
        known = fitted_covariance(problem, state, noise)
        linear, count = problem.linear(state), len(problem.repeats)
        rows = np.flatnonzero(of >= len(members) - count) if count else np.zeros(0, np.int64)
        places = 6 * (of[rows] - len(members) + count)[:, None] + np.arange(6)
        jacobian = np.zeros((len(problem), 6, 6 * count))
        jacobian[rows[:, None, None], np.arange(6)[:, None], places[:, None]] = linear.by_errors[
            rows, :, :6
        ]
        own = jacobian[rows]
        weighted = np.linalg.solve(problem.covariance(noise)[rows], own)
        prior = problem.error_covariance(noise)[len(members) - count :, :6, :6]
        among = block_diag(*np.linalg.inv(prior)) if count else np.zeros((0, 0))
        inverse = np.linalg.inv(among + gram(weighted, own))
        values = -inverse @ gram(weighted, linear.residuals[rows])
        follow = -inverse @ gram(weighted, linear.jacobian_of(rows))
        beside = known @ follow.T
        whole = np.block([[known, beside], [beside.T, inverse + follow @ beside]])
        return cls(jacobian, values, whole)


def equations_from(
    problem: Problem, solution: Solution, errors: RepeatErrors, asked: IntArray
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Information and gradient of the observations from each stop on, the last first.

    Args:
        problem: The observations.
        solution: The unknowns and the noise.
        errors: What repeats share, which come last among the unknowns.
        asked: (a,) the unknowns that are asked for.

    Yields:
        Each stop with what it and all after it say of these, (a, p + q) and (a,): what is known
        besides does not count.
    """
    state, stops = solution.state, problem.observations.stops
    # What repeats share is an unknown here, and no noise.
    apart, linear = replace(problem, with_repeats=False), problem.linear(state)
    whitening = _Whitening.of(apart, solution.noise, linear.by_errors)
    residuals = linear.residuals + errors.jacobian @ errors.values
    every = np.concatenate([linear.jacobian, errors.jacobian, residuals[:, :, None]], axis=2)
    total = np.zeros((len(asked), every.shape[2]))
    for stop in np.unique(stops)[::-1].tolist():
        mine = np.flatnonzero(stops == stop)
        rows, units = every[mine], whitening.units[mine]
        total = total + gram(rows[:, :, asked], whitening.weights[mine] @ rows)
        for unit in np.unique(units[units >= 0]).tolist():
            together = units == unit
            pulled = np.swapaxes(whitening.taken[mine[together]], 1, 2)
            taken = gram(pulled, rows[together])
            total -= taken[:, asked].T @ taken
        yield stop, total[:, :-1], total[:, -1]
