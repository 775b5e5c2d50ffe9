"""Moves during the session: a bumped camera, a displaced board.

From some stop on, all observations of a frame agree on one other pose of it. Such a move is found
by the number of observations that only it explains. `slight_steps` finds those within the noise of
single observations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.quantiles import chi2_limit, f_limit
from visioncal.core.transforms import adjoint, exp, invert, log, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import (
    Solution,
    by_noise_alone,
    fitted_covariance,
)

# Least number of further observations, and of stops, that a move must explain.
FEWEST = 3
# Least share of the following observations explained; others may have moved, too, or be wrong.
_LEAST_SHARE = 0.25
# Number of observations whose implied change is tried as a candidate.
_CANDIDATES = 24
_FALSE_ALARM, FALSE_MOVE = 1e-3, 1e-4
# Factor on the noise, which a share of the stops underestimates.
_MARGIN = 2.0
# Share of the gain at which another frame may be the one that moved.
_RIVAL_SHARE = 0.9
# Candidates with this share of the greatest gain are followed up by one more, up to a number;
# different steps of each frame.
_RIVAL_GAIN, _MOST_TRIED, _STEPS_EACH = 0.6, 6, 2


@dataclass(frozen=True, eq=False)
class Move:
    """A frame that moved at some stop."""

    frame: str  # The frame's name before the move.
    twin: str  # Its name from the move on.
    stop: int  # The first stop after the move.
    change: FloatArray  # (4, 4) its new pose in its own old frame: as first estimated.
    rivals: tuple[str, ...] = ()  # Frames whose move would explain as much.
    mahalanobis_sq: float = 0.0  # The evidence for it, where it is slight.


def moved(problem: Problem, fit: Solution, move: Move) -> tuple[Problem, Solution]:
    """The problem in which a moved frame is two frames, and its state."""
    rows = problem.observations.stops >= move.stop
    split = replace(
        problem,
        tree=problem.tree.with_twin(move.frame, move.twin),
        observations=problem.observations.renamed(move.frame, move.twin, rows),
    )
    frames = problem.frames(fit.state)
    frames[move.twin] = frames[move.frame] @ move.change
    edges = np.array([frames[name] for name in split.unknown])
    return split, replace(fit, state=State(edges, fit.state.values))


def explained_by_noise(problem: Problem, fit: Solution, among: int) -> Mask:
    """(n,) inlier mask at the current parameters, of `among` observations in all."""
    return np.asarray(by_noise_alone(problem, fit) < _noise_limit(among))


def _noise_limit(among: int) -> float:
    """Limit of the squared distance of noise, for `among` observations."""
    return _MARGIN**2 * float(chi2_limit(_FALSE_ALARM / among, 6))


def _weighted_mean(twists: FloatArray, weights: FloatArray) -> FloatArray:
    """(6,) weighted mean of (n, 6) twists, by their (n, 6, 6) information."""
    weighted_sum = np.einsum("nij,nj->i", weights, twists)
    return np.asarray(np.linalg.solve(weights.sum(axis=0), weighted_sum))


def better_stop(problem: Problem, fit: Solution, move: Move) -> int:
    """The stop of a move that explains most, now that both poses are fitted."""
    involved = problem.observations.involves(move.frame) | problem.observations.involves(move.twin)
    part = problem.subset(involved)
    all_rows = np.ones(len(part), dtype=bool)
    explained = []
    for old, new in ((move.twin, move.frame), (move.frame, move.twin)):
        renamed = replace(part, observations=part.observations.renamed(old, new, all_rows))
        explained.append(explained_by_noise(renamed, fit, len(problem)))
    stops = part.observations.stops
    choices = np.unique(stops)
    counts = [np.sum(np.where(stops < choice, *explained)) for choice in choices]
    best = max(counts)
    if counts[int(np.searchsorted(choices, move.stop))] == best:
        return move.stop
    return int(choices[int(np.argmax(counts))])


def moved_earlier_or_later(
    problem: Problem, moves: Sequence[Move], move: Move, stop: int
) -> tuple[Problem, list[Move]]:
    """The problem with a move at another stop."""
    observations = problem.observations
    after = observations.stops >= stop
    renamed = observations.renamed(move.frame, move.twin, after).renamed(
        move.twin, move.frame, ~after
    )
    return (
        replace(problem, observations=renamed),
        [replace(item, stop=stop) if item is move else item for item in moves],
    )


def needless_move(problem: Problem, fit: Solution, moves: Sequence[Move]) -> Move | None:
    """The least significant move if its two poses are equal up to noise; else None."""
    if not moves:
        return None
    covariance = fitted_covariance(problem, fit.state, fit.noise)
    candidates = []
    for move in moves:
        change, change_covariance = fitted_change(problem, fit, covariance, move)
        candidates.append((float(change @ np.linalg.solve(change_covariance, change)), move))
    distance_sq, move = min(candidates, key=lambda pair: pair[0])
    stops = len(np.unique(problem.observations.stops))
    return move if distance_sq < move_limit(problem, len(problem.unknown) * stops) else None


def fitted_change(
    problem: Problem, fit: Solution, known: FloatArray, move: Move
) -> tuple[FloatArray, FloatArray]:
    """A fitted change (6,) in the frame's own old pose, and its covariance (6, 6).

    The problem has both frames, and `known` (p, p) is the covariance of its unknowns.
    """
    first, second = (problem.unknown[name] for name in (move.frame, move.twin))
    between = invert(fit.state.edges[first]) @ fit.state.edges[second]
    jacobian = np.zeros((6, len(known)))
    jacobian[:, 6 * first : 6 * first + 6] = -adjoint(invert(between))
    jacobian[:, 6 * second : 6 * second + 6] = np.eye(6)
    return log(between), jacobian @ known @ jacobian.T


def unmoved(
    problem: Problem, fit: Solution, moves: Sequence[Move], move: Move
) -> tuple[Problem, Solution, list[Move]]:
    """The problem without a move, its two frames merged; later moves stay."""
    twin_index = problem.unknown[move.twin]
    all_rows = np.ones(len(problem), dtype=bool)
    merged = replace(
        problem,
        tree=problem.tree.without([move.twin]),
        observations=problem.observations.renamed(move.twin, move.frame, all_rows),
    )
    state = State(np.delete(fit.state.edges, twin_index, axis=0), fit.state.values)
    remaining = [
        replace(item, frame=move.frame if item.frame == move.twin else item.frame)
        for item in moves
        if item is not move
    ]
    return merged, replace(fit, state=state), remaining


def twin_name(problem: Problem, frame: str) -> str:
    """An unused name for a frame from its move on."""
    first, _, number = frame.partition("@")
    count = int(number or 1) + 1
    while f"{first}@{count}" in problem.tree.branches:
        count += 1
    return f"{first}@{count}"


def find_gross_move(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str]
) -> Move | None:
    """The move that explains most outliers; None where none explains enough.

    Two simultaneous moves look like one where both frames are seen: of moves that explain about as
    much, the one counts after which the next explains most. A pushed robot base is no move: its
    observations stay outliers. `agrees` is the (n,) inlier mask.
    """
    steps = _steps(problem, fit, agrees, movable)
    if not steps or _pushed_gain(problem, fit, agrees) > steps[0].gain:
        return None
    rivals = [step for step in steps if step.gain >= _RIVAL_GAIN * steps[0].gain][:_MOST_TRIED]
    moves = [
        Move(step.frame, twin_name(problem, step.frame), step.stop, step.change) for step in rivals
    ]
    if len(rivals) == 1:
        return moves[0]
    followed = [_followed(problem, fit, agrees, movable, move) for move in moves]
    totals = [rival.gain + gain for rival, (gain, _) in zip(rivals, followed, strict=True)]
    best = int(np.argmax(totals))
    # The next move is no rival: that frame moved as well.
    moved_frames = {moves[best].frame, followed[best][1]}
    others = [
        rival.frame
        for rival, total in zip(rivals, totals, strict=True)
        if total >= _RIVAL_SHARE * totals[best] and rival.frame not in moved_frames
    ]
    return replace(moves[best], rivals=tuple(dict.fromkeys(others)))


@dataclass(frozen=True, eq=False)
class _MoveCandidate:
    """A step of a frame from a stop on, and the number of further observations it explains."""

    gain: int
    frame: str
    stop: int
    change: FloatArray


def _steps(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str]
) -> list[_MoveCandidate]:
    """The steps that explain enough, by descending gain."""
    steps: list[_MoveCandidate] = []
    for frame in movable:
        rows = np.flatnonzero(problem.observations.involves(frame))
        if np.sum(~agrees[rows]) >= FEWEST:
            steps += _best_steps(problem, fit, agrees, frame, rows)
    return sorted(steps, key=lambda value: -value.gain)


def _pushed_gain(problem: Problem, fit: Solution, agrees: Mask) -> int:
    """Greatest gain of a step of a robot's base."""
    gains = [0]
    for base in set(problem.tree.bases.values()):
        if base not in problem.unknown:
            continue
        rows = np.flatnonzero(np.isfinite(problem.change_of(base, fit.state)[:, 0, 0]))
        if np.sum(~agrees[rows]) >= FEWEST:
            gains += [step.gain for step in _best_steps(problem, fit, agrees, base, rows)]
    return max(gains)


def _followed(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str], move: Move
) -> tuple[int, str]:
    """Gain of the best next move, and its frame."""
    split, split_fit = moved(problem, fit, move)
    involved = split.observations.involves(move.twin)
    agrees = np.where(involved, explained_by_noise(split, split_fit, len(problem)), agrees)
    steps = _steps(split, split_fit, agrees, (*movable, move.twin))
    return (steps[0].gain, steps[0].frame) if steps else (0, "")


def _best_steps(
    problem: Problem, fit: Solution, agrees: Mask, frame: str, rows: IntArray
) -> list[_MoveCandidate]:
    """The step of a frame that explains most, and the best one that differs from it."""
    part = problem.subset(np.isin(np.arange(len(problem)), rows))
    order = np.argsort(part.observations.stops, kind="stable")
    changes = part.change_of(frame, fit.state)[order]
    covariance = _change_covariance(part, fit, frame)[order]
    stops, explained = part.observations.stops[order], agrees[rows][order]
    outliers = np.flatnonzero(~explained)
    tried = outliers[np.linspace(0, len(outliers) - 1, min(_CANDIDATES, len(outliers))).astype(int)]
    differences = log(invert(changes[tried])[:, None] @ changes[None])
    covariances = covariance[tried][:, None] + covariance[None]
    squares = np.einsum(
        "abi,abi->ab", differences, np.linalg.solve(covariances, differences[..., None])[..., 0]
    )
    agreeing = squares < _noise_limit(len(problem))
    gains = np.cumsum((agreeing.astype(int) - explained.astype(int))[:, ::-1], axis=1)[:, ::-1]
    # Of equally good stops the last: between them the data favour neither pose.
    first = np.flatnonzero(np.diff(stops, prepend=-1) > 0)[::-1]
    steps, available = [], np.ones(len(tried), dtype=bool)
    for _ in range(_STEPS_EACH):
        candidate, stop_index = np.unravel_index(
            np.where(available[:, None], gains[:, first], -1).argmax(),
            (len(tried), len(first)),
        )
        begin = int(first[stop_index])
        after = agreeing[candidate] & (stops >= stops[begin])
        gain = int(gains[candidate, begin]) if available[candidate] else 0
        if gain >= FEWEST and _is_enough(after, explained, stops, begin):
            # The mean over all observations that agree with this step.
            weights = np.asarray(np.linalg.inv(covariance[after]), dtype=float)
            mean = _weighted_mean(differences[candidate, after], weights)
            change = changes[tried[candidate]] @ exp(mean)
            steps.append(_MoveCandidate(gain, frame, int(stops[begin]), change))
        available &= ~agreeing[candidate][tried]
        available[candidate] = False
    return steps


def _is_enough(after: Mask, explained: Mask, stops: IntArray, begin: int) -> bool:
    """Whether a step from a row on is seen at enough stops, before it and after."""
    return bool(
        len(np.unique(stops[after])) >= FEWEST
        and len(np.unique(stops[explained & (stops < stops[begin])])) >= FEWEST
        and after.sum() > _LEAST_SHARE * (len(stops) - begin)
    )


def _change_covariance(problem: Problem, fit: Solution, frame: str) -> FloatArray:
    """Covariances (n, 6, 6) of the changes of a frame implied by observations."""
    linear = problem.linear(fit.state, ideal=True)
    covariance = problem.total_covariance(linear, fit.noise)
    inverse = np.linalg.inv(linear.jacobian[:, :, problem.edge_columns(frame)])
    return np.asarray(inverse @ covariance @ np.swapaxes(inverse, 1, 2))


def common_change(
    problem: Problem, fit: Solution, frame: str, some: Mask
) -> tuple[FloatArray, Mask] | None:
    """The new pose of a frame that (n,) some observations agree on, by a fit of others.

    Returns:
        (4, 4) the change in the frame's own pose, and for each of them whether noise explains the
        rest; None where not all involve the frame.
    """
    part = problem.subset(some)
    if not part.observations.involves(frame).all():
        return None
    changes, covariance = part.change_of(frame, fit.state), _change_covariance(part, fit, frame)
    middle = mean_transform(changes)
    differences = log(invert(middle) @ changes)
    weights = np.asarray(np.linalg.inv(covariance), dtype=float)
    mean = _weighted_mean(differences, weights)
    residuals = differences - mean
    squares = np.einsum("ni,nij,nj->n", residuals, weights, residuals)
    return middle @ exp(mean), squares < _noise_limit(len(problem))


def move_limit(problem: Problem, tried: int, kinds: int = 1) -> float:
    """Limit of the squared length of a significant step, for a number tried (F distribution).

    `kinds` is the number of kinds of residuals, if a step may be in one of them alone.
    """
    freedom = max(0.5 * (6.0 * len(problem) - problem.size) / kinds, 6.0)
    return 6.0 * float(f_limit(FALSE_MOVE / tried, 6, freedom))
