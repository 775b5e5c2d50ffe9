"""Which stops the observations fit that disagree with their own, and which are exchanged."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from types import MappingProxyType

import numpy as np

from visioncal.calibration.stages.pose_ambiguity import CLEAR_RATIO
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.moves import Move
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, by_noise_alone

# An image fits another stop where it is as near to what is predicted there as noise may put it, and
# twice as far: what is predicted has errors, too, and other stops are farther by far.
_CHANCE, _NEAR = 1e-3, 4.0


def other_stops(
    problem: Problem,
    used: Mask,
    fit: Solution,
    out: IntArray,
    moves: Sequence[Move] = (),
    turns: Mapping[str, FloatArray] = MappingProxyType({}),
) -> dict[int, list[int]]:
    """The other stops that observations fit which do not fit their own, best first.

    Args:
        problem: All n observations.
        used: (n,) those that the fit was made from.
        fit: The unknowns and the noise.
        out: Observations that are left out.
        moves: What moved between stops.
        turns: (k, 4, 4) `target_from_turned` of targets that look the same turned, by frame.
    """
    seen = problem.observations
    # Between the last stop before a move and the first one after it, either may be true.
    late = {move.twin: move.stop for move in moves}
    early = {
        move.twin: int(seen.stops[seen.involves(move.frame) & used].max(initial=-1)) + 1
        for move in moves
    }
    found = {}
    for at in out.tolist():
        # Of a target that looks the same turned, the pose was taken that fits its own stop best.
        alike = turns.get(seen.observed[at].partition("@")[0], np.eye(4)[None])
        squares = np.min(
            [
                _squares_by_stop(problem, fit, at, moves, starts, turn)
                for starts in (late, early)
                for turn in alike
            ],
            axis=0,
        )
        # Stops in one posture are no others: what fits one of them fits its own as well, or nearly.
        limit = min(_NEAR * chi2_limit(_CHANCE, 6), squares[seen.stops[at]] / CLEAR_RATIO**2)
        near = np.flatnonzero(squares < limit)
        if len(near):
            found[at] = near[np.argsort(squares[near])].tolist()
    return found


def _squares_by_stop(
    problem: Problem,
    fit: Solution,
    at: int,
    moves: Sequence[Move],
    starts: Mapping[str, int],
    turn: FloatArray,
) -> FloatArray:
    """Squared distances (s,) of an observation from what is predicted at every stop."""
    # Infinite where a robot's pose is not known, or where no robot has a part in it. What moved is
    # at its other place from the stops in `starts` on.
    seen = problem.observations
    stops = np.arange(max(map(len, problem.poses.values()), default=0))
    repeated = np.full(len(stops), at)
    observer, observed = (pair[at].partition("@")[0] for pair in (seen.observers, seen.observed))
    taken, turned = seen.take(repeated), adjoint(invert(turn))
    here = replace(
        taken,
        observers=(observer,) * len(stops),
        observed=(observed,) * len(stops),
        stops=stops,
        measured=taken.measured @ turn,
        covariance=turned @ taken.covariance @ turned.T,
    )
    for move in moves:
        here = here.renamed(move.frame, move.twin, stops >= starts[move.twin])
    effects = tuple(effect.take(repeated).carried(turned) for effect in problem.effects)
    there = replace(problem, observations=here, effects=effects)
    known, squares = _known(there), np.full(len(stops), np.inf)
    if known.any() and any(step.robot for group in there.groups for step in group.path):
        squares[known] = by_noise_alone(there.subset(known), fit)
    return squares


def _known(problem: Problem) -> Mask:
    """(n,) whether every robot in an observation's way has a known pose."""
    known = np.ones(len(problem), dtype=bool)
    for group in problem.groups:
        for step in group.path:
            if step.robot:
                poses = problem.poses[step.robot][problem.observations.stops[group.rows]]
                known[group.rows] &= np.isfinite(poses[:, 0, 0])
    return known


def exchanged(problem: Problem, fitting: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Pairs of observations of the same two frames, of which each fits the other's stop.

    Args:
        problem: All observations.
        fitting: The other stops that some of them fit; see `other_stops`.
    """
    seen, found = problem.observations, {}
    first = [observer.partition("@")[0] for observer in seen.observers]
    second = [name.partition("@")[0] for name in seen.observed]
    for a, b in combinations(sorted(fitting), 2):
        alike = (first[a], second[a]) == (first[b], second[b])
        if alike and seen.stops[b] in fitting[a] and seen.stops[a] in fitting[b]:
            found[a], found[b] = b, a
    return found
