"""Solver: Levenberg-Marquardt on all unknowns, with noise levels estimated by REML."""

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

# Steps of frames below this [rad and m] have negligible second-order terms.
_LINEAR = 1e-3
# Iterations of the noise levels; relative decrease of the cost at convergence, and while the noise
# levels still change.
_ROUNDS, _SETTLED, _NEARLY = 20, 1e-10, 1e-7
# A well-posed fit converges within a few steps. One that creeps, such as along the flat valley of
# arm errors that mimic another cause, gets new noise levels after this many.
_STEPS = 30
# Relative change of noise levels at convergence, far below their uncertainty.
_LEVELS_SETTLED = 1e-3
# Typical translation to rotation noise of arms and cameras [m/rad], within a factor of five.
RATIO_PRIOR = RatioPrior(ratio=0.6, log_sigma=1.5)


def ratio_prior(robots: Iterable[int], first: int = 0) -> RatioPrior:
    """Prior of the ratio of both noise levels of robots, whose levels begin at index `first`."""
    places = tuple((first + 2 * robot, first + 2 * robot + 1) for robot in robots)
    return replace(RATIO_PRIOR, places=places)


# Lower bound of the initial noise levels of robots [rad and m]: the search starts from above.
_START_SIGMA = 5e-4
# Lower bound of the initial levels of a repeated search: from zero, levels cannot grow.
_ABOVE_NOTHING = 2e-5
# Factors of the rotation and translation levels tried as start values beside errors of an arm.
_LOWER = ((1.0, 1.0), (1.0, 0.25), (0.25, 1.0), (0.25, 0.25))
# Bounds of a sensor's noise relative to its stated noise.
_SENSOR_RANGE = (1e-3, 1e4)
# Levels below this count as zero [rad and m].
_FLOOR = 1e-9
# Eigenvalues of the information on a flange below this share of the largest count as zero.
_NULL = 1e-9


@dataclass(frozen=True, eq=False)
class Solution:
    """Estimated unknowns and noise levels, and whether the fit converged."""

    state: State
    noise: Noise
    settled: bool = True


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations with the flanges' errors eliminated, unit by unit.

    Attributes:
        information: (p, p) on the unknowns, with the flanges' errors unconstrained.
        gradient: (p,) half the gradient of the squared error.
        cost: The squared error.
        errors: (u, 6 w) estimate of each unit's flange errors.
        jacobian: (u, 6 w, p) of these estimates by the unknowns.
        covariance: (u, 6 w, 6 w) of these estimates, from the observations' noise alone.
        by_flanges: (u, 6 w, 6 w) Jacobian of these estimates by the flange poses: the identity
            where the flanges were observed and the errors are their own.
    """

    information: FloatArray
    gradient: FloatArray
    cost: float
    errors: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    by_flanges: FloatArray


def starting_noise(problem: Problem) -> Noise:
    """Initial noise: robots from above, sensors as stated."""
    sensors = int(problem.observations.sensors.max(initial=-1)) + 1
    return Noise(np.full((len(problem.robots), 2), _START_SIGMA), np.ones(sensors))


def fit_problem(problem: Problem, state: State, noise: Noise | None = None) -> Solution:
    """Minimises the whitened residuals and estimates the noise levels.

    Args:
        problem: The inlier observations.
        state: Initial unknowns.
        noise: Initial noise levels; `starting_noise` if None.
    """
    is_near, given = noise is not None, noise or starting_noise(problem)
    # REML includes one linear step of the unknowns, so levels are close before the first solve.
    noise = estimate_noise(problem, state, given, from_above=not is_near)
    is_unchanged = is_near and _are_close(given, noise)
    if is_unchanged:
        noise = given
    for turn in range(0 if is_unchanged else _ROUNDS):
        start, previous = state, noise
        state, _ = solve_problem(
            problem, start, noise, is_near=is_near or turn > 0, most=_STEPS, settled=_NEARLY
        )
        if state is start:
            break
        noise = estimate_noise(problem, state, noise)
        if _are_close(previous, noise):
            break
    # A solve keeps the weights of its start: solve once more from the solution.
    state, settled = solve_problem(problem, state, noise, is_near=True)
    return Solution(state, noise, settled)


def _are_close(before: Noise, after: Noise) -> bool:
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
    """Minimises the residuals whitened by a given noise.

    Args:
        problem: The observations.
        state: Initial unknowns.
        noise: Noise levels.
        is_near: Whether the start is already a solution under other weights.
        most: Maximum number of steps.
        settled: See `levenberg_marquardt`.

    Returns:
        The unknowns, and whether the iteration converged.
    """
    moving = problem.moving
    # Weights are held: if they followed the unknowns, states with large noise would be favoured.
    whitening = _Whitening.of(problem, noise, problem.ideal_errors(state))

    def linearise(at: State) -> Linearised[State]:
        information, gradient, cost = whitening.equations(problem, at, problem.linear(at))
        free, free_gradient = information[np.ix_(moving, moving)], gradient[moving]

        @cache
        def step_of(damping: float) -> FloatArray:
            step = np.zeros(len(moving))
            step[moving] = damped_step(free, free_gradient, damping)
            return step

        return Linearised(
            at,
            cost,
            lambda damping: at.moved(step_of(damping)),
            lambda damping: -float(gradient @ step_of(damping)),
        )

    damping = NEAR_DAMPING if is_near else START_DAMPING
    return levenberg_marquardt(state, linearise, settled, damping, most)


def solve_without(problem: Problem, fit: Solution, kept: Mask) -> State:
    """Solves for the unknowns without some observations, by one step from the converged fit of all.

    Args:
        problem: The n observations.
        fit: Their converged fit.
        kept: (n,) mask of the observations that remain.
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
    """Inverse of the observations' covariance, block diagonal less a low-rank part for each unit.

    Attributes:
        weights: (n, 6, 6) inverse covariance of each observation's own noise, including its
            flange's error if no other observation shares that.
        taken: (n, 6 w, 6) factors of the Schur complement for shared flange errors: the square of
            their product with the observations, summed over a unit, is subtracted.
        units: (n,) unit of each observation; -1 if it shares no errors.
        count: Number of units.
    """

    weights: FloatArray
    taken: FloatArray
    units: IntArray
    count: int

    @classmethod
    def of(
        cls, problem: Problem, noise: Noise, by_errors: FloatArray, among: Mask | None = None
    ) -> "_Whitening":
        """Whitens observations with Jacobian (n, 6, 6 w) by their units' errors."""
        # Observations not in `among` get zero weight.
        (unit_of, members), alone = problem.units, problem.alone
        own, errors = problem.covariance(noise), problem.error_covariance(noise)
        jacobian = by_errors[alone]
        own[alone] += jacobian @ errors[unit_of[alone]] @ np.swapaxes(jacobian, 1, 2)
        weights, units = np.asarray(np.linalg.inv(own), dtype=float), np.where(alone, -1, unit_of)
        if among is not None:
            weights[~among] = 0.0
        shared, width = units >= 0, by_errors.shape[2]
        taken = np.zeros((len(weights), width, 6))
        weighted = np.swapaxes(by_errors[shared], 1, 2) @ weights[shared]
        information = np.zeros((len(members), width, width))
        np.add.at(information, units[shared], weighted @ by_errors[shared])
        # Errors of flanges are independent; those of repeats are not.
        roots, first = np.sqrt(np.maximum(errors, 0.0)), len(members) - len(problem.repeats)
        roots[first:] = np.linalg.cholesky(errors[first:])
        transposed = np.swapaxes(roots, 1, 2)
        factor = np.linalg.cholesky(transposed @ information @ roots + np.eye(width))
        taken[shared] = (np.linalg.inv(factor) @ transposed)[units[shared]] @ weighted
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
            augmented = np.concatenate([block.jacobian, linear.residuals[rows, :, None]], axis=2)
            total[np.ix_(columns, columns)] += gram(augmented, self.weights[rows] @ augmented)
            is_shared = self.units[rows] >= 0
            if not is_shared.any():
                continue
            rows, augmented = rows[is_shared], augmented[is_shared]
            order = np.argsort(self.units[rows], kind="stable")
            units, first = np.unique(self.units[rows[order]], return_index=True)
            taken = np.add.reduceat(self.taken[rows[order]] @ augmented[order], first)
            shared[np.ix_(units, np.arange(width), columns)] += taken
        total -= gram(shared, shared)
        prior = problem.prior_information(state)
        return (
            total[:-1, :-1] + prior.information,
            total[:-1, -1] + prior.gradient,
            float(total[-1, -1]) + problem.prior_cost(state),
        )


def reduce(problem: Problem, state: State, linear: Linear, covariance: FloatArray) -> Reduced:
    """Eliminates the flanges' errors, unit by unit.

    A unit of a single observation is inverted for its flange's error; larger units are eliminated
    by a Schur complement.

    Args:
        problem: The problem.
        state: The linearisation point.
        linear: The linearised residuals.
        covariance: (n, 6, 6) of the observations' own noise.
    """
    unit_of, members = problem.units
    width, size = linear.by_errors.shape[2], linear.size
    total, alone = np.zeros((size + 1, size + 1)), problem.alone
    own, inverse, null_variance, by_flanges = np.zeros((4, len(members), width, width))
    cross, solved = np.zeros((2, len(members), width, size + 1))
    for block in linear.blocks:
        # Residuals are the last column.
        columns = np.append(block.columns, size)
        augmented = np.concatenate([block.jacobian, linear.residuals[block.rows, :, None]], axis=2)
        single = alone[block.rows]
        if single.any():
            rows = block.rows[single]
            turned = np.linalg.inv(linear.by_errors[rows, :, :6])
            solved[np.ix_(unit_of[rows], np.arange(6), columns)] = turned @ augmented[single]
            by_flanges[unit_of[rows], :6, :6] = turned @ linear.by_flanges[rows, :, :6]
            turned_covariance = turned @ covariance[rows] @ np.swapaxes(turned, 1, 2)
            inverse[unit_of[rows], :6, :6] = turned_covariance
            inverse[unit_of[rows], 6:, 6:] = ANYTHING * np.eye(width - 6)
        rows, augmented = block.rows[~single], augmented[~single]
        if not len(rows):
            continue
        weights = np.linalg.inv(covariance[rows])
        weighted = weights @ augmented
        total[np.ix_(columns, columns)] += gram(augmented, weighted)
        if unit_of[rows[0]] < 0:
            continue
        order = np.argsort(unit_of[rows], kind="stable")
        units, first = np.unique(unit_of[rows[order]], return_index=True)
        by_errors = linear.by_errors[rows[order]]
        turned = np.swapaxes(by_errors, 1, 2)
        own[units] += np.add.reduceat(turned @ weights[order] @ by_errors, first)
        entries = np.ix_(units, np.arange(width), columns)
        cross[entries] += np.add.reduceat(turned @ weighted[order], first)
    multiple = np.setdiff1d(np.arange(len(members)), unit_of[alone])
    inverse[multiple], null_variance[multiple] = _pseudo_inverse(own[multiple])
    solved[multiple] = inverse[multiple] @ cross[multiple]
    by_flanges[multiple] = inverse[multiple] @ own[multiple]
    # The estimated error has the opposite sign of the residual that it causes.
    total = total - gram(cross[multiple], solved[multiple])
    known = problem.prior_information(state)
    return Reduced(
        total[:-1, :-1] + known.information,
        total[:-1, -1] + known.gradient,
        float(total[-1, -1]) + problem.prior_cost(state),
        solved[:, :, -1],
        solved[:, :, :-1],
        inverse + null_variance,
        by_flanges,
    )


def _pseudo_inverse(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pseudo-inverses (u, w, w), and the variance `ANYTHING` on the null spaces."""
    values, vectors = np.linalg.eigh(information)
    most = values[:, -1:] if values.shape[1] else values
    determined = values > _NULL * np.maximum(most, np.finfo(float).tiny)
    inverse = np.where(determined, 1.0 / np.where(determined, values, 1.0), 0.0)
    transposed = np.swapaxes(vectors, 1, 2)
    null = np.where(determined, 0.0, ANYTHING)
    return (vectors * inverse[:, None, :]) @ transposed, (vectors * null[:, None, :]) @ transposed


def _total_equations(reduced: Reduced, errors: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Information (p, p), gradient (p,) and cost for (u, 6 w, 6 w) flange error covariances."""
    weights = np.linalg.inv(reduced.covariance + errors)
    weighted = weights @ reduced.jacobian
    cost = np.einsum("ui,uij,uj->", reduced.errors, weights, reduced.errors)
    return (
        reduced.information + gram(reduced.jacobian, weighted),
        reduced.gradient + gram(weighted, reduced.errors),
        reduced.cost + float(cost),
    )


def fisher_information(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Fisher information (p, p) on the unknowns, at poses for which all chains close exactly.

    At the measured poses, noise would appear as information on directions that the motion leaves
    undetermined.
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
        state: The linearisation point.
        noise: Noise levels.
        ideal: See `Problem.linear`.
        among: (n,) mask of the observations to include; all if None.
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
    """`normal_equations`, and the whitened squared error."""
    linear = problem.linear(state, ideal=ideal)
    return _Whitening.of(problem, noise, linear.by_errors, among).equations(problem, state, linear)


def fitted_covariance(problem: Problem, state: State, noise: Noise) -> FloatArray:
    """Covariance (p, p) of the fitted unknowns, at the measured poses; zero for held ones.

    It serves residual tests: it is what the fit absorbed of the residuals' covariance.
    """
    return covariance_among(normal_equations(problem, state, noise)[0], problem.moving)


def held_shift(problem: Problem, solution: Solution) -> FloatArray:
    """First-order shift (p,) of the unknowns if the held ones were estimated as well.

    Held values are wrong by their uncertainty, which the covariance includes, and by the shift that
    the observations imply: the square of this shift is the additional error of holding them.
    """
    held = problem.counted & ~problem.moving
    if not held.any():
        return np.zeros(problem.size)
    gradient = normal_equations(problem, solution.state, solution.noise)[1]
    return np.asarray(-covariance_of(problem, solution) @ np.where(held, gradient, 0.0))


def covariance_of(problem: Problem, solution: Solution) -> FloatArray:
    """Covariance (p, p) of the unknowns, at poses for which all chains close; zero for fixed ones.

    It is the uncertainty of the result: held values contribute with their prior.
    """
    information = fisher_information(problem, solution.state, solution.noise)
    return covariance_among(information, problem.counted)


def estimate_noise(
    problem: Problem, state: State, noise: Noise, *, from_above: bool = False
) -> Noise:
    """Estimates the noise levels from the residuals at a state.

    Robots' levels by restricted likelihood (REML); then each sensor's by its squared residuals over
    their redundancy (Foerstner and Wrobel 2016, section 4.2.4), with the others held.

    Args:
        problem: The observations.
        state: The unknowns, near the optimum.
        noise: Initial levels.
        from_above: Whether the search for robots' levels starts above the residuals instead of at
            the initial levels: a search from too low a start may stay there.
    """
    robots = robot_likelihood(problem, state, noise)
    noise = replace(noise, robots=robots.levels(from_above=from_above)[0])
    if not len(noise.sensors):
        return noise
    # The reduction depends on the sensors' noise only, which has not changed yet.
    squares, redundancies = posterior(problem, state, noise, robots.reduced)
    sensors = noise.sensors.copy()
    for sensor in range(len(sensors)):
        observed = problem.observations.sensors == sensor
        redundancy = float(redundancies[observed].sum())
        if redundancy > 1.0:
            factor = np.sqrt(float(squares[observed].sum()) / redundancy)
            sensors[sensor] = np.clip(sensors[sensor] * factor, *_SENSOR_RANGE)
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
    """Restricted likelihood of the robots' noise levels.

    Attributes:
        reduced: The estimates of each unit's flange errors.
        components: Variance components of these estimates.
        known: Information on the free unknowns from other sources than these estimates.
        moving: (p,) mask of the free unknowns.
        members: (u, w) the robots of each unit; see `Problem.units`.
        stops: (u,) the stop of each unit that has observations.
        before: (r, 2) the robots' previous levels.
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
        """(r,) mask of the robots with observations."""
        return np.isin(np.arange(len(self.before)), self.members)

    @cached_property
    def jacobian(self) -> FloatArray:
        """(u, 6 w, q) Jacobian of the flange errors by the free unknowns."""
        return np.ascontiguousarray(self.reduced.jacobian[:, :, self.moving])

    @property
    def rms(self) -> FloatArray:
        """(2,) RMS of the flange errors' rotation [rad] and translation [m]."""
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
        """Finds the maximum-likelihood levels, and the negative log-likelihood there.

        Args:
            start: (r, 2) initial levels; or (2 r + k,) with those of k more components.
            free: (2 r + k,) mask of the levels to estimate, robot by robot.
            least: Lower bound of the levels.
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
        """Estimates the robots' levels (r, 2); see `robot_levels`."""
        if from_above:
            return self.white
        return self._levels(np.maximum(self.before, _ABOVE_NOTHING))

    @cached_property
    def white(self) -> tuple[FloatArray, float]:
        """Levels (r, 2) from a search from above, and the negative log-likelihood there."""
        return self._levels(np.maximum(self.rms, _START_SIGMA) * np.ones_like(self.before))

    def start_beside(self, robot: int, moves: FloatArray) -> tuple[FloatArray, float]:
        """Initial levels with additional random effects, of equal variance, on a robot's flange.

        Effects may explain most of the robot's rotation level, translation level, or both: the
        case of the highest likelihood is returned.

        Args:
            robot: Index of the robot.
            moves: (s, 6, k) Jacobian of its flange by the effects at each stop.

        Returns:
            The levels (r, 2), and the size of the effects; zero if none raises the likelihood.
        """
        mine, moved = (self.members == robot).any(axis=1), self.moved(robot, moves)
        start, least = (self.white[0], 0.0), np.inf
        for levels, weighed in self._weighed_about(robot):
            size, gain = weighed.likely_size(moved, mine)
            if weighed.value - gain < least and (gain > 0.0 or least == np.inf):
                start, least = (levels, size), weighed.value - gain
        return start

    def _weighed_about(self, robot: int) -> tuple[tuple[FloatArray, WeightedResiduals], ...]:
        """Fits at the levels `white`, and at lower levels of one robot."""
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
        """Negative log-likelihood at the levels `white`, including the cost no level affects."""
        return self.white[1] + 0.5 * self.reduced.cost

    def _levels(self, start: FloatArray) -> tuple[FloatArray, float]:
        if not len(self.components.known):
            return self.before, 0.0
        start = np.where(self.seen[:, None], start, self.before)
        return self.most_likely(start, np.repeat(self.seen, 2))

    def beside(self, robot: int, moves: FloatArray) -> Self:
        """Appends k unknowns that move a robot's flange.

        They affect the units' flange error estimates only: `reduced.information` has nothing on
        them, since the errors are eliminated there.

        Args:
            robot: Index of the robot.
            moves: (s, 6, k) Jacobian of its flange by them at each stop.
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
        """Jacobian (m, 6 w, k) of the estimates of a robot's m units, for `moves` (s, 6, k)."""
        units, slots = np.nonzero(self.members == robot)
        places = 6 * slots[:, None, None] + np.arange(6)
        by_flange = np.take_along_axis(self.reduced.by_flanges[units], places, axis=2)
        return np.asarray(by_flange @ moves[self.stops[units]])

    def scaled(self, robot: int, levels: FloatArray, scales: FloatArray) -> FloatArray:
        """Negative log-likelihood, up to a constant, for scaled noise levels of one robot.

        In each unit the total covariance and the robot's part of it are diagonalised together; only
        their ratio then changes with the scale.

        Args:
            robot: Index of the robot.
            levels: (r, 2) all robots' levels.
            scales: (k,) factors of this robot's levels.

        Returns:
            (k,) values.
        """
        total = self.components.total(np.maximum(levels.ravel(), LEAST_SIGMA))
        white = np.linalg.inv(np.linalg.cholesky(total))
        own = (self.members == robot).any(axis=1)
        added = np.repeat(np.where(self.members == robot, 1.0, 0.0), 6, axis=1)
        added *= np.tile(np.repeat(levels[robot], 3), self.members.shape[1]) ** 2
        shares, axes = np.linalg.eigh((white * added[:, None]) @ np.swapaxes(white, 1, 2))
        white = np.swapaxes(axes, 1, 2) @ white
        jacobian, errors = white @ self.jacobian, (white @ self.reduced.errors[..., None])[..., 0]
        others, other_errors = jacobian[~own], errors[~own]
        information = self.known.information + gram(others, others)
        gradient = self.known.gradient + gram(others, other_errors)
        jacobian, errors, values = jacobian[own], errors[own], np.empty(len(scales))
        for index, scale in enumerate(scales.tolist()):
            grown = np.maximum(1.0 + (scale**2 - 1.0) * shares[own], np.finfo(float).tiny)
            weighted = errors / grown
            root = covariance_root(information + weighted_gram(jacobian, 1.0 / grown))
            projected = root.T @ (gradient + gram(jacobian, weighted))
            squares = float(np.sum(errors * weighted) - projected @ projected)
            determinants = float(np.log(grown).sum() - 2.0 * np.linalg.slogdet(root)[1])
            values[index] = 0.5 * (squares + determinants)
        return values


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
    reduced = reduce(problem, state, problem.linear(state), problem.covariance(noise))
    count, width = len(problem.robots), members.shape[1]
    parts = np.zeros((2 * count, len(members), 6 * width))
    for robot in range(count):
        rows, slots = np.nonzero(members == robot)
        for axis in range(3):
            at = 6 * slots + axis
            parts[2 * robot, rows, at] = parts[2 * robot + 1, rows, at + 3] = 1.0
    moving, covariance = problem.moving, reduced.covariance.copy()
    if problem.repeats:
        first = len(members) - len(problem.repeats)
        covariance[first:] += problem.error_covariance(noise)[first:]
    return RobotLikelihood(
        reduced,
        Components(covariance, parts),
        PriorInformation(reduced.information[np.ix_(moving, moving)], reduced.gradient[moving]),
        moving,
        members,
        stops,
        noise.robots,
    )


def posterior(
    problem: Problem, state: State, noise: Noise, reduced: Reduced
) -> tuple[FloatArray, FloatArray]:
    """Squared posterior residuals of the observations, and their redundancies.

    Args:
        problem: The observations.
        state: The unknowns.
        noise: Noise levels.
        reduced: Result of `reduce` for these.

    Returns:
        (n,) squared residuals in units of their own noise, after a Gauss-Newton step and less the
        estimated flange errors, and (n,) their redundancies, the expected values of the squares.
    """
    own = problem.covariance(noise)
    weights, linear = np.linalg.inv(own), problem.linear(state)
    errors = problem.error_covariance(noise)
    information, gradient, _ = _total_equations(reduced, errors)
    fitted = covariance_among(information, problem.moving)
    step = -fitted @ gradient
    unit_of, _ = problem.units
    residuals, absorbed = linear.residuals.copy(), np.zeros_like(weights)
    # Posterior of the flange errors from their prior and their observations.
    gain = errors @ np.linalg.inv(reduced.covariance + errors)
    flange_errors = (gain @ (reduced.errors + reduced.jacobian @ step)[:, :, None])[:, :, 0]
    # Flange errors depend on all unknowns, an observation on few: this product is formed by unit.
    response = gain @ reduced.jacobian
    common = (response.reshape(-1, response.shape[2]) @ fitted).reshape(response.shape)
    remaining = errors - gain @ errors + common @ np.swapaxes(response, 1, 2)
    for block in linear.blocks:
        jacobian, columns = block.jacobian, block.columns
        products = jacobian.reshape(-1, len(columns)) @ fitted[np.ix_(columns, columns)]
        absorbed[block.rows] = products.reshape(jacobian.shape) @ np.swapaxes(jacobian, 1, 2)
        residuals[block.rows] += jacobian @ step[columns]
        in_unit = unit_of[block.rows] >= 0
        rows = block.rows[in_unit]
        by_errors, units = linear.by_errors[rows], unit_of[rows]
        transposed = np.swapaxes(by_errors, 1, 2)
        residuals[rows] -= (by_errors @ flange_errors[units][:, :, None])[:, :, 0]
        cross = jacobian[in_unit] @ np.swapaxes(common[:, :, columns][units], 1, 2) @ transposed
        absorbed[rows] += (
            by_errors @ remaining[units] @ transposed - cross - np.swapaxes(cross, 1, 2)
        )
    squares = np.einsum("ni,nij,nj->n", residuals, weights, residuals)
    directions = np.where(problem.observations.has_rotation, 6.0, 3.0)
    return squares, directions - np.einsum("nij,nji->n", weights, absorbed)


def mahalanobis_sq(
    problem: Problem, used: Mask, solution: Solution
) -> tuple[FloatArray, FloatArray]:
    """Mahalanobis distances of observations from their prediction, flange error included as noise.

    For an observation in the fit it is that of the deletion residual, by the identity of Cook and
    Weisberg (1982, section 2.2).

    Args:
        problem: All n observations.
        used: (n,) mask of the observations in the fit.
        solution: The unknowns and the noise.

    Returns:
        (n,) squared Mahalanobis distances, and (n,) their degrees of freedom.
    """
    linear = problem.linear(solution.state)
    information = normal_equations(problem, solution.state, solution.noise, among=used)[0]
    fitted = covariance_among(information, problem.moving)
    noise = problem.total_covariance(linear, solution.noise)
    covariance = noise + np.where(used, -1.0, 1.0)[:, None, None] * linear.covariance(fitted)
    squares, directions = squared_lengths(linear.residuals, covariance, noise)
    unmeasured = 6 - problem.observations.directions
    return squares, np.asarray(directions - unmeasured, dtype=float)


def left_out_residuals(
    problem: Problem, state: State, noise: Noise, among: Mask | None = None
) -> FloatArray:
    """Deletion residuals (n, 6): of each observation from a fit without it, to first order.

    All observations that share its flange's error are left out with it. By the identity of Cook and
    Weisberg (1982, section 2.2), with the noise levels held.

    Args:
        problem: The observations.
        state: The solution.
        noise: Noise levels.
        among: (n,) mask of the observations to compute; all if None. NaN for the others.
    """
    linear, fitted = problem.linear(state), fitted_covariance(problem, state, noise)
    wanted = np.ones(len(problem), dtype=bool) if among is None else among
    deletion, residuals = np.full((len(problem), 6), np.nan), linear.residuals
    errors, own = problem.error_covariance(noise), problem.covariance(noise)
    alone = wanted.copy()
    for unit, rows in problem.shared_units:
        alone[rows] = False
        if not wanted[rows].any():
            continue
        by_errors, jacobian = (
            array.reshape(6 * len(rows), -1)
            for array in (linear.by_errors[rows], linear.jacobian_of(rows))
        )
        total = block_diag(*own[rows]) + by_errors @ errors[unit] @ by_errors.T
        inverse = covariance_from(total - jacobian @ fitted @ jacobian.T)
        deletion[rows] = (total @ inverse @ residuals[rows].ravel()).reshape(-1, 6)
    singles = problem.total_covariance(linear, noise)[alone]
    remaining = singles - linear.covariance(fitted)[alone]
    deletion[alone] = (singles @ covariance_from(remaining) @ residuals[alone, :, None])[:, :, 0]
    return deletion


def whitened(
    problem: Problem,
    state: State,
    noise: Noise,
    measured: Mask | None = None,
    *,
    ideal: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals (n, d) and their Jacobian (n, d, p).

    The Gram matrix of the Jacobian is the information without the priors. Rows of a unit are
    decorrelated from those before them.

    Args:
        problem: The observations.
        state: The linearisation point.
        noise: Noise levels.
        measured: (6,) mask of the d pose components to include; None for all.
        ideal: See `Problem.linear`.
    """
    linear, own = problem.linear(state, ideal=ideal), problem.covariance(noise)
    kept = np.flatnonzero(np.ones(6, dtype=bool) if measured is None else measured)
    rows = np.concatenate([linear.jacobian, linear.residuals[:, :, None]], axis=2)
    rows, by_errors = rows[:, kept], linear.by_errors[:, kept]
    own = own[:, kept][:, :, kept]
    total = problem.total_covariance(linear, noise)[:, kept][:, :, kept]
    white = np.asarray(np.linalg.solve(np.linalg.cholesky(total), rows))
    errors = problem.error_covariance(noise)
    for unit, members in problem.shared_units:
        jacobian = by_errors[members].reshape(len(members) * len(kept), -1)
        covariance = block_diag(*own[members]) + jacobian @ errors[unit] @ jacobian.T
        flat = rows[members].reshape(len(jacobian), -1)
        white[members] = np.linalg.solve(np.linalg.cholesky(covariance), flat).reshape(
            rows[members].shape
        )
    return white[:, :, -1], white[:, :, :-1]


def by_noise_alone(problem: Problem, solution: Solution) -> FloatArray:
    """Squared Mahalanobis distances (n,) of the residuals by the noise alone, unknowns held."""
    linear = problem.linear(solution.state)
    total = problem.total_covariance(linear, solution.noise)
    white = np.linalg.solve(total, linear.residuals[:, :, None])[:, :, 0]
    return np.asarray(np.sum(linear.residuals * white, axis=1))


@dataclass(frozen=True, eq=False)
class RepeatErrors:
    """Errors shared by repeats of one static frame seen by another, as q additional unknowns.

    Attributes:
        jacobian: (n, 6, q) of the residuals by these errors.
        values: (q,) maximum-posterior estimates.
        covariance: (p + q, p + q) of all unknowns, these last.
    """

    jacobian: FloatArray
    values: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, problem: Problem, solution: Solution) -> "RepeatErrors":
        """Estimates them at a converged fit."""
        state, noise, (unit_of, members) = solution.state, solution.noise, problem.units
        fitted = fitted_covariance(problem, state, noise)
        linear, count = problem.linear(state), len(problem.repeats)
        rows = np.flatnonzero(unit_of >= len(members) - count) if count else np.zeros(0, np.int64)
        places = 6 * (unit_of[rows] - len(members) + count)[:, None] + np.arange(6)
        jacobian = np.zeros((len(problem), 6, 6 * count))
        jacobian[rows[:, None, None], np.arange(6)[:, None], places[:, None]] = linear.by_errors[
            rows, :, :6
        ]
        own = jacobian[rows]
        weighted = np.linalg.solve(problem.covariance(noise)[rows], own)
        prior = problem.error_covariance(noise)[len(members) - count :, :6, :6]
        prior_information = block_diag(*np.linalg.inv(prior)) if count else np.zeros((0, 0))
        inverse = np.linalg.inv(prior_information + gram(weighted, own))
        values = -inverse @ gram(weighted, linear.residuals[rows])
        response = -inverse @ gram(weighted, linear.jacobian_of(rows))
        cross = fitted @ response.T
        covariance = np.block([[fitted, cross], [cross.T, inverse + response @ cross]])
        return cls(jacobian, values, covariance)


def equations_from(
    problem: Problem, solution: Solution, errors: RepeatErrors, asked: IntArray
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Accumulates information and gradient of the observations from each stop on, last stop first.

    Args:
        problem: The observations.
        solution: The unknowns and the noise.
        errors: Shared errors of repeats, which come last among the unknowns.
        asked: (a,) indices of the unknowns of interest.

    Yields:
        Each stop with the rows of the information (a, p + q) and gradient (a,) of it and all later
        stops, without priors.
    """
    state, stops = solution.state, problem.observations.stops
    # Errors shared by repeats are unknowns here, not noise.
    apart, linear = replace(problem, with_repeats=False), problem.linear(state)
    whitening = _Whitening.of(apart, solution.noise, linear.by_errors)
    residuals = linear.residuals + errors.jacobian @ errors.values
    augmented = np.concatenate([linear.jacobian, errors.jacobian, residuals[:, :, None]], axis=2)
    total = np.zeros((len(asked), augmented.shape[2]))
    for stop in np.unique(stops)[::-1].tolist():
        at_stop = np.flatnonzero(stops == stop)
        rows, units = augmented[at_stop], whitening.units[at_stop]
        total = total + gram(rows[:, :, asked], whitening.weights[at_stop] @ rows)
        for unit in np.unique(units[units >= 0]).tolist():
            in_unit = units == unit
            pulled = np.swapaxes(whitening.taken[at_stop[in_unit]], 1, 2)
            taken = gram(pulled, rows[in_unit])
            total -= taken[:, asked].T @ taken
        yield stop, total[:, :-1], total[:, -1]
