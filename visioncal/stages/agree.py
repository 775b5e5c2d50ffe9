"""Takes out the views that are wrong as a whole, and says which stops they fit instead."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from visioncal.chance import chi2_limit
from visioncal.estimation.moves import Move
from visioncal.estimation.outliers import LEAST_VIEWS, inliers
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, by_noise_alone
from visioncal.estimation.variance import LEAST_SIGMA
from visioncal.figures import figure
from visioncal.stages.choose import CLEAR_RATIO
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert, log, rotation_angle
from visioncal.types import FloatArray, IntArray, Mask, Mount, Rejection

# Two sound images of one stop disagree in one session of a thousand.
_FALSE_ALARM = 1e-3
# An image fits another stop where it is as near to what is predicted there as noise may put it, and
# twice as far: what is predicted has errors, too, and other stops are farther by far.
_CHANCE, _NEAR = 1e-3, 4.0
# So many of the views whose pose another one fits are named.
_NAMED = 3
# The noise of measured poses differs by so much from view to view: with tilt and distance.
_UNEVEN = 3.0


@dataclass(frozen=True, eq=False)
class Agreed:
    """The views that agree.

    Attributes:
        mask: (m,) which ones.
        frames: (4, 4) where the unknown frames are as they see them.
        rejections: The others, with the figures.
        exchanged: Pairs of them, each of which fits the pose of the other.
    """

    mask: Mask
    frames: Mapping[str, FloatArray]
    rejections: tuple[Rejection, ...]
    exchanged: tuple[tuple[int, int], ...] = ()

    @property
    def unexplained(self) -> list[Rejection]:
        """The others, but for those that are exchanged."""
        explained = {view for pair in self.exchanged for view in pair}
        return [it for it in self.rejections if it.view not in explained]

    def doubts(self) -> Iterator[str]:
        """Says which rows to exchange."""
        for first, second in self.exchanged:
            yield (
                f"Views {first} and {second} are exchanged: the image of each fits the pose in the "
                "other's row. They were left out: exchange them in views.csv, and calibrate again."
            )


def agree(
    problem: Problem,
    views: Sequence[int],
    mount: Mount,
    frames: Mapping[str, FloatArray] | None = None,
    thought: Mask | None = None,
) -> Agreed:
    """Finds the views whose robot pose and image belong together.

    A stop of the robot is right or wrong as a whole, unless its own images contradict each other:
    then each is compared with the other stops. So are its views of several targets.

    Args:
        problem: What the views measured, one observation a view.
        views: The views' numbers.
        mount: Where the camera is.
        frames: Where the unknown frames are thought to be, which it takes where there are several
            targets; None for a search without any idea.
        thought: (m,) the views that are thought to agree; None likewise.

    Returns:
        The views that agree with each other, and why the others do not.
    """
    stops, observed = problem.observations.stops, np.array(problem.observations.observed)
    several, start = len(problem.unknown) > 2, None if frames is None else problem.start(frames)
    with one_blas_thread():
        units = whole_units(problem)
        merged = problem.merged(units)
        mask = None if thought is None else np.bincount(units, thought) > 0
        if mask is None and several:
            mask = _target_by_target(merged)
        found = inliers(merged, start, mask)
    mask, state, away = found.used[units], found.fit.state, found.distances
    between = invert(problem.predicted(state)) @ problem.measured(state)
    away_m, away_rad = np.linalg.norm(between[:, :3, 3], axis=1), rotation_angle(between)
    with one_blas_thread():
        fitting = other_stops(
            problem, mask, Solution(state, found.fit.noise), np.flatnonzero(~mask)
        )
    mutual = exchanged(problem, fitting)
    counted = np.maximum(away.directions, 1)
    surprise, limit = (np.sqrt(it / counted)[units] for it in (away.squares, away.limit))
    seen = "target" if mount != "instrument" else "point" if problem.points else "probe"
    rejections = []
    for at in np.flatnonzero(~mask).tolist():
        turned = "" if problem.points else f" and {figure(np.rad2deg(away_rad[at]))} deg"
        of_its_target = (observed == observed[at]) & mask & several
        cause = _cause(views, (stops == stops[at]) & mask, of_its_target, mount)
        if at in mutual:
            other = views[mutual[at]]
            cause = f"it fits the pose of view {other}, which fits its own: they are exchanged"
        elif at in fitting:
            first = [views[int(np.argmax(stops == it))] for it in fitting[at][:_NAMED]]
            cause = f"it fits the pose of view {', '.join(map(str, first))}: {cause}"
        rejections.append(
            Rejection(
                views[at],
                f"disagrees with the other views: it places the {seen} {figure(1e3 * away_m[at])} "
                f"mm{turned} away, {figure(surprise[at])} times the noise (limit "
                f"{figure(limit[at])}); {cause}",
            )
        )
    return Agreed(
        mask,
        dict(zip(problem.unknown, state.edges, strict=True)),
        tuple(rejections),
        tuple((views[one], views[other]) for one, other in sorted(mutual.items()) if one < other),
    )


def other_stops(
    problem: Problem, used: Mask, fit: Solution, out: IntArray, moves: Sequence[Move] = ()
) -> dict[int, list[int]]:
    """The other stops that observations fit which do not fit their own, best first.

    Args:
        problem: All n observations.
        used: (n,) those that the fit was made from.
        fit: The unknowns and the noise.
        out: Observations that are left out.
        moves: What moved between stops.
    """
    seen = problem.observations
    # Between the last stop before a move and the first one after it, either may be true.
    late = {it.twin: it.stop for it in moves}
    early = {
        it.twin: int(seen.stops[seen.involves(it.frame) & used].max(initial=-1)) + 1 for it in moves
    }
    found = {}
    for at in out.tolist():
        squares = np.minimum(
            *(_squares_by_stop(problem, fit, at, moves, starts) for starts in (late, early))
        )
        # Stops in one posture are no others: what fits one of them fits its own as well, or nearly.
        limit = min(_NEAR * chi2_limit(_CHANCE, 6), squares[seen.stops[at]] / CLEAR_RATIO**2)
        near = np.flatnonzero(squares < limit)
        if len(near):
            found[at] = near[np.argsort(squares[near])].tolist()
    return found


def _squares_by_stop(
    problem: Problem, fit: Solution, at: int, moves: Sequence[Move], starts: Mapping[str, int]
) -> FloatArray:
    """Squared distances (s,) of an observation from what is predicted at every stop.

    Infinite where a robot's pose is not known, or where no robot has a part in it. What moved is at
    its other place from the stops in `starts` on.
    """
    seen = problem.observations
    stops = np.arange(max(map(len, problem.poses.values()), default=0))
    repeated = np.full(len(stops), at)
    observer, observed = (it[at].partition("@")[0] for it in (seen.observers, seen.observed))
    here = replace(
        seen.take(repeated),
        observers=(observer,) * len(stops),
        observed=(observed,) * len(stops),
        stops=stops,
    )
    for move in moves:
        here = here.renamed(move.frame, move.twin, stops >= starts[move.twin])
    effects = tuple(it.take(repeated) for it in problem.effects)
    there = replace(problem, observations=here, effects=effects)
    known, squares = _known(there), np.full(len(stops), np.inf)
    if known.any() and any(it.robot for group in there.groups for it in group.path):
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
    first = [it.partition("@")[0] for it in seen.observers]
    second = [it.partition("@")[0] for it in seen.observed]
    for a, b in combinations(sorted(fitting), 2):
        alike = (first[a], second[a]) == (first[b], second[b])
        if alike and seen.stops[b] in fitting[a] and seen.stops[a] in fitting[b]:
            found[a], found[b] = b, a
    return found


def whole_units(problem: Problem) -> IntArray:
    """Which views are right or wrong together: those of one stop, as far as their images agree.

    Views of one target at one stop share the robot's pose, and must see the target at one place up
    to the camera's noise alone. Those that do not are units by themselves, so that a wrong image
    does not take a sound one with it. Where the camera's noise is unknown, it is what pairs of
    views of one stop show in the median.

    Args:
        problem: What the views measured, one observation a view.

    Returns:
        (m,) the unit of each view, numbered from 0 in the order of first appearance.
    """
    seen, stops = problem.observations, problem.of_one_stop
    if len(np.unique(stops)) == len(stops):
        return stops
    mates = (np.flatnonzero(stops == it).tolist() for it in np.flatnonzero(np.bincount(stops) > 1))
    first, second = np.array([pair for it in mates for pair in combinations(it, 2)]).T
    away = log(invert(seen.measured[first]) @ seen.measured[second])
    if problem.is_combined:
        apart = np.median(np.sum(away.reshape(-1, 2, 3) ** 2, axis=2), axis=0)
        typical = apart / chi2_limit(0.5, 3)
        spread = _UNEVEN**2 * np.diag(np.repeat(np.maximum(typical, LEAST_SIGMA**2), 3))[None]
    else:
        spread = seen.covariance[first] + seen.covariance[second]
    squared = np.einsum("pi,pi->p", away, np.linalg.solve(spread, away[:, :, None])[:, :, 0])
    alike = squared < chi2_limit(_FALSE_ALARM / len(first), 6)
    pairs = (np.ones(alike.sum()), (first[alike], second[alike]))
    links = coo_array(pairs, shape=(len(problem), len(problem)))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _target_by_target(merged: Problem) -> Mask:
    """Which units agree with the others of their target.

    An arm that errs and a board of another size look like noise from each board alone, as both
    edges make up for them, and like a wrong board from another one. A board with few views is
    left to the others to judge.
    """
    agrees = np.ones(len(merged), dtype=bool)
    looks = [it for it in merged.effects if it.by_sensor is not None]
    for group in merged.groups:
        if len(group.rows) > LEAST_VIEWS:
            mine = np.isin(np.arange(len(merged)), group.rows)
            agrees[mine] = inliers(merged.with_effects(looks).subset(mine).pruned()).used
    return agrees


def _cause(views: Sequence[int], agreeing_mates: Mask, of_its_target: Mask, mount: Mount) -> str:
    """What is wrong with a view, by those of its stop and its target that agree with all others."""
    if of_its_target.sum() == 1:
        other = views[int(np.flatnonzero(of_its_target)[0])]
        return f"it and view {other} alone show this target, and either may be wrong"
    observed = "reading" if mount == "instrument" else "image"
    mates = np.flatnonzero(agreeing_mates)
    if len(mates):
        return (
            f"view {views[mates[0]]} of the same stop agrees: the {observed} is wrong, or "
            "something moved in between"
        )
    return f"its pose or its {observed} is wrong, or something had moved"
