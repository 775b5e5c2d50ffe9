"""Moves that hide in the noise of each observation, and steps of a joint, of a size or of a board.

They are found by Rao's score test of a step at every stop (as Page 1955 asks for a change), and are
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
from visioncal.estimation.parts import UNEVEN, Effect, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import (
    RepeatErrors,
    Solution,
    by_noise_alone,
    equations_from,
    fit_problem,
    fitted_covariance,
    robot_likelihood,
)
from visioncal.estimation.variance import Knowledge

# A step that the other unknowns take up to this share of its information is no step of its own.
_TAKEN = 1e-6
# Sizes of boards that are exchanged differ by such shares.
_SHARES = (1e-3, 1e-2, 1e-1)
# Runs of stops that begin or end so many away from a step show the same; so many stops are tried.
_SAME, _PARTS = 2, 60
# Beside a step, views on either side of it are as far off as others are, or up to so many times.
_ALIKE = 3.0
# Noise is left, however much a step explains.
_MOST_EXPLAINED = 0.99


@dataclass(frozen=True, eq=False)
class Slip:
    """A joint whose offset is another one from some stop on.

    Attributes:
        robot: Its robot, as the problem has it.
        joint: The joint, numbered from 0.
        stop: The first stop with the other offset.
        step_rad: By how much farther it stands from then on than it reads [rad].
        sigma_rad: How well that is known [rad].
        mahalanobis_sq: The evidence for it.
    """

    robot: str
    joint: int
    stop: int
    step_rad: float
    sigma_rad: float
    mahalanobis_sq: float


@dataclass(frozen=True, eq=False)
class Resized:
    """A board that has another size from some stop on, as where a print was exchanged.

    Attributes:
        frame: The board, as the problem knows it.
        stop: The first stop with the other size.
        share: By how much larger it is from then on.
        sigma: How well that is known.
        mahalanobis_sq: The evidence for it.
    """

    frame: str
    stop: int
    share: float
    sigma: float
    mahalanobis_sq: float


def common_size(problem: Problem, fit: Solution, some: Mask) -> tuple[float, Mask] | None:
    """The other size of a board that some observations ask for together.

    Args:
        problem: All n observations.
        fit: The unknowns and the noise, by others.
        some: (n,) which observations.

    Returns:
        By which share it is larger, and for each of them whether noise explains what is left; None
        where they are not of one board.
    """
    pairs = zip(problem.observations.observed, some.tolist(), strict=True)
    board, *others = {frame for frame, mine in pairs if mine}
    if others or not board.startswith("target"):
        return None
    away = problem.measured(fit.state)[some, :3, 3]
    there = problem.predicted(fit.state)[some, :3, 3]
    share = float(np.median(np.sum(there * away, axis=1) / np.sum(away**2, axis=1))) - 1.0
    wider = problem.with_effects([*problem.effects, _of_size(problem, fit, board, some)])
    resized = replace(fit, state=State(fit.state.edges, np.append(fit.state.values, share)))
    return share, explained_by_noise(wider, resized, len(problem))[some]


def slight_move(
    problem: Problem, fit: Solution, movable: Sequence[str], *, kinds: int = 1
) -> Move | None:
    """The most significant step of a frame at any stop; None where noise explains all of them.

    Args:
        problem: The observations that agree.
        fit: The unknowns and the noise.
        movable: Frames that may have moved.
        kinds: Of how many kinds of residuals, rotations and places, it may be in one alone. The
            noise of each is estimated apart: by one of two, a step has to explain half as much,
            and noise explains it more often than is stated.
    """
    columns = np.array([np.r_[problem.edge_columns(name)] for name in movable]).reshape(-1, 6)
    tried = int(problem.observations.stops.max()) + 1
    spread = np.array([_spread_of_means(problem, name) for name in movable])
    between = [_between(problem, problem.observations.involves(name)) for name in movable]
    freedom = _residual_freedom(problem, fit) / kinds
    best, limit = None, move_limit(problem, len(movable) * tried, kinds)
    for scored in _scored(problem, fit, columns, between):
        values = scaled_values(scored.alone)
        clear = (values[:, 0] >= _TAKEN * values[:, -1]) & (values[:, -1] > 0.0)
        clear &= scaled_values(scored.own)[:, 0] >= _TAKEN
        squares = np.where(clear, scored.squares, 0.0) / spread[scored.seen, scored.stop]
        tested = _beside_itself(squares, freedom, 6)
        place = int(tested.argmax())
        if tested[place] > limit:
            best = (
                movable[scored.seen[place]],
                scored.stop,
                scored.steps[place],
                float(squares[place]),
            )
            limit = tested[place]
    if best is None:
        return None
    frame, stop, step, square = best
    return Move(frame, twin_name(problem, frame), stop, exp(step), mahalanobis_sq=square)


def slipped_joint(
    problem: Problem, fit: Solution, offsets: Mapping[str, FloatArray]
) -> Slip | None:
    """The most significant step of a joint's offset at any stop; None where noise explains all.

    Args:
        problem: The observations that agree.
        fit: The unknowns and the noise.
        offsets: (s, 6, n) by robot, how its flange moves at each stop with the offset of each of
            its n joints.
    """
    joints = [(robot, at) for robot, offset in offsets.items() for at in range(offset.shape[2])]
    between = [_between(problem, rows_of(problem, robot)) for robot, _ in joints]
    found = _most_significant(problem, fit, _of_joints(offsets), between)
    if found is None:
        return None
    robot, joint = joints[found.which]
    return Slip(robot, joint, found.stop, found.step, found.sigma, found.mahalanobis_sq)


def resized_board(problem: Problem, fit: Solution) -> Resized | None:
    """The most significant step of a board's size at any stop; None where noise explains all.

    Args:
        problem: The observations that agree.
        fit: The unknowns and the noise.
    """
    boards = [frame for frame in problem.unknown if frame.startswith("target")]
    effects = [_of_size(problem, fit, board) for board in boards]
    between = [_between(problem, problem.observations.involves(board)) for board in boards]
    found = _most_significant(problem, fit, effects, between)
    if found is None:
        return None
    return Resized(boards[found.which], found.stop, found.step, found.sigma, found.mahalanobis_sq)


@dataclass(frozen=True)
class _ValueStep:
    """A step of one of several values at a stop, with its sigma and the evidence for it."""

    which: int
    stop: int
    step: float
    sigma: float
    mahalanobis_sq: float


def _most_significant(
    problem: Problem, fit: Solution, effects: Sequence[Effect], between: Sequence[IntArray]
) -> _ValueStep | None:
    """The most significant step of a value of some effects; None where noise explains all.

    Args:
        problem: The observations that agree.
        fit: The unknowns and the noise.
        effects: The effects, which the problem does not have.
        between: The stops at which each of their values may step.
    """
    count = len(between)
    if not count:
        return None
    columns = problem.size + np.arange(count)[:, None]
    tried = count * (int(problem.observations.stops.max()) + 1)
    freedom = _residual_freedom(problem, fit)
    best, limit = None, float(f_limit(FALSE_MOVE / tried, 1, freedom))
    for scored in _scored(problem, fit, columns, between, effects):
        alone, own = scored.alone[:, 0, 0], scored.own[:, 0, 0]
        squares = np.where(own > _TAKEN * alone, scored.squares, 0.0)
        tested = _beside_itself(squares, freedom, 1)
        place = int(tested.argmax())
        if tested[place] > limit:
            limit = tested[place]
            step, sigma = float(scored.steps[place, 0]), float(own[place] ** -0.5)
            which = int(scored.seen[place])
            best = _ValueStep(which, scored.stop, step, sigma, float(squares[place]))
    return best


def _of_joints(offsets: Mapping[str, FloatArray]) -> list[Effect]:
    """Offsets of joints, by robot."""
    return [
        Effect.free(
            f"offsets of {robot}", _nothing(offset.shape[2]), flange_jacobian={robot: offset}
        )
        for robot, offset in offsets.items()
    ]


def _of_size(problem: Problem, fit: Solution, board: str, some: Mask | None = None) -> Effect:
    """The size of a board in (n,) some observations: a larger one is farther off by as much."""
    seen = problem.observations
    mine = np.array([frame == board for frame in seen.observed])
    mine &= True if some is None else some
    measured = problem.measured(fit.state)
    by_size = np.zeros((len(seen), 6, 1))
    away = np.swapaxes(measured[:, :3, :3], 1, 2) @ measured[:, :3, 3:]
    by_size[:, 3:] = np.where(mine[:, None, None], away, 0.0)
    return Effect.free(f"size of {board}", _nothing(1), by_size)


def _nothing(count: int) -> Knowledge:
    """Knowledge of so many values of which nothing is known."""
    return Knowledge(np.zeros((count, count)), np.zeros(count))


def _beside_itself(squares: FloatArray, freedom: float, numbers: int) -> FloatArray:
    """A score test's squares, of so many numbers, as F tests have them: by the noise beside them.

    What is tested is in the noise that the score is measured by, which bounds the score.
    """
    left = np.maximum(freedom - squares, (1.0 - _MOST_EXPLAINED) * freedom)
    return squares * max(freedom - numbers, 1.0) / left


def log_gain(problem: Problem, fit: Solution, mahalanobis_sq: float) -> float:
    """Twice what an effect gains of the log-likelihood, the noise being that beside it.

    Args:
        problem: The observations.
        fit: The unknowns and the noise, without the effect.
        mahalanobis_sq: Its evidence by Rao's score test.
    """
    freedom = _residual_freedom(problem, fit)
    share = min(mahalanobis_sq / freedom, _MOST_EXPLAINED)
    return -freedom * float(np.log1p(-share))


def with_step(problem: Problem, fit: Solution, step: Move | Resized) -> tuple[Problem, Solution]:
    """The problem in which something is otherwise from some stop on, and its fit."""
    if isinstance(step, Move):
        wider, start = moved(problem, fit, step)
    else:
        effect = _of_size(problem, fit, step.frame, problem.observations.stops >= step.stop)
        wider = problem.with_effects([*problem.effects, effect])
        values = np.append(fit.state.values, step.share)
        start = replace(fit, state=State(fit.state.edges, values))
    return wider, fit_problem(wider, start.state, start.noise)


def leaves_noise(problem: Problem, fit: Solution, step: Move | Resized) -> bool:
    """Whether what a step leaves of the residuals on either side of it is as large as elsewhere.

    Views at an end of the session that are wrong, each otherwise, gain by a step, and stay wrong.

    Args:
        problem: The observations.
        fit: The unknowns and the noise, without the step.
        step: What is otherwise from some stop on.
    """
    wider, there = with_step(problem, fit, step)
    squares, behind = by_noise_alone(wider, there), problem.observations.stops >= step.stop
    mine, most = problem.observations.involves(step.frame), _ALIKE**2 * np.median(squares)
    return all(np.median(squares[mine & side]) < most for side in (behind, ~behind))


def evidence_gain(
    problem: Problem, fit: Solution, step: Move | Resized
) -> tuple[float, Problem, Solution]:
    """Twice the logarithm of a step's Bayes factor: by a fit with it, whose noise is its own.

    `log_gain` has one level of noise for rotations and places. A camera that was pushed is in that
    of places alone, of which the score has no more than a half.

    Args:
        problem: The observations.
        fit: The unknowns and the noise, without the step.
        step: What is otherwise from some stop on.

    Returns:
        The gain, and the problem with the step and its fit.
    """
    wider, there = with_step(problem, fit, step)
    # Of sensors' levels the likelihood knows one share: they are the same for both.
    before, after = (
        robot_likelihood(part, state, there.noise).least_unlikely
        for part, state in ((problem, fit.state), (wider, there.state))
    )
    known = fitted_covariance(wider, there.state, there.noise)
    # Restricted likelihood integrates over a change of any size, all as likely; these come in all
    # orders of magnitude.
    if isinstance(step, Move):
        change, covariance = fitted_change(wider, there, known, step)
        sizes, units = SIZES_M, np.repeat([TURN_PER_M, 1.0], 3)
    else:
        change, covariance = there.state.values[-1:], known[-1:, -1:]
        sizes, units = _SHARES, np.ones(1)
    likely = []
    for size in sizes:
        total = covariance + np.diag((size * units) ** 2)
        square = float(change @ np.linalg.solve(total, change))
        likely.append(-0.5 * (float(np.linalg.slogdet(total)[1]) + square))
    prior = float(np.logaddexp.reduce(likely) - np.log(len(likely)))
    return 2.0 * (before - after + prior), wider, there


def step_covariance(
    problem: Problem,
    fit: Solution,
    step: Move | Slip | Resized,
    offsets: Mapping[str, FloatArray],
) -> FloatArray:
    """What a step that a fit does not have adds to its covariance (p, p).

    The answer is between what holds before the step and what holds from then on, of which each is
    as likely to be asked for: the mean of its squared distances.

    Args:
        problem: The observations that agree.
        fit: The unknowns and the noise, without the step.
        step: What moved at once.
        offsets: As of `slipped_joint`.
    """
    after, places, effects = np.zeros(problem.size), np.array([step.stop]), list[Effect]()
    if isinstance(step, Move):
        columns = np.r_[problem.edge_columns(step.frame)]
        change = after[columns] = log(step.change)
    elif isinstance(step, Resized):
        effects = [_of_size(problem, fit, step.frame)]
        columns, change = np.array([problem.size]), np.array([step.share])
    else:
        effects = _of_joints({step.robot: offsets[step.robot]})
        columns, change = np.array([problem.size + step.joint]), np.array([step.step_rad])
    (found,) = _scored(problem, fit, columns[None], [places], effects)
    before = found.following[0] @ change
    return (np.outer(before, before) + np.outer(before + after, before + after)) / 2.0


@dataclass(frozen=True, eq=False)
class _Scored:
    """Steps of k unknowns, c numbers each, at one stop, by Rao's score test.

    Attributes:
        stop: The stop.
        seen: (k,) which of the unknowns that are asked for.
        alone: (k, c, c) information on each, were all else known.
        own: (k, c, c) that beside all else.
        following: (k, p, c) how the unknowns of the fit would move with each.
        steps: (k, c) the likeliest ones.
        squares: (k,) the evidence for them.
    """

    stop: int
    seen: IntArray
    alone: FloatArray
    own: FloatArray
    following: FloatArray
    steps: FloatArray
    squares: FloatArray


def _scored(
    problem: Problem,
    fit: Solution,
    columns: IntArray,
    between: Sequence[IntArray],
    effects: Sequence[Effect] = (),
) -> Iterator[_Scored]:
    """The steps of some unknowns at the stops at which they may be, the last first.

    Args:
        problem: The observations.
        fit: The unknowns and the noise.
        columns: (u, c) the columns of each; those of `effects` are behind the problem's.
        between: The stops at which each may step.
        effects: What the problem does not have.
    """
    errors, size = RepeatErrors.of(problem, fit), problem.size
    wider = problem.with_effects([*problem.effects, *effects])
    values = np.append(fit.state.values, np.zeros(wider.size - size))
    there = replace(fit, state=State(fit.state.edges, values))
    seen: dict[int, list[int]] = defaultdict(list)
    for place, stops in enumerate(between):
        for stop in stops.tolist():
            seen[stop].append(place)
    for stop, information, gradient in equations_from(wider, there, errors, columns.ravel()):
        if stop not in seen:
            continue
        mine = np.array(seen[stop])
        every = information.reshape(*columns.shape, -1)[mine]
        alone = np.take_along_axis(every, columns[mine, None], axis=2)
        across = np.delete(every, np.s_[size : wider.size], axis=2)
        asked = gradient.reshape(columns.shape)[mine]
        own, following, steps, squares = _score(alone, across, asked, errors.covariance)
        yield _Scored(stop, mine, alone, own, following[:, :size], steps, squares)


def _score(
    alone: FloatArray, across: FloatArray, asked: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rao's score test of k changes, of c numbers each.

    Args:
        alone: (k, c, c) information on each, were all else known.
        across: (k, c, p) that which it has in common with the p unknowns of the fit.
        asked: (k, c) the gradients.
        covariance: (p, p) of these unknowns.

    Returns:
        (k, c, c) information beside all else, (k, p, c) how the unknowns would move with each,
        (k, c) the likeliest ones, and (k,) the evidence for them.
    """
    following = -covariance @ np.swapaxes(across, 1, 2)
    own = alone + across @ following
    steps = -(covariance_from(own) @ asked[..., None])[..., 0]
    return own, following, steps, -np.sum(steps * asked, axis=1)


def differs_elsewhere(problem: Problem, fit: Solution, move: Move) -> bool:
    """Whether some other run of stops differs from the rest by more than what follows a move.

    Stops that follow each other have postures that are alike, and an arm's errors follow these:
    then one part of a programme differs from the rest as much as another.

    Args:
        problem: The observations.
        fit: The unknowns and the noise, without the move.
        move: The step that noise does not explain.
    """
    errors, columns = RepeatErrors.of(problem, fit), np.r_[problem.edge_columns(move.frame)]
    sums = {stop: both for stop, *both in equations_from(problem, fit, errors, columns)}
    stops = np.unique(problem.observations.stops[problem.observations.involves(move.frame)])
    begins = np.unique(np.linspace(0, len(stops) - 1, min(len(stops), _PARTS)).astype(int))
    at = int(np.searchsorted(stops, move.stop))
    first, behind = np.triu_indices(len(begins), 1)
    begun, ended = begins[first], begins[behind]
    away = np.minimum(
        np.maximum(begun, np.abs(ended - at)),
        np.maximum(np.abs(begun - at), len(stops) - ended),
    )
    apart = (away > _SAME) & (ended - begun >= FEWEST)
    every, gradients = (
        np.array([sums[stop][k] for stop in stops[begins].tolist()]) for k in (0, 1)
    )
    # What follows the move comes first.
    across = np.stack([sums[move.stop][0], *(every[first] - every[behind])[apart]])
    asked = np.stack([sums[move.stop][1], *(gradients[first] - gradients[behind])[apart]])
    *_, squares = _score(across[:, :, columns], across, asked, errors.covariance)
    return bool((squares[1:] > squares[0]).any())


def _residual_freedom(problem: Problem, fit: Solution) -> float:
    """Degrees of freedom of residuals: what is known besides of unknowns leaves some to them."""
    known = problem.knowledge(fit.state).information
    share = float(np.sum(fitted_covariance(problem, fit.state, fit.noise) * known))
    taken = float(np.sum(problem.moving)) - share
    return max(float(problem.observations.directions.sum()) - taken, 6.0)


def _between(problem: Problem, rows: Mask) -> IntArray:
    """The stops with enough others, of (n,) some observations, before them and from them on."""
    return np.asarray(np.unique(problem.observations.stops[rows])[FEWEST : 1 - FEWEST])


def _spread_of_means(problem: Problem, frame: str) -> FloatArray:
    """(s,) how much more a step of a frame before each stop may vary, if its views are uneven."""
    # Of the n views of the shorter side one may err by `UNEVEN` times what the others do. With one
    # robot the step itself is in the noise of all, which bounds the evidence for it.
    seen = problem.observations
    mine = seen.involves(frame) & seen.is_uneven & (not problem.is_combined)
    counts = np.bincount(seen.stops[mine], minlength=int(seen.stops.max()) + 1)
    before = np.cumsum(counts) - counts
    shorter = np.minimum(before, counts.sum() - before)
    return np.asarray(1.0 + (UNEVEN**2 - 1.0) * (mine.any() / np.maximum(shorter, 1)))
