"""Moves within the noise of single observations, and steps of a joint, of a size or of a board.

They are found by Rao's score test of a step at every stop (a change-point test, Page 1955), and
kept by the evidence of a fit with the step. `moves` finds those that are larger than the noise.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.transforms import exp, log
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.arm import rows_of
from visioncal.estimation.linalg import covariance_from, scaled_values
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.model_evidence import SIZES_M, TURN_PER_M
from visioncal.estimation.moves import (
    FALSE_MOVE,
    FEWEST,
    Move,
    explained_by_noise,
    fitted_change,
    move_limit,
    moved,
    twin_name,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import UNEVEN, Effect, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import (
    RepeatErrors,
    Solution,
    by_noise_alone,
    equations_from,
    fit_problem,
    fitted_covariance,
)

# Least information of a step beside the other unknowns, as a share of that without them.
_LEAST_INFORMATION = 1e-6
# Relative size differences of exchanged boards.
_SHARES = (1e-3, 1e-2, 1e-1)
# Runs of stops that begin or end this near to a step show the same one; most boundaries tried.
_SAME_WITHIN, _PARTS = 2, 60
# Largest ratio of the residuals beside a step to others.
_ALIKE = 3.0
# Largest share of the residuals that a step explains.
_MOST_EXPLAINED = 0.99


@dataclass(frozen=True, eq=False)
class Slip:
    """A step of a joint's offset at some stop."""

    robot: str  # Its robot, as the problem names it.
    joint: int  # Index of the joint.
    stop: int  # The first stop with the new offset.
    step_rad: float  # Increase of actual minus reported angle [rad].
    sigma_rad: float  # Its standard deviation [rad].
    mahalanobis_sq: float  # The test statistic.


@dataclass(frozen=True, eq=False)
class Resized:
    """A step of a board's size at some stop, as where a print was exchanged."""

    frame: str  # The board, as the problem names it.
    stop: int  # The first stop with the new size.
    share: float  # Relative increase of the size.
    sigma: float  # Its standard deviation.
    mahalanobis_sq: float  # The test statistic.


def common_size(problem: Problem, fit: Solution, some: Mask) -> tuple[float, Mask] | None:
    """The new size of a board that (n,) some observations agree on, by a fit of others.

    Returns:
        The relative increase, and for each of them whether noise explains the rest; None where they
        are not of one board.
    """
    pairs = zip(problem.observations.observed, some.tolist(), strict=True)
    board, *others = {frame for frame, chosen in pairs if chosen}
    if others or not board.startswith("target"):
        return None
    measured = problem.measured(fit.state)[some, :3, 3]
    predicted = problem.predicted(fit.state)[some, :3, 3]
    ratios = np.sum(predicted * measured, axis=1) / np.sum(measured**2, axis=1)
    share = float(np.median(ratios)) - 1.0
    widened = problem.with_effects([*problem.effects, _of_size(problem, fit, board, some)])
    resized = replace(fit, state=State(fit.state.edges, np.append(fit.state.values, share)))
    return share, explained_by_noise(widened, resized, len(problem))[some]


def find_slight_move(
    problem: Problem, fit: Solution, movable: Sequence[str], *, kinds: int = 1
) -> Move | None:
    """The most significant step of a frame at any stop; None where none is significant.

    `kinds` is the number of kinds of residuals, rotations and positions, if it may be in one alone.
    The noise of each is estimated separately: in one of two, a step has to explain half as much,
    and noise explains it more often than stated.
    """
    columns = np.array([np.r_[problem.edge_columns(name)] for name in movable]).reshape(-1, 6)
    tried = int(problem.observations.stops.max()) + 1
    variance_ratio = np.array([_variance_ratio(problem, name) for name in movable])
    between = [_between(problem, problem.observations.involves(name)) for name in movable]
    freedom = _residual_freedom(problem, fit) / kinds
    best, limit = None, move_limit(problem, len(movable) * tried, kinds)
    for scored in _scored(problem, fit, columns, between):
        values = scaled_values(scored.alone)
        testable = (values[:, 0] >= _LEAST_INFORMATION * values[:, -1]) & (values[:, -1] > 0.0)
        testable &= scaled_values(scored.own)[:, 0] >= _LEAST_INFORMATION
        squares = np.where(testable, scored.squares, 0.0) / variance_ratio[scored.seen, scored.stop]
        statistics = _as_f_tests(squares, freedom, 6)
        index = int(statistics.argmax())
        if statistics[index] > limit:
            best = (
                movable[scored.seen[index]],
                scored.stop,
                scored.steps[index],
                float(squares[index]),
            )
            limit = statistics[index]
    if best is None:
        return None
    frame, stop, step, square = best
    return Move(frame, twin_name(problem, frame), stop, exp(step), mahalanobis_sq=square)


def slipped_joint(
    problem: Problem, fit: Solution, offsets: Mapping[str, FloatArray]
) -> Slip | None:
    """The most significant step of a joint's offset at any stop; None if none is significant.

    `offsets` are (s, 6, n) by robot: Jacobians of its flange at each stop by its n joint offsets.
    """
    joints = [(robot, at) for robot, offset in offsets.items() for at in range(offset.shape[2])]
    between = [_between(problem, rows_of(problem, robot)) for robot, _ in joints]
    step = _most_significant(problem, fit, _of_joints(offsets), between)
    if step is None:
        return None
    robot, at = joints[step.which]
    return Slip(robot, at, step.stop, step.step, step.sigma, step.mahalanobis_sq)


def resized_board(problem: Problem, fit: Solution) -> Resized | None:
    """The most significant step of a board's size at any stop; None if none is significant."""
    boards = [frame for frame in problem.unknown if frame.startswith("target")]
    effects = [_of_size(problem, fit, board) for board in boards]
    between = [_between(problem, problem.observations.involves(board)) for board in boards]
    step = _most_significant(problem, fit, effects, between)
    if step is None:
        return None
    return Resized(boards[step.which], step.stop, step.step, step.sigma, step.mahalanobis_sq)


@dataclass(frozen=True)
class _ValueStep:
    """A step of one of several values at a stop, with its sigma and test statistic."""

    which: int
    stop: int
    step: float
    sigma: float
    mahalanobis_sq: float


def _most_significant(
    problem: Problem, fit: Solution, effects: Sequence[Effect], between: Sequence[IntArray]
) -> _ValueStep | None:
    """The most significant step of a value of some effects; None if none is significant.

    `between` are the stops at which each of their values may step.
    """
    count = len(between)
    if not count:
        return None
    columns = problem.size + np.arange(count)[:, None]
    tried = count * (int(problem.observations.stops.max()) + 1)
    freedom = _residual_freedom(problem, fit)
    best, limit = None, float(f_limit(FALSE_MOVE / tried, 1, freedom))
    for scored in _scored(problem, fit, columns, between, effects):
        alone, marginal = scored.alone[:, 0, 0], scored.own[:, 0, 0]
        squares = np.where(marginal > _LEAST_INFORMATION * alone, scored.squares, 0.0)
        statistics = _as_f_tests(squares, freedom, 1)
        index = int(statistics.argmax())
        if statistics[index] > limit:
            limit = statistics[index]
            step, sigma = float(scored.steps[index, 0]), float(marginal[index] ** -0.5)
            which = int(scored.seen[index])
            best = _ValueStep(which, scored.stop, step, sigma, float(squares[index]))
    return best


def _of_joints(offsets: Mapping[str, FloatArray]) -> list[Effect]:
    """Offsets of joints as effects, by robot."""
    return [
        Effect.free(
            f"offsets of {robot}",
            PriorInformation.flat(offset.shape[2]),
            flange_jacobian={robot: offset},
        )
        for robot, offset in offsets.items()
    ]


def _of_size(problem: Problem, fit: Solution, board: str, some: Mask | None = None) -> Effect:
    """Effect of a board's size in (n,) some observations, proportional to its distance."""
    observations = problem.observations
    rows = np.array([frame == board for frame in observations.observed])
    rows &= True if some is None else some
    measured = problem.measured(fit.state)
    jacobian = np.zeros((len(observations), 6, 1))
    positions = np.swapaxes(measured[:, :3, :3], 1, 2) @ measured[:, :3, 3:]
    jacobian[:, 3:] = np.where(rows[:, None, None], positions, 0.0)
    return Effect.free(f"size of {board}", PriorInformation.flat(1), jacobian)


def _as_f_tests(squares: FloatArray, freedom: float, numbers: int) -> FloatArray:
    """Converts score statistics of `numbers` values to F statistics.

    The noise of the score includes the tested step, which bounds the score.
    """
    remaining = np.maximum(freedom - squares, (1.0 - _MOST_EXPLAINED) * freedom)
    return squares * max(freedom - numbers, 1.0) / remaining


def log_gain(problem: Problem, fit: Solution, mahalanobis_sq: float) -> float:
    """Twice the gain in log-likelihood by an effect, with the noise re-estimated.

    `mahalanobis_sq` is its statistic by Rao's score test, at the fit without it.
    """
    freedom = _residual_freedom(problem, fit)
    share = min(mahalanobis_sq / freedom, _MOST_EXPLAINED)
    return -freedom * float(np.log1p(-share))


def with_step(problem: Problem, fit: Solution, step: Move | Resized) -> tuple[Problem, Solution]:
    """The problem with a step from some stop on, and its fit."""
    if isinstance(step, Move):
        widened, start = moved(problem, fit, step)
    else:
        effect = _of_size(problem, fit, step.frame, problem.observations.stops >= step.stop)
        widened = problem.with_effects([*problem.effects, effect])
        values = np.append(fit.state.values, step.share)
        start = replace(fit, state=State(fit.state.edges, values))
    return widened, fit_problem(widened, start.state, start.noise)


def leaves_noise(problem: Problem, fit: Solution, step: Move | Resized) -> bool:
    """Whether the residuals beside a step are as small as elsewhere, once it is fitted.

    A few wrong views at an end of the session gain by a step, and stay wrong. The given fit is that
    without the step.
    """
    widened, step_fit = with_step(problem, fit, step)
    squares, behind = by_noise_alone(widened, step_fit), problem.observations.stops >= step.stop
    involved, limit = problem.observations.involves(step.frame), _ALIKE**2 * np.median(squares)
    return all(np.median(squares[involved & side]) < limit for side in (behind, ~behind))


def evidence_gain(
    problem: Problem, fit: Solution, step: Move | Resized
) -> tuple[float, Problem, Solution]:
    """Twice the log Bayes factor of a step: by a fit with it, with its own noise.

    `log_gain` has one noise level for rotations and positions. A pushed camera shows in positions
    alone, which are only half of the score. Returns also the problem with the step and its fit.
    """
    widened, step_fit = with_step(problem, fit, step)
    # The sensors' levels are held, the same for both.
    before, after = (
        robot_likelihood(part, state, step_fit.noise).negative_log_likelihood
        for part, state in ((problem, fit.state), (widened, step_fit.state))
    )
    covariance_all = fitted_covariance(widened, step_fit.state, step_fit.noise)
    # Restricted likelihood has a flat prior on the change; actual changes come in all orders of
    # magnitude.
    if isinstance(step, Move):
        change, covariance = fitted_change(widened, step_fit, covariance_all, step)
        sizes, units = SIZES_M, np.repeat([TURN_PER_M, 1.0], 3)
    else:
        change, covariance = step_fit.state.values[-1:], covariance_all[-1:, -1:]
        sizes, units = _SHARES, np.ones(1)
    log_likelihoods = []
    for size in sizes:
        total = covariance + np.diag((size * units) ** 2)
        square = float(change @ np.linalg.solve(total, change))
        log_likelihoods.append(-0.5 * (float(np.linalg.slogdet(total)[1]) + square))
    prior = float(np.logaddexp.reduce(log_likelihoods) - np.log(len(log_likelihoods)))
    return 2.0 * (before - after + prior), widened, step_fit


def step_covariance(
    problem: Problem,
    fit: Solution,
    step: Move | Slip | Resized,
    offsets: Mapping[str, FloatArray],
) -> FloatArray:
    """Covariance (p, p) added for a step that a fit does not model.

    The solution lies between the states before and after the step, which are equally likely to be
    needed: the mean of the squared distances from both. `offsets` are as of `slipped_joint`.
    """
    after, stops, effects = np.zeros(problem.size), np.array([step.stop]), list[Effect]()
    if isinstance(step, Move):
        columns = np.r_[problem.edge_columns(step.frame)]
        change = after[columns] = log(step.change)
    elif isinstance(step, Resized):
        effects = [_of_size(problem, fit, step.frame)]
        columns, change = np.array([problem.size]), np.array([step.share])
    else:
        effects = _of_joints({step.robot: offsets[step.robot]})
        columns, change = np.array([problem.size + step.joint]), np.array([step.step_rad])
    (scored,) = _scored(problem, fit, columns[None], [stops], effects)
    before = scored.following[0] @ change
    return (np.outer(before, before) + np.outer(before + after, before + after)) / 2.0


@dataclass(frozen=True, eq=False)
class _Scored:
    """Score tests of steps of k unknowns, c numbers each, at one stop."""

    stop: int  # The stop.
    seen: IntArray  # (k,) indices of the tested unknowns.
    alone: FloatArray  # (k, c, c) information on each, all else held.
    own: FloatArray  # (k, c, c) marginal information on each.
    following: FloatArray  # (k, p, c) response of the fit's unknowns to each.
    steps: FloatArray  # (k, c) the most likely steps.
    squares: FloatArray  # (k,) the test statistics.


def _scored(
    problem: Problem,
    fit: Solution,
    columns: IntArray,
    between: Sequence[IntArray],
    effects: Sequence[Effect] = (),
) -> Iterator[_Scored]:
    """Yields score tests of steps of some unknowns, stop by stop, the last first.

    `columns` are (u, c), those of `effects` behind the problem's; `between` are the stops at which
    each may step.
    """
    errors, size = RepeatErrors.of(problem, fit), problem.size
    widened = problem.with_effects([*problem.effects, *effects])
    values = np.append(fit.state.values, np.zeros(widened.size - size))
    start = replace(fit, state=State(fit.state.edges, values))
    tested_at: dict[int, list[int]] = defaultdict(list)
    for index, stops in enumerate(between):
        for stop in stops.tolist():
            tested_at[stop].append(index)
    for stop, information, gradient in equations_from(widened, start, errors, columns.ravel()):
        if stop not in tested_at:
            continue
        tested = np.array(tested_at[stop])
        information_rows = information.reshape(*columns.shape, -1)[tested]
        alone = np.take_along_axis(information_rows, columns[tested, None], axis=2)
        across = np.delete(information_rows, np.s_[size : widened.size], axis=2)
        gradients = gradient.reshape(columns.shape)[tested]
        own, following, steps, squares = _score(alone, across, gradients, errors.covariance)
        yield _Scored(stop, tested, alone, own, following[:, :size], steps, squares)


def _score(
    alone: FloatArray, across: FloatArray, gradients: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rao's score test of k changes, of c numbers each.

    Args:
        alone: (k, c, c) information on each, all else held.
        across: (k, c, p) cross information with the p unknowns of the fit.
        gradients: (k, c) of each.
        covariance: (p, p) of these unknowns.

    Returns:
        (k, c, c) marginal information, (k, p, c) response of the unknowns to each, (k, c) the most
        likely changes, and (k,) the test statistics.
    """
    following = -covariance @ np.swapaxes(across, 1, 2)
    marginal = alone + across @ following
    steps = -(covariance_from(marginal) @ gradients[..., None])[..., 0]
    return marginal, following, steps, -np.sum(steps * gradients, axis=1)


def differs_elsewhere(problem: Problem, fit: Solution, move: Move) -> bool:
    """Whether another run of stops differs from the rest by more than the stops after a move.

    Successive stops have similar postures, on which an arm's errors depend: one part of a programme
    then differs from the rest as much as another. The given fit is that without the move.
    """
    errors, columns = RepeatErrors.of(problem, fit), np.r_[problem.edge_columns(move.frame)]
    sums = {stop: both for stop, *both in equations_from(problem, fit, errors, columns)}
    stops = np.unique(problem.observations.stops[problem.observations.involves(move.frame)])
    begins = np.unique(np.linspace(0, len(stops) - 1, min(len(stops), _PARTS)).astype(int))
    move_index = int(np.searchsorted(stops, move.stop))
    first, behind = np.triu_indices(len(begins), 1)
    run_starts, run_ends = begins[first], begins[behind]
    distance = np.minimum(
        np.maximum(run_starts, np.abs(run_ends - move_index)),
        np.maximum(np.abs(run_starts - move_index), len(stops) - run_ends),
    )
    tested = (distance > _SAME_WITHIN) & (run_ends - run_starts >= FEWEST)
    information, gradients = (
        np.array([sums[stop][k] for stop in stops[begins].tolist()]) for k in (0, 1)
    )
    # The first entry is the move itself.
    across = np.stack([sums[move.stop][0], *(information[first] - information[behind])[tested]])
    asked = np.stack([sums[move.stop][1], *(gradients[first] - gradients[behind])[tested]])
    *_, squares = _score(across[:, :, columns], across, asked, errors.covariance)
    return bool((squares[1:] > squares[0]).any())


def _residual_freedom(problem: Problem, fit: Solution) -> float:
    """Degrees of freedom of the residuals; unknowns with a prior take less than one each."""
    prior = problem.prior_information(fit.state).information
    prior_share = float(np.sum(fitted_covariance(problem, fit.state, fit.noise) * prior))
    determined = float(np.sum(problem.moving)) - prior_share
    return max(float(problem.observations.directions.sum()) - determined, 6.0)


def _between(problem: Problem, rows: Mask) -> IntArray:
    """Stops with enough stops of (n,) some observations before and after."""
    return np.asarray(np.unique(problem.observations.stops[rows])[FEWEST : 1 - FEWEST])


def _variance_ratio(problem: Problem, frame: str) -> FloatArray:
    """(s,) variance ratio of a frame's step before each stop, if its views are uneven."""
    # One of the n views of the shorter side may have `UNEVEN` times the error of the others. With
    # one robot the step itself is in the noise, which bounds its evidence.
    observations = problem.observations
    uneven = observations.involves(frame) & observations.is_uneven & (not problem.is_combined)
    counts = np.bincount(observations.stops[uneven], minlength=int(observations.stops.max()) + 1)
    before = np.cumsum(counts) - counts
    shorter = np.minimum(before, counts.sum() - before)
    return np.asarray(1.0 + (UNEVEN**2 - 1.0) * (uneven.any() / np.maximum(shorter, 1)))
