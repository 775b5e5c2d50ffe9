"""Search for other stops that outliers fit, and for rows that are exchanged."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.moves import Move
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, by_noise_alone

# Times by which an outlier is nearer under another name or elsewhere: by chance, two hardly are.
_NEARER = 30.0


def other_stops(
    problem: Problem,
    fit: Solution,
    out: IntArray,
    limits: FloatArray,
    moves: Sequence[Move],
    turns: Mapping[str, FloatArray],
) -> dict[int, list[int]]:
    """Other stops that outliers fit, best first, by observation.

    Args:
        problem: All n observations.
        fit: The fit of the inliers.
        out: Observations that are left out.
        limits: (n,) squared distances up to which observations are inliers.
        moves: Frames that moved between stops.
        turns: (k, 4, 4) `target_from_turned` of targets that look the same turned, by frame.
    """
    seen, found = problem.observations, {}
    for at in out.tolist():
        # The pose of a symmetric target was chosen to fit its own stop best.
        alike = turns.get(seen.observed[at].partition("@")[0], np.eye(4)[None])
        squares = np.min([_at_stops(problem, fit, at, moves, turn) for turn in alike], axis=0)
        # Stops in the same posture do not count: an observation fits its own about as well.
        limit = min(limits[at], squares[seen.stops[at]] / CLEAR_RATIO**2)
        near = np.flatnonzero(squares < limit)
        if len(near):
            found[at] = near[np.argsort(squares[near])].tolist()
    return found


def _at_stops(
    problem: Problem, fit: Solution, at: int, moves: Sequence[Move], turn: FloatArray
) -> FloatArray:
    """Squared Mahalanobis distances (s,) of an observation from its prediction at every stop."""
    # Infinite where a robot's pose is not known.
    seen = problem.observations
    stops = np.arange(max(map(len, problem.poses.values()), default=0))
    repeated, turned = np.full(len(stops), at), adjoint(invert(turn))
    observer, observed = (pair[at].partition("@")[0] for pair in (seen.observers, seen.observed))
    copies = seen.take(repeated)
    copies = replace(
        copies,
        observers=(observer,) * len(stops),
        observed=(observed,) * len(stops),
        stops=stops,
        measured=copies.measured @ turn,
        covariance=turned @ copies.covariance @ turned.T,
    )
    for move in moves:
        copies = copies.renamed(move.frame, move.twin, stops >= move.stop)
    effects = tuple(effect.take(repeated).carried(turned) for effect in problem.effects)
    at_stops = replace(problem, observations=copies, effects=effects)
    known = np.isfinite(at_stops.predicted(fit.state)[:, 0, 0])
    squares = np.full(len(stops), np.inf)
    squares[known] = by_noise_alone(at_stops.subset(known), fit)
    return squares


def other_names(
    problem: Problem,
    fit: Solution,
    out: IntArray,
    moves: Sequence[Move],
    seen_by: Callable[[int, str], FloatArray],
) -> dict[int, tuple[str, str]]:
    """Frames `(observer, observed)` that outliers fit at their own stop, one of both another one.

    A lens or a board that is not the named one leaves a pose that is off by much more than noise,
    and by far less than another place. Arguments as of `other_stops`, and (4, 4) what an
    observation is by the lens of an observer.
    """
    seen, found = problem.observations, dict[int, tuple[str, str]]()
    frames = {*problem.tree.branches, problem.tree.root}
    for at in out.tolist():
        given = tuple(pair[at].partition("@")[0] for pair in (seen.observers, seen.observed))
        likes = [
            sorted(name for name in frames if name.partition("_")[0] == frame.partition("_")[0])
            for frame in given
        ]
        pairs = [
            given,
            *((name, given[1]) for name in likes[0]),
            *((given[0], name) for name in likes[1]),
        ]
        pairs = [*dict.fromkeys(pairs)]
        repeated = np.full(len(pairs), at)
        observers, observed = zip(*pairs, strict=True)
        measured = np.array([seen_by(at, observer) for observer in observers])
        named = replace(
            seen.take(repeated), observers=observers, observed=observed, measured=measured
        )
        for move in moves:
            named = named.renamed(move.frame, move.twin, named.stops >= move.stop)
        effects = tuple(effect.take(repeated) for effect in problem.effects)
        as_named = replace(problem, observations=named, effects=effects)
        known = np.isfinite(as_named.predicted(fit.state)[:, 0, 0])
        squares = np.full(len(pairs), np.inf)
        squares[known] = by_noise_alone(as_named.subset(known), fit)
        best = int(squares.argmin())
        if best and _NEARER**2 * squares[best] < squares[0]:
            found[at] = pairs[best]
    return found


def other_robots(problem: Problem, fit: Solution, out: IntArray) -> dict[int, tuple[str, str]]:
    """Two robots that have each other's poses at its stop, by outlier among (n,) that fits so."""
    found = dict[int, tuple[str, str]]()
    part = problem.subset(np.isin(np.arange(len(problem)), out))
    stated = by_noise_alone(part, fit)
    for first, second in combinations(problem.poses, 2):
        poses = dict(problem.poses)
        poses[first], poses[second] = poses[second], poses[first]
        other = replace(part, poses=poses)
        known = np.isfinite(other.predicted(fit.state)[:, 0, 0])
        nearer = _NEARER**2 * by_noise_alone(other.subset(known), fit) < stated[known]
        found |= dict.fromkeys(np.sort(out)[known][nearer].tolist(), (first, second))
    return found


def shifted_images(
    problem: Problem, fit: Solution, out: IntArray, moves: Sequence[Move]
) -> tuple[int, list[int]]:
    """Number of stops by which images of outliers (n,) of one camera are apart, and which are.

    None are where that is zero: more than half of them fit the stop so many before, or after.
    """
    seen, found = problem.observations, dict[int, list[int]]()
    squares = {at: _at_stops(problem, fit, at, moves, np.eye(4)) for at in out.tolist()}
    for by in (-1, 1, -2, 2, -3, 3):
        other = {at: seen.stops[at] + by for at in squares}
        found[by] = [
            at
            for at, each in squares.items()
            if 0 <= other[at] < len(each) and _NEARER**2 * each[other[at]] < each[seen.stops[at]]
        ]
    by = max(found, key=lambda some: len(found[some]))
    return (by, found[by]) if 2 * len(found[by]) > len(out) else (0, [])


def exchanged(
    problem: Problem, fitting: Mapping[int, Sequence[int]]
) -> tuple[tuple[int, ...], ...]:
    """Circles of observations that fit each other's stops, each that of the next one.

    Pairs, best first, then circles of more by the stop that each fits best; an observation is in
    one at most. Observations of two cameras may have each other's poses of their one robot.
    `fitting` is the result of `other_stops`.
    """
    seen, circles = problem.observations, list[tuple[int, ...]]()
    of_flange = {at: problem.observations_through(at) for at in problem.tree.flanges.values()}
    frames = [
        (observer.partition("@")[0], observed.partition("@")[0])
        for observer, observed in zip(seen.observers, seen.observed, strict=True)
    ]
    stops, mutual = seen.stops.tolist(), list[tuple[bool, int, int, int]]()
    robots = [tuple(at for at, rows in of_flange.items() if rows[row]) for row in range(len(stops))]
    # How many observations share each pose.
    shared = Counter(zip(stops, robots, strict=True))
    for a, b in combinations(sorted(fitting), 2):
        are_poses = len(robots[a]) == 1 and robots[a] == robots[b]
        are_poses &= shared[stops[a], robots[a]] == shared[stops[b], robots[b]] == 1
        is_alike = frames[a] == frames[b] or (are_poses and stops[a] != stops[b])
        if is_alike and stops[b] in fitting[a] and stops[a] in fitting[b]:
            by = fitting[a].index(stops[b]) + fitting[b].index(stops[a])
            mutual.append((frames[a] != frames[b], by, a, b))
    left = {*fitting}
    # Where stops are alike, an observation fits several.
    for *_, a, b in sorted(mutual):
        if left.issuperset(pair := (a, b)):
            circles.append(pair)
            left.difference_update(pair)
    index_of = {(frames[at], stops[at]): at for at in sorted(left)}
    following = {at: index_of.get((frames[at], fitting[at][0])) for at in left}
    for first in sorted(left):
        circle = [first]
        while (after := following[circle[-1]]) is not None and after not in circle:
            circle.append(after)
        if after == first and first in left:
            circles.append(tuple(circle))
            left.difference_update(circle)
    return tuple(circles)
