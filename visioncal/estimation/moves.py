"""Frames that moved during the session by more than noise: a bumped camera, a board that sags.

From some stop on, all observations of a frame agree on one other pose of it, or it crept all the
time. Such motion is found by the number of observations that only it explains. `steps` finds what
is within the noise of single observations.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.quantiles import FALSE_REJECTION, chi2_limit
from visioncal.core.transforms import adjoint, exp, invert, log
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.solve import Solution, by_noise_alone
from visioncal.session.tree import Branch

# Name of the effect of a frame that creeps, before its owner's.
CREEP = "creep"


@dataclass(frozen=True, eq=False)
class Move:
    """A frame that moved at some stop."""

    frame: str  # The frame's name before the move.
    twin: str  # Its name from the move on.
    stop: int  # The first stop after the move.


def moved(
    problem: Problem, fit: Solution, frame: str, stop: int, change: FloatArray
) -> tuple[Problem, Solution, Move]:
    """The problem in which a frame is two frames from a stop on, its state, and the move.

    `change` (6,) is the new pose in the frame's own old pose, as a twist.
    """
    first, _, number = frame.partition("@")
    count = int(number or 1) + 1
    while (twin := f"{first}@{count}") in problem.tree.branches:
        count += 1
    edge = Branch(problem.tree.branches[frame].parent)
    split = replace(
        problem,
        tree=replace(problem.tree, branches={**problem.tree.branches, twin: edge}),
        observations=problem.observations.renamed(frame, twin, problem.observations.stops >= stop),
    )
    frames = problem.frames(fit.state)
    frames[twin] = frames[frame] @ exp(change)
    edges = np.array([frames[name] for name in split.unknown])
    return split, replace(fit, state=State(edges, fit.state.values)), Move(frame, twin, stop)


def explained_by_noise(problem: Problem, fit: Solution, among: int) -> Mask:
    """(n,) inlier mask at the current parameters, of `among` observations in all."""
    return np.asarray(by_noise_alone(problem, fit) < _noise_limit(among))


def _noise_limit(among: int) -> float:
    """Limit of the squared distance of noise, for `among` observations."""
    return float(chi2_limit(FALSE_REJECTION / among, 6))


def fitted_change(
    problem: Problem, fit: Solution, known: FloatArray, frame: str, twin: str
) -> tuple[FloatArray, FloatArray]:
    """A fitted change (6,) from a frame to its twin, in its own old pose, and its covariance.

    The problem has both frames, and `known` (p, p) is the covariance of its unknowns.
    """
    first, second = (problem.edge_columns(name) for name in (frame, twin))
    before, after = (fit.state.edges[problem.unknown[name]] for name in (frame, twin))
    between = invert(before) @ after
    jacobian = np.zeros((6, len(known)))
    jacobian[:, first], jacobian[:, second] = -adjoint(invert(between)), np.eye(6)
    return log(between), jacobian @ known @ jacobian.T


def still_to_come(progress: FloatArray, rate: float) -> FloatArray:
    """(k,) share of what goes on over the session, and fades by a rate, after each moment.

    `progress` (k,) is -1 at the session's first stop, and 0 at its last.
    """
    over = progress + 1.0
    if rate == 0.0:
        return np.asarray(1.0 - over)
    end = np.exp(-rate)
    return np.asarray((np.exp(-rate * over) - end) / (1.0 - end))


def _progress(stops: IntArray, problem: Problem) -> FloatArray:
    """(n,) share of the session at stops: -1 at its first, 0 at its last."""
    counts = [len(poses) for poses in problem.poses.values()]
    last = max(counts, default=int(problem.observations.stops.max()) + 1) - 1
    return np.asarray(stops / max(last, 1) - 1.0)


@dataclass(frozen=True, eq=False)
class Creep(Effect):
    """Motion of a frame up to its pose at the last stop, a twist in its own axes there."""

    frame: str = ""
    rate: float = 0.0  # By which it fades, over the session; zero of an even one.

    @classmethod
    def at(cls, problem: Problem, state: State, frame: str, rate: float = 0.0) -> "Creep":
        """The motion of a frame of a problem, linearised at a state."""
        jacobian = problem.linear(state, ideal=True).jacobian[:, :, problem.edge_columns(frame)]
        left = still_to_come(_progress(problem.observations.stops, problem), rate)
        free = cls.free(f"{CREEP} of {frame}", by_sensor=jacobian * left[:, None, None])
        return replace(free, frame=frame, rate=rate)


def creep_effects(problem: Problem) -> tuple[Creep, ...]:
    """The effects of a problem's frames that creep, in the order in which they were found."""
    return tuple(effect for effect in problem.effects if isinstance(effect, Creep))


def still_frames(problem: Problem, frames: Iterable[str]) -> list[str]:
    """Frames among some that do not creep: no move is searched in one that creeps."""
    crept = {effect.frame for effect in creep_effects(problem)}
    return [name for name in frames if name.partition("@")[0] not in crept]


def may_have_crept(problem: Problem, frame: str) -> bool:
    """Whether a frame is neither one that creeps, nor one of two places of one that moved."""
    is_moved = "@" in frame or f"{frame}@2" in problem.tree.branches
    return not is_moved and frame in still_frames(problem, [frame])


def with_creep(
    problem: Problem, state: State, frame: str, change: FloatArray
) -> tuple[Problem, State]:
    """The problem in which a frame creeps by a (6,) twist, and its state: it was in the middle."""
    edges = state.edges.copy()
    edges[problem.unknown[frame]] = edges[problem.unknown[frame]] @ exp(-0.5 * change)
    wide = problem.with_effects([*problem.effects, Creep.at(problem, state, frame)])
    return wide, State(edges, np.append(state.values, change))


def find_creep(
    problem: Problem, fit: Solution, agrees: Mask, frame: str
) -> tuple[int, FloatArray] | None:
    """How many more observations agree where a frame creeps, and its (6,) twist; None for few.

    See `with_creep`. Observations agree by what they are of, since the frame may be all that ties
    its observers. The speed is the median of those of their pairs (Theil 1950, Sen 1968).
    """
    rows = problem.observations.involves(frame)
    part, among = problem.subset(rows), len(problem)
    changes, covariance = _implied_changes(part, fit, frame)
    left, groups = -_progress(part.observations.stops, problem), [at.rows for at in part.groups]
    speeds = list[FloatArray]()
    for group in groups:
        # Share of the session that two observations lie apart at least, whose difference shows a
        # speed.
        first, second = np.nonzero(left[group][:, None] - left[group] > 0.25)
        between = log(invert(changes[group[second]]) @ changes[group[first]])
        speeds.append(between / (left[group[first]] - left[group[second]])[:, None])
    speed = np.median(np.concatenate(speeds), axis=0) if sum(map(len, speeds)) else np.zeros(6)
    ends, weights = changes @ exp(-left[:, None] * speed), np.linalg.inv(covariance)
    count = 0
    for group in groups:
        middle = group[np.argsort(np.linalg.norm(ends[group, :3, 3], axis=1))[len(group) // 2]]
        away = log(invert(ends[middle]) @ ends[group])
        # A difference of two places has twice the variance.
        squares = np.einsum("ni,nij,nj->n", away, weights[group], away) / 2.0
        count += int((squares < _noise_limit(among)).sum())
    return (count - int(agrees[rows].sum()), speed) if count >= 2 * FEWEST_VIEWS else None


def _implied_changes(part: Problem, fit: Solution, frame: str) -> tuple[FloatArray, FloatArray]:
    """(n, 4, 4) changes of a frame that single observations imply, and their (n, 6, 6) covariances.

    Each is on the right of the frame's edge.
    """
    linear = part.linear(fit.state, ideal=True)
    inverse = np.linalg.inv(linear.jacobian[:, :, part.edge_columns(frame)])
    covariance = inverse @ part.total_covariance(linear, fit.noise) @ np.swapaxes(inverse, 1, 2)
    return part.change_of(frame, fit.state), covariance


def find_move(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str]
) -> tuple[str, int, FloatArray] | None:
    """Frame, stop and (6,) change of the move that explains most outliers; None for too few.

    Of a frame that creeps, where that explains more, the stop is -1. A pushed robot base is no
    move: its observations stay outliers. `agrees` is the (n,) inlier mask.
    """
    bases, is_oriented = _unknown_bases(problem), problem.observations.directions > 3
    found = []
    for frame in (*movable, *bases):
        rows = problem.observations.involves(frame)
        if frame in bases:
            rows = observations_over(problem, fit, frame)
        # A single place shows no pose, and no change of one.
        if np.sum(~agrees[rows]) >= FEWEST_VIEWS and is_oriented[rows].all():
            found += [(*step, frame) for step in _best_move(problem, fit, agrees, frame, rows)]
            may_creep = frame not in bases and may_have_crept(problem, frame)
            crept = find_creep(problem, fit, agrees, frame) if may_creep else None
            if crept is not None and crept[0] >= FEWEST_VIEWS:
                found.append((crept[0], -1, crept[1], frame))
    if not found:
        return None
    # Of equal ones the first: what moved at once.
    _, stop, change, frame = max(found, key=lambda step: step[0])
    return None if frame in bases else (frame, stop, change)


def _unknown_bases(problem: Problem) -> list[str]:
    """The bases of robots that are estimated."""
    return [base for base in problem.tree.bases.values() if base in problem.unknown]


def observations_over(problem: Problem, fit: Solution, base: str) -> Mask:
    """(n,) observations whose chains lead over a robot's base."""
    return np.isfinite(problem.change_of(base, fit.state)[:, 0, 0])


def find_push(problem: Problem, fit: Solution, agrees: Mask) -> tuple[str, int, FloatArray] | None:
    """Base, first stop and (6,) change of the push that explains most outliers over this base.

    The search begins with the earliest stops, so that the inliers are those before the push.
    """
    found = []
    for base in _unknown_bases(problem):
        rows = observations_over(problem, fit, base)
        least = max(FEWEST_VIEWS, 0.5 * np.sum(~agrees[rows]))
        if np.sum(~agrees[rows]) >= FEWEST_VIEWS:
            for gain, stop, change in _best_move(problem, fit, agrees, base, rows):
                if gain >= least:
                    found.append((gain, (base, stop, change)))
    return max(found, key=lambda push: push[0])[1] if found else None


def _best_move(
    problem: Problem, fit: Solution, agrees: Mask, frame: str, rows: Mask
) -> list[tuple[int, int, FloatArray]]:
    """The move of a frame that explains most: further observations, first stop, (6,) change."""
    part = problem.subset(rows)
    order = np.argsort(part.observations.stops, kind="stable")
    changes, covariance = (of_rows[order] for of_rows in _implied_changes(part, fit, frame))
    stops, explained = part.observations.stops[order], agrees[rows][order]
    outliers = np.flatnonzero(~explained)
    # Number of observations whose implied change is tried as a candidate.
    tried = outliers[np.linspace(0, len(outliers) - 1, min(24, len(outliers))).astype(int)]
    differences = log(invert(changes[tried])[:, None] @ changes[None])
    covariances = covariance[tried][:, None] + covariance[None]
    squares = np.einsum(
        "abi,abi->ab", differences, np.linalg.solve(covariances, differences[..., None])[..., 0]
    )
    agreeing = squares < _noise_limit(len(problem))
    gains = np.cumsum((agreeing.astype(int) - explained.astype(int))[:, ::-1], axis=1)[:, ::-1]
    # Of equally good stops the last: between them the data favour neither pose.
    first = np.flatnonzero(np.diff(stops, prepend=-1) > 0)[::-1]
    candidate, index = np.unravel_index(gains[:, first].argmax(), (len(tried), len(first)))
    begin = int(first[index])
    after = agreeing[candidate] & (stops >= stops[begin])
    gain = int(gains[candidate, begin])
    # Least share of the following observations explained; others may have moved, too, or be wrong.
    if (
        gain < FEWEST_VIEWS
        or len(np.unique(stops[after])) < FEWEST_VIEWS
        or len(np.unique(stops[explained & (stops < stops[begin])])) < FEWEST_VIEWS
        or after.sum() <= 0.25 * (len(stops) - begin)
    ):
        return []
    # The mean over all observations that agree with this step.
    weights = np.linalg.inv(covariance[after])
    weighted_sum = np.einsum("nij,nj->i", weights, differences[candidate, after])
    mean = np.linalg.solve(weights.sum(axis=0), weighted_sum)
    return [(gain, int(stops[begin]), log(changes[tried[candidate]] @ exp(mean)))]
