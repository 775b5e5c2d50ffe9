"""Which observations of a cell are outliers, and what moved between them.

An observation is wrong as a whole (an image of another stop, a pose of another row), by how far it
is from what all others predict. A frame that moved while the session was taken is no noise: from
some stop on, all that saw it asks for one other place. It is then two frames, and nothing is lost.

Where frames may have moved, the search begins with the earliest stops: what moves later on has not
moved yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.moves import (
    Move,
    better_stop,
    explained_by_noise,
    gross_move,
    moved,
    moved_earlier_or_later,
    needless_move,
    unmoved,
)
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.parts import UNEVEN, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.robust import (
    Distances,
    half_of,
    settled,
    trimmed_start,
    widened,
)
from visioncal.estimation.slight_steps import slight_move
from visioncal.estimation.solve import (
    Solution,
    fit_problem,
    mahalanobis_sq,
    solve_problem,
    starting_noise,
)

# A sound observation is lost in one session of a thousand.
_FALSE_ALARM = 1e-3
# The earliest share of the stops, at the least, that the search begins with.
_EARLY_SHARE, _FEWEST_EARLY = 0.4, 8
_MOST_MOVES = 8
# An observation is near within so much [m], or so many times the median.
_NEAR_M, _FAR = 0.04, 6.0
# Where nothing agrees, what is off by so many times the median is wrong all the same.
_GROSS = 20.0
# Whatever robots err by more is wrong, and no noise [rad, m].
_MOST_NOISE = np.array([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M])
# Where fewer than this share of the observations agree, which of them are right is unknown.
_LEAST_SHARE = 0.5
# Inliers, at the least: with fewer, outliers cannot be separated from noise.
LEAST_VIEWS = 5
# Distances are compared with the limit once more, without the observation's own say in the noise,
# when they come this near.
_SUSPECT_SHARE = 0.4


@dataclass(frozen=True, eq=False)
class Agreed:
    """The observations that agree, and their fit.

    Attributes:
        problem: All n observations; what moved is two frames in its tree.
        fit: The unknowns and the noise, by those that agree.
        used: (n,) mask of these.
        distances: How far each is from what the others predict.
        moves: What moved, in the order in which it was found.
    """

    problem: Problem
    fit: Solution
    used: Mask
    distances: Distances
    moves: tuple[Move, ...]

    @property
    def part(self) -> Problem:
        """The observations that agree."""
        return self.problem.subset(self.used)

    def refitted(self) -> Self:
        """The same fitted anew, from the state and the noise that are there."""
        return replace(self, fit=fit_problem(self.part, self.fit.state, self.fit.noise))


@dataclass(frozen=True, eq=False)
class _ObservationSearch:
    """The search among the observations of a problem."""

    problem: Problem

    def fit(self, used: Mask, start: Solution) -> Solution:
        return self.fit_from(used, start.state, start.noise)

    def fit_from(self, used: Mask, state: State, noise: Noise | None = None) -> Solution:
        part = self.problem.subset(used)
        fit = fit_problem(part, state, noise)
        if np.all(fit.noise.robots <= _MOST_NOISE):
            return fit
        # Frames that are fitted beside more noise than robots have may be anywhere.
        most = replace(fit.noise, robots=np.minimum(fit.noise.robots, _MOST_NOISE))
        return Solution(solve_problem(part, state, most)[0], most)

    def distances(self, used: Mask, fit: Solution) -> Distances:
        found, far = distances(self.problem, used, fit), ~_near(self.problem, fit.state, used)
        # What is far away is wrong, however little is known of where it should be; unless its own
        # noise is as large, as of corners that deviate by pixels.
        if far.any():
            far &= ~explained_by_noise(self.problem, fit, len(self.problem))
        return replace(found, squares=np.where(far, np.inf, found.squares))


def distances(problem: Problem, used: Mask, fit: Solution) -> Distances:
    """How far each observation is from what the others predict.

    Args:
        problem: All n observations.
        used: (n,) those that the fit was made from.
        fit: The unknowns and the noise.
    """
    squares, directions = mahalanobis_sq(problem, used, fit)
    counted = np.maximum(directions, 1.0)
    # Robots' levels are estimated from half of the residuals each, which gives the squares the
    # tails of an F distribution.
    edges = int(problem.counted[: 6 * len(problem.unknown)].sum())
    freedom = max(0.5 * (float(problem.observations.directions[used].sum()) - edges), 6.0)
    limit = counted * f_limit(_FALSE_ALARM / len(problem), counted, freedom)
    uneven = np.where(problem.observations.is_uneven, UNEVEN**2, 1.0)
    return Distances(squares, directions, uneven * limit)


def agree(problem: Problem, state: State, movable: Sequence[str] = ()) -> Agreed:
    """Finds what belongs together at first sight, what does not, and what clearly moved.

    `settle` has the last word, once lenses and boards are as well known as they can be.

    Args:
        problem: All observations.
        state: The start.
        movable: Unknown frames that may have moved.
    """
    if not movable:
        return inliers(problem, state)
    used, fit = _core(problem, state, _early(problem))
    moves: list[Move] = []
    used, fit = _widened(problem, used, fit)
    while len(moves) < _MOST_MOVES:
        beyond = _ObservationSearch(problem).distances(used, fit).beyond
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


def all_as_inliers(problem: Problem, state: State) -> Agreed:
    """Takes all observations for inliers, where it is known that they do not belong together."""
    used = np.ones(len(problem), dtype=bool)
    return _agreed(problem, used, fit_problem(problem, state), ())


def settle(agreed: Agreed, movable: Sequence[str] = ()) -> Agreed:
    """Settles what agrees one by one, and what moved by less than single observations show."""
    problem, moves = agreed.problem, list(agreed.moves)
    if not movable:
        return inliers(problem, agreed.fit.state, agreed.used, agreed.fit.noise)
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


def inliers(
    problem: Problem, state: State, used: Mask | None = None, noise: Noise | None = None
) -> Agreed:
    """Finds the observations that agree, where nothing moved.

    Args:
        problem: All observations.
        state: The start.
        used: (n,) those that are thought to agree; None for a search without any idea.
        noise: Their noise; None where it is not known.

    Returns:
        Those that agree. Where fewer than half do, or those only to within more than any result
        may be off, the right ones are unknown: all stay but what lies many times farther off
        than most.
    """
    every = np.ones(len(problem), dtype=bool)
    if len(problem) > LEAST_VIEWS:
        mask, fit = (
            _core(problem, state, every)
            if used is None
            else (used, fit_problem(problem.subset(used), state, noise))
        )
        mask, fit = _settled(problem, mask, fit)
        is_noise = bool(np.all(fit.noise.robots < _MOST_NOISE))
        if mask.sum() >= max(_LEAST_SHARE * len(problem), LEAST_VIEWS) and is_noise:
            return _agreed(problem, mask, fit, ())
    fit = fit_problem(problem, state)
    near = _near(problem, fit.state, every, _GROSS)
    if not LEAST_VIEWS <= near.sum() < len(problem):
        return _agreed(problem, every, fit, ())
    return _agreed(problem, near, fit_problem(problem.subset(near), fit.state), ())


def closed_form(problem: Problem, rows: IntArray) -> State | None:
    """The unknowns by a hand-eye solver, where one robot parts two unknown edges.

    Args:
        problem: The observations.
        rows: (m,) those to solve from.
    """
    paths = [group.path for group in problem.groups]
    if len(paths) != 1 or not problem.observations.has_rotation.all() or problem.points:
        return None
    steps = paths[0]
    ends, between = (steps[0], steps[-1]), steps[1:-1]
    are_all = problem.unknown.keys() == {end.frame for end in ends}
    if not are_all or sum(bool(step.robot) for step in between) != 1:
        return None
    nowhere = State(np.zeros((0, 4, 4)), problem.start_values)
    robot = invert(problem.product(between, nowhere, rows))
    found = SOLVERS["park"](robot, problem.observations.measured[rows])
    edges = {ends[0].frame: found.x, ends[1].frame: found.z}
    return State(np.array([edges[name] for name in problem.unknown]), problem.start_values)


def _core(problem: Problem, state: State, among: Mask) -> tuple[Mask, Solution]:
    """The trimmed start among some observations, and all of them within its reach."""
    rows, noise = np.flatnonzero(among), starting_noise(problem)
    part = problem.subset(among)

    def solve(mask: Mask, state: State) -> State:
        found = closed_form(part, np.flatnonzero(mask))
        if found is not None:
            return found
        # Noise is estimated once what is wrong by far is out: it would pass for noise of a robot.
        return solve_problem(part.subset(_of_pairs(part, mask, state)), state, noise)[0]

    mask, start = trimmed_start([state], lambda item: _away(part, item), solve, half_of(len(rows)))
    search, mask = _ObservationSearch(part), _of_pairs(part, mask, start)
    every = np.ones(len(rows), dtype=bool)
    mask, fit = widened(search, mask, search.fit_from(mask, start), every)
    used = among.copy()
    used[rows] = mask
    return used, fit


def _of_pairs(problem: Problem, mask: Mask, state: State) -> Mask:
    """The observations of a mask, and of each pair of frames the nearest half, as far as near."""
    # The nearest half of all may be of few pairs, such as the still boards of still cameras: frames
    # that only others see would be free.
    away, found = _away(problem, state), mask.copy()
    for group in problem.groups if len(problem.groups) > 1 else ():
        found[group.rows[np.argsort(away[group.rows])][: (len(group.rows) + 1) // 2]] = True
    return found & _near(problem, state, mask)


def _early(problem: Problem) -> Mask:
    """(n,) the observations of the earliest stops."""
    stops = problem.observations.stops
    last = max(_EARLY_SHARE * float(stops.max()), float(np.unique(stops)[:_FEWEST_EARLY][-1]))
    return np.asarray(stops <= last)


def _away(problem: Problem, state: State) -> FloatArray:
    """Distances (n,) [m] of what was measured from what is predicted, rotations on a lever."""
    between = invert(problem.predicted(state)) @ problem.measured(state)
    turned = np.where(problem.observations.has_rotation, rotation_angle(between), 0.0)
    return np.asarray(np.linalg.norm(between[:, :3, 3], axis=1) + LEVER_M * turned)


def _near(problem: Problem, state: State, used: Mask, far: float = _FAR) -> Mask:
    """(n,) whether an observation is where it is predicted, as most of some are."""
    away = _away(problem, state)
    return np.asarray(away <= max(far * float(np.median(away[used])), _NEAR_M))


def _widened(problem: Problem, used: Mask, fit: Solution) -> tuple[Mask, Solution]:
    search = _ObservationSearch(problem)
    return widened(search, used, search.fit(used, fit))


def _settled(problem: Problem, used: Mask, fit: Solution) -> tuple[Mask, Solution]:
    return settled(_ObservationSearch(problem), used, fit, LEAST_VIEWS, _SUSPECT_SHARE)


def _agreed(problem: Problem, used: Mask, fit: Solution, moves: Sequence[Move]) -> Agreed:
    return Agreed(problem, fit, used, distances(problem, used, fit), tuple(moves))
