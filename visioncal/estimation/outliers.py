"""Outlier rejection of a cell's observations, and frames that moved during the session.

An observation is an inlier or outlier as a whole (an image of another stop, a pose of another row),
by its Mahalanobis distance from the prediction of all others. A frame that moved during the session
is no outlier: from some stop on, all its observations agree on one other pose, and it is then two
frames; or it crept, and its motion is an effect. No observation is lost.

Where frames may have moved, the search begins with the earliest stops, before later moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from visioncal.core.directions import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.core.limits import FEWEST_COMPARED, FEWEST_STOPS
from visioncal.core.quantiles import FALSE_REJECTION, f_limit
from visioncal.core.robust import ROUNDS, Distances, half_of, nearest, settled, widened
from visioncal.core.transforms import LEVER_M, invert, rotation_angle
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.moves import (
    CREEP,
    Creep,
    Move,
    explained_by_noise,
    find_move,
    may_have_crept,
    moved,
    still_frames,
    with_creep,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import UNEVEN, Noise, State
from visioncal.estimation.solve import (
    Solution,
    estimate_noise,
    fit_problem,
    mahalanobis_sq,
    solve_problem,
    starting_noise,
)
from visioncal.estimation.steps import candidates_of, find_steps

# Share of the earliest stops with which the search begins.
EARLY_SHARE = 0.4
# Moves that are fitted: a drift would become a move at every stop, each of which takes a search.
_MOST_MOVES = 8
# Limit of an observation's distance from its prediction: in metres, and over the median.
_NEAR_M, _FAR = 0.04, 6.0
# Largest noise of robots: larger errors are outliers [rad, m].
_MOST_NOISE = np.array([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M])


@dataclass(frozen=True, eq=False)
class InlierFit:
    """The inliers, and their fit."""

    problem: Problem  # All n observations; a moved frame is two frames in its tree.
    fit: Solution  # The unknowns and the noise, by the inliers.
    used: Mask  # (n,) mask of the inliers.
    distances: Distances  # Distance of each observation from the prediction of the others.
    moves: tuple[Move, ...]  # The moves, in the order in which they were found.

    @cached_property
    def part(self) -> Problem:
        """The problem of the inliers."""
        return self.problem.subset(self.used)

    def with_noise(self, noise: Noise) -> Self:
        """The inlier fit with a noise from which searches start."""
        return replace(self, fit=replace(self.fit, noise=noise))

    def refitted(self) -> Self:
        """Refits the inliers, starting at the present state and noise."""
        return replace(self, fit=fit_problem(self.part, self.fit.state, self.fit.noise))


@dataclass(frozen=True, eq=False)
class _ObservationSearch:
    """The search among the observations of a problem."""

    problem: Problem

    def fit(self, used: Mask, start: Solution) -> Solution:
        # The noise follows the inliers, from fit to fit.
        return self.fit_from(used, start.state, start.noise, turns=1)

    def fit_from(
        self, used: Mask, state: State, noise: Noise | None = None, *, turns: int = 20
    ) -> Solution:
        part = self.problem.subset(used)
        fit = fit_problem(part, state, noise, turns=turns)
        if np.all(fit.noise.robots <= _MOST_NOISE):
            return fit
        # With more noise than robots have, frames may be fitted anywhere.
        capped = replace(fit.noise, robots=np.minimum(fit.noise.robots, _MOST_NOISE))
        return Solution(solve_problem(part, state, capped)[0], capped)

    def distances(self, used: Mask, fit: Solution) -> Distances:
        predicted, far = distances(self.problem, used, fit), ~_near(self.problem, fit.state, used)
        # A far observation is an outlier, however uncertain its prediction; unless its own noise is
        # as large, as of corners that deviate by pixels.
        if far.any():
            far &= ~explained_by_noise(self.problem, fit, len(self.problem))
        return replace(predicted, squares=np.where(far, np.inf, predicted.squares))


def distances(problem: Problem, used: Mask, fit: Solution) -> Distances:
    """Mahalanobis distance of each observation from the prediction of the others.

    `used` is the (n,) mask of the fit.
    """
    squares, directions = mahalanobis_sq(problem, used, fit)
    counted = np.maximum(directions, 1.0)
    # Each of a robot's levels is estimated from half of the residuals, which gives the squares an F
    # distribution.
    edges = int(problem.counted[: 6 * len(problem.unknown)].sum())
    freedom = max(0.5 * (float(problem.observations.directions[used].sum()) - edges), 6.0)
    limit = counted * f_limit(FALSE_REJECTION / len(problem), counted, freedom)
    uneven = np.where(problem.observations.is_uneven, UNEVEN**2, 1.0)
    return Distances(squares, directions, uneven * limit)


def inliers_and_moves(
    problem: Problem, state: State, movable: Sequence[str] = (), used: Mask | None = None
) -> InlierFit:
    """Finds the inliers and the clear moves in a first pass; `refine_inliers` refines both.

    `used` are (n,) presumed inliers, if any; else the search begins with the earliest stops.
    """
    if not movable:
        return find_inliers(problem, state)
    # The observations of the earliest stops.
    stops = problem.observations.stops
    last = max(EARLY_SHARE * float(stops.max()), float(np.unique(stops)[:FEWEST_STOPS][-1]))
    moves: list[Move] = []
    if used is None:
        used, fit = _core(problem, state, stops <= last)
    else:
        fit = fit_problem(problem.subset(used), state)
    used, fit = widened(_ObservationSearch(problem), used, fit)
    if (first := _first_agreeing(problem, used, movable)) is not None:
        used, fit = _core(problem, state, stops < first)
        used, fit = widened(_ObservationSearch(problem), used, fit)
    while len(moves) < _MOST_MOVES:
        relative_squares = _ObservationSearch(problem).distances(used, fit).beyond
        found = find_move(problem, fit, relative_squares < 1.0, movable)
        if found is None:
            break
        frame, stop, change = found
        if stop < 0:
            # Its observations agreed with nothing: the search begins anew.
            problem, state = with_creep(problem, fit.state if moves else state, frame, change)
            used, fit = _core(problem, state, stops <= last)
            used, fit = widened(_ObservationSearch(problem), used, fit)
            continue
        problem, fit, move = moved(problem, fit, frame, stop, change)
        movable = (*movable, move.twin)
        moves.append(move)
        involved = problem.observations.involves(move.twin)
        used = np.where(involved, explained_by_noise(problem, fit, len(problem)), used)
        used, fit = _widened(problem, used, fit)
    return _converged(problem, used, fit, moves)


def _first_agreeing(problem: Problem, used: Mask, movable: Sequence[str]) -> int | None:
    """The stop from which a frame's observations agree, where none of the stops before does.

    So it is of a frame that moved before most of the earliest stops; None for no such frame.
    """
    found, stops = list[int](), problem.observations.stops
    for frame in movable:
        rows = problem.observations.involves(frame)
        first = int(stops[rows & used].min()) if (rows & used).any() else -1
        if len(np.unique(stops[rows & (stops < first)])) >= FEWEST_STOPS:
            found.append(first)
    return min(found, default=None)


def presumed_inliers(problem: Problem, state: State, used: Mask) -> InlierFit:
    """(n,) presumed inliers with their fit, which no test has."""
    return _inlier_fit(problem, used, fit_problem(problem.subset(used), state), ())


def all_as_inliers(problem: Problem, state: State) -> InlierFit:
    """All observations as inliers at a start, for sets known not to agree."""
    used = np.ones(len(problem), dtype=bool)
    noise = estimate_noise(problem, state, starting_noise(problem), from_above=True)
    return _inlier_fit(problem, used, Solution(state, noise), ())


def refine_inliers(agreed: InlierFit, movable: Sequence[str] = ()) -> InlierFit:
    """Refines the inliers one by one, and finds moves too small for single observations."""
    problem, moves = agreed.problem, list(agreed.moves)
    if not movable:
        return find_inliers(problem, agreed.fit.state, agreed.used, agreed.fit.noise)
    used, fit = _refined(problem, *_widened(problem, agreed.used, agreed.fit))
    while len(moves) < _MOST_MOVES:
        part, still = problem.subset(used), still_frames(problem, movable)
        creeps = [
            Creep.at(problem, fit.state, name).take(np.flatnonzero(used))
            for name in still
            if may_have_crept(problem, name)
        ]
        if not (slight := find_steps(part, fit, candidates_of(part, still, creeps))):
            break
        frame, stop, value = slight[0].of, slight[0].stop, slight[0].value
        if slight[0].kind == CREEP:
            problem, state = with_creep(problem, fit.state, frame, value)
            fit = replace(fit, state=state)
        else:
            problem, fit, move = moved(problem, fit, frame, stop, value)
            movable = (*movable, move.twin)
            moves.append(move)
        used, fit = _refined(problem, *_widened(problem, used, fit))
    return _converged(problem, used, fit, moves)


def find_inliers(
    problem: Problem, state: State, used: Mask | None = None, noise: Noise | None = None
) -> InlierFit:
    """Finds the inliers where nothing moved; `used` are (n,) presumed ones, if any, of some noise.

    Where fewer than half are inliers, or their noise exceeds any accepted result's, the outliers
    cannot be identified: all stay except gross outliers. These are few that are far from what the
    inliers predict, however much noise they have: a fit of all would follow a board that was read
    upside down.
    """
    all_rows = np.ones(len(problem), dtype=bool)
    if len(problem) > FEWEST_COMPARED:
        mask, fit = (
            _core(problem, state, all_rows)
            if used is None
            else (used, fit_problem(problem.subset(used), state, noise))
        )
        found = _converged(problem, *_refined(problem, mask, fit), ())
        is_noise = bool(np.all(found.fit.noise.robots < _MOST_NOISE))
        # Least share of inliers; with fewer, the outliers cannot be identified.
        if found.used.sum() >= max(0.5 * len(problem), FEWEST_COMPARED) and is_noise:
            return found
        fit, near = found.fit, _near(problem, found.fit.state, all_rows)
        for _ in range(ROUNDS):
            # Least share that agrees but for noise larger than robots have, where others are gross
            # outliers.
            if near.sum() < max(0.75 * len(problem), FEWEST_COMPARED) or near.all():
                break
            before, fit = near, fit_problem(problem.subset(near), fit.state)
            near = _near(problem, fit.state, before)
            if np.array_equal(near, before):
                return _inlier_fit(problem, near, fit, ())
    fit = fit_problem(problem, state)
    # Multiple of the median distance beyond which an observation is an outlier even without a
    # consensus.
    near = _near(problem, fit.state, all_rows, 20.0)
    if not FEWEST_COMPARED <= near.sum() < len(problem):
        return _inlier_fit(problem, all_rows, fit, ())
    return _inlier_fit(problem, near, fit_problem(problem.subset(near), fit.state), ())


def _core(problem: Problem, state: State, among: Mask) -> tuple[Mask, Solution]:
    """The nearest half of some observations at a start, extended by all it predicts.

    To it belongs the nearest half of each pair of frames, if near.
    """
    rows, part = np.flatnonzero(among), problem.subset(among)
    mask = nearest(_lever_distances(part, state), half_of(len(rows)))
    # The nearest half of all may be of few pairs of frames, such as the still boards of still
    # cameras: other frames would be undetermined.
    distance, near = _lever_distances(part, state), _near(part, state, mask)
    for group in part.groups if len(part.groups) > 1 else ():
        mask[group.rows[np.argsort(distance[group.rows])][: (len(group.rows) + 1) // 2]] = True
    search, mask = _ObservationSearch(part), mask & near
    every = np.ones(len(rows), dtype=bool)
    # The noise is held at first: gross outliers would pass for noise of a robot.
    state = solve_problem(part.subset(mask), state, starting_noise(problem))[0]
    mask, fit = widened(search, mask, search.fit_from(mask, state, turns=1), every)
    used = among.copy()
    used[rows] = mask
    return used, fit


def _lever_distances(problem: Problem, state: State) -> FloatArray:
    """Distances (n,) [m] of measured from predicted poses, rotations times a lever."""
    between = invert(problem.predicted(state)) @ problem.measured(state)
    rotation = np.where(problem.observations.has_rotation, rotation_angle(between), 0.0)
    return np.asarray(np.linalg.norm(between[:, :3, 3], axis=1) + LEVER_M * rotation)


def _near(problem: Problem, state: State, used: Mask, far: float = _FAR) -> Mask:
    """(n,) mask of the observations near their prediction, by the median of those used."""
    distance = _lever_distances(problem, state)
    return np.asarray(distance <= max(far * float(np.median(distance[used])), _NEAR_M))


def _widened(problem: Problem, used: Mask, fit: Solution) -> tuple[Mask, Solution]:
    search = _ObservationSearch(problem)
    return widened(search, used, search.fit(used, fit))


def _refined(problem: Problem, used: Mask, fit: Solution) -> tuple[Mask, Solution]:
    # From this share of the limit on, observations are tested with noise estimated without them.
    return settled(_ObservationSearch(problem), used, fit, FEWEST_COMPARED, 0.4)


def _converged(problem: Problem, used: Mask, fit: Solution, moves: Sequence[Move]) -> InlierFit:
    """The inliers of a search, fitted until the noise levels change no more."""
    fit = _ObservationSearch(problem).fit_from(used, fit.state, fit.noise)
    return _inlier_fit(problem, used, fit, moves)


def _inlier_fit(problem: Problem, used: Mask, fit: Solution, moves: Sequence[Move]) -> InlierFit:
    return InlierFit(problem, fit, used, distances(problem, used, fit), tuple(moves))
