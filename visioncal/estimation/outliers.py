"""Which observations of a whole cell belong together, and what moved between them.

What is wrong as a whole (an image of another stop, a pose of another row) is left out, by how far
it is from what all others predict. A frame that moved while the session was taken is no noise: from
some stop on, all that saw it asks for one other place. It is then two frames, and nothing is lost.

It begins with the earliest stops, where what moves later on has not moved yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.chance import chi2_limit, f_limit
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.moves import (
    Move,
    better_stop,
    explained_by_noise,
    gross_move,
    moved,
    moved_earlier_or_later,
    needless_move,
    slight_move,
    unmoved,
)
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.problem import Problem, State
from visioncal.estimation.solve import (
    Solution,
    fit_problem,
    mahalanobis_sq,
    solve_problem,
    starting_noise,
)
from visioncal.transforms import invert, rotation_angle
from visioncal.types import FloatArray, Mask

# A sound observation is lost in one session of a thousand.
_FALSE_ALARM = 1e-3
# The earliest share of the stops, at the least, that the search begins with.
_EARLY_SHARE, _FEWEST_EARLY = 0.4, 8
_ROUNDS, _MOST_MOVES = 10, 8
# An observation is near a start within so much [m], or so many times the median.
_NEAR_M, _FAR = 0.04, 6.0
# Whatever robots err by more is wrong, and no noise [rad, m].
_MOST_NOISE = np.array([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M])
# Distances are compared with the limit once more, without the observation's own say in the noise,
# when they come this near.
_SUSPECT_SHARE = 0.6


@dataclass(frozen=True, eq=False)
class Agreed:
    """The observations that agree, and their fit.

    Attributes:
        problem: All n observations; what moved is two frames in its tree.
        fit: The unknowns and the noise, by those that agree.
        used: (n,) mask of these.
        surprise: (n,) squared distance of each from what the others predict.
        limit: (n,) what it may be.
        moves: What moved, in the order in which it was found.
    """

    problem: Problem
    fit: Solution
    used: Mask
    surprise: FloatArray
    limit: FloatArray
    moves: tuple[Move, ...]


def agree(problem: Problem, state: State, movable: Sequence[str]) -> Agreed:
    """Finds what belongs together at first sight, what does not, and what clearly moved.

    `settle` has the last word, once lenses and boards are as well known as they can be.

    Args:
        problem: All observations.
        state: A start.
        movable: Unknown frames that may have moved.
    """
    used, fit = _early(problem, state)
    moves: list[Move] = []
    while len(moves) < _MOST_MOVES:
        beyond = _beyond(problem, used, fit)
        move = gross_move(problem, fit, beyond < 1.0, movable)
        if move is None:
            break
        problem, fit = moved(problem, fit, move)
        movable = (*movable, move.twin)
        moves.append(move)
        mine = problem.observations.involves(move.twin)
        used = np.where(mine, explained_by_noise(problem, fit, len(problem)), used)
        used, fit = _widened(problem, used, fit)
    used, fit = _widened(problem, used, fit)
    return _without_needless(_timed(_agreed(problem, used, fit, moves)))


def _timed(found: Agreed) -> Agreed:
    """Moves at the stops from which on they explain most, now that all is fitted together."""
    problem, fit, moves = found.problem, found.fit, list(found.moves)
    for move in found.moves:
        stop = better_stop(problem, fit, move)
        if stop != move.stop:
            problem, moves = moved_earlier_or_later(problem, moves, move, stop)
    if problem is found.problem:
        return found
    return _agreed(problem, *_widened(problem, found.used, fit), moves)


def _without_needless(found: Agreed) -> Agreed:
    """Takes moves back that are none, now that all is fitted together."""
    problem, fit, used, moves = found.problem, found.fit, found.used, list(found.moves)
    while (move := needless_move(problem.subset(used), fit, moves)) is not None:
        problem, fit, moves = unmoved(problem, fit, moves, move)
        used, fit = _widened(problem, used, fit)
    return found if len(moves) == len(found.moves) else _agreed(problem, used, fit, moves)


def settle(agreed: Agreed, movable: Sequence[str]) -> Agreed:
    """Settles what agrees one by one, and what moved by less than single observations tell."""
    problem, moves = agreed.problem, list(agreed.moves)
    used, fit = _settled(problem, *_widened(problem, agreed.used, agreed.fit))
    while len(moves) < _MOST_MOVES:
        slight = slight_move(problem.subset(used), fit, movable)
        if slight is None:
            break
        problem, fit = moved(problem, fit, slight)
        movable = (*movable, slight.twin)
        moves.append(slight)
        used, fit = _settled(problem, *_widened(problem, used, fit))
    return _without_needless(_agreed(problem, used, fit, moves))


def _agreed(problem: Problem, used: Mask, fit: Solution, moves: Sequence[Move]) -> Agreed:
    squares, directions = mahalanobis_sq(problem, used, fit)
    return Agreed(problem, fit, used, squares, _limit(problem, used, directions), tuple(moves))


def _limit(problem: Problem, used: Mask, directions: FloatArray) -> FloatArray:
    """Largest surprise (n,) that noise may give, corrected for how many observations there are.

    Robots' levels are estimated from half of the residuals each, which gives the surprise the tails
    of an F distribution.
    """
    told = np.where(problem.observations.has_rotation[used], 6, 3).sum()
    freedom = max(0.5 * (float(told) - problem.size), 6.0)
    counted = np.maximum(directions, 1.0)
    return np.asarray(counted * f_limit(_FALSE_ALARM / len(problem), counted, freedom))


def _beyond(problem: Problem, used: Mask, fit: Solution) -> FloatArray:
    """Surprises (n,) as shares of what they may be, the noise scaled by the used ones' median."""
    squares, directions = mahalanobis_sq(problem, used, fit)
    typical = chi2_limit(0.5, np.maximum(directions, 1.0))
    scale = max(float(np.median((squares / typical)[used])), 1.0) if used.any() else 1.0
    return np.asarray(squares / (scale * _limit(problem, used, directions)))


def _early(problem: Problem, state: State) -> tuple[Mask, Solution]:
    """Fits the earliest stops, without what is far from the start."""
    stops = problem.observations.stops
    last = max(_EARLY_SHARE * float(stops.max()), float(np.unique(stops)[:_FEWEST_EARLY][-1]))
    early = stops <= last
    # Noise is estimated once what is wrong by far is out: it would pass for noise of a robot.
    noise = starting_noise(problem)
    used = early & _near(problem, state, early)
    state, _ = solve_problem(problem.subset(used), state, noise)
    fit = Solution(state, noise)
    return _widened(problem, early & (_beyond(problem, used, fit) < 1.0), fit, early)


def _near(problem: Problem, state: State, among: Mask) -> Mask:
    """(n,) whether an observation is where a start has it, as most among some are."""
    between = invert(problem.predicted(state)) @ problem.measured(state)
    away = np.linalg.norm(between[:, :3, 3], axis=1)
    away = away + LEVER_M * np.where(
        problem.observations.has_rotation, rotation_angle(between), 0.0
    )
    return np.asarray(away < max(_FAR * float(np.median(away[among])), _NEAR_M))


def _widened(
    problem: Problem, used: Mask, fit: Solution, among: Mask | None = None
) -> tuple[Mask, Solution]:
    """Fits, and takes all within reach of the noise, in turn."""
    noise = None
    for _ in range(_ROUNDS):
        fit = fit_problem(problem.subset(used), fit.state, noise)
        noise = replace(fit.noise, robots=np.minimum(fit.noise.robots, _MOST_NOISE))
        fit = replace(fit, noise=noise)
        before = used
        # What is far away is wrong, however little is known of where it should be.
        used = (_beyond(problem, used, fit) < 1.0) & _near(problem, fit.state, used)
        if among is not None:
            used &= among
        if np.array_equal(before, used):
            break
    return used, fit


def _settled(problem: Problem, used: Mask, fit: Solution) -> tuple[Mask, Solution]:
    """Takes observations in and out one at a time, until none moves.

    Of hundreds, one in a hundred goes in at a time.
    """
    step = max(len(problem) // 100, 1)
    for _ in range(len(problem)):
        squares, directions = mahalanobis_sq(problem, used, fit)
        beyond = squares / _limit(problem, used, directions)
        outside = np.flatnonzero(~used & (beyond < 1.0))
        if len(outside):
            used = used.copy()
            used[outside[beyond[outside].argsort()[:step]]] = True
            fit = fit_problem(problem.subset(used), fit.state, fit.noise)
            continue
        worst = int(np.where(used, beyond, -1.0).argmax())
        if beyond[worst] < _SUSPECT_SHARE:
            break
        fewer = used.copy()
        fewer[worst] = False
        again = fit_problem(problem.subset(fewer), fit.state, fit.noise)
        squares, directions = mahalanobis_sq(problem, fewer, again)
        if squares[worst] < _limit(problem, fewer, directions)[worst]:
            break
        used, fit = fewer, again
    return used, fit
