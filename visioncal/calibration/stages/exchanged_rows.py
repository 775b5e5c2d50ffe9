"""Search for other stops that outliers fit, and for pairs of exchanged rows."""

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
from visioncal.estimation.solve import (
    Solution,
    by_noise_alone,
)

# False-alarm probability of an observation at its own stop, and the factor on its squared distance
# for other ones: the prediction has errors, too, and wrong stops are much farther.
_CHANCE, _NEAR = 1e-3, 4.0


def other_stops(
    problem: Problem,
    used: Mask,
    fit: Solution,
    out: IntArray,
    moves: Sequence[Move] = (),
    turns: Mapping[str, FloatArray] = MappingProxyType({}),
) -> dict[int, list[int]]:
    """Other stops that outliers fit, best first, by observation.

    Args:
        problem: All n observations.
        used: (n,) mask of those in the fit.
        fit: The fit.
        out: Observations that are left out.
        moves: Frames that moved between stops.
        turns: (k, 4, 4) `target_from_turned` of targets that look the same turned, by frame.
    """
    seen = problem.observations
    # A move may have happened anywhere between the last stop before and the first one after it.
    late = {move.twin: move.stop for move in moves}
    early = {
        move.twin: int(seen.stops[seen.involves(move.frame) & used].max(initial=-1)) + 1
        for move in moves
    }
    found = {}
    for at in out.tolist():
        # The pose of a symmetric target was chosen to fit its own stop best.
        alike = turns.get(seen.observed[at].partition("@")[0], np.eye(4)[None])
        squares = np.min(
            [
                _squares_by_stop(problem, fit, at, moves, starts, turn)
                for starts in (late, early)
                for turn in alike
            ],
            axis=0,
        )
        # Stops in the same posture do not count: an observation fits its own about as well.
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
    """Squared Mahalanobis distances (s,) of an observation from its prediction at every stop."""
    # Infinite where a robot's pose is not known, or where no robot is in the chain. Frames that
    # moved are at their second place from the stops in `starts` on.
    seen = problem.observations
    stops = np.arange(max(map(len, problem.poses.values()), default=0))
    repeated = np.full(len(stops), at)
    observer, observed = (pair[at].partition("@")[0] for pair in (seen.observers, seen.observed))
    copies, turned = seen.take(repeated), adjoint(invert(turn))
    copies = replace(
        copies,
        observers=(observer,) * len(stops),
        observed=(observed,) * len(stops),
        stops=stops,
        measured=copies.measured @ turn,
        covariance=turned @ copies.covariance @ turned.T,
    )
    for move in moves:
        copies = copies.renamed(move.frame, move.twin, stops >= starts[move.twin])
    effects = tuple(effect.take(repeated).carried(turned) for effect in problem.effects)
    at_stops = replace(problem, observations=copies, effects=effects)
    known, squares = _has_robot_poses(at_stops), np.full(len(stops), np.inf)
    if known.any() and any(step.robot for group in at_stops.groups for step in group.path):
        squares[known] = by_noise_alone(at_stops.subset(known), fit)
    return squares


def _has_robot_poses(problem: Problem) -> Mask:
    """Mask (n,) of observations with known poses of all robots in their chains."""
    known = np.ones(len(problem), dtype=bool)
    for group in problem.groups:
        for step in group.path:
            if step.robot:
                poses = problem.poses[step.robot][problem.observations.stops[group.rows]]
                known[group.rows] &= np.isfinite(poses[:, 0, 0])
    return known


def exchanged(problem: Problem, fitting: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Pairs of observations that each fit the other's stop, by the result of `other_stops`."""
    seen, pairs = problem.observations, {}
    first = [observer.partition("@")[0] for observer in seen.observers]
    second = [name.partition("@")[0] for name in seen.observed]
    for a, b in combinations(sorted(fitting), 2):
        alike = (first[a], second[a]) == (first[b], second[b])
        if alike and seen.stops[b] in fitting[a] and seen.stops[a] in fitting[b]:
            pairs[a], pairs[b] = b, a
    return pairs
