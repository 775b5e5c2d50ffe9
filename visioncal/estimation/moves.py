"""What moved while a cell was measured: a camera that was bumped, a board that was put elsewhere.

From some stop on, all observations of a frame ask for the same other pose of it. Such a move is
found by how many observations it explains that nothing else does. `slight_steps` finds those that
hide in the noise of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.quantiles import chi2_limit, f_limit
from visioncal.core.transforms import adjoint, exp, invert, log, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import (
    Solution,
    by_noise_alone,
    fitted_covariance,
)

# A move must explain so many observations, of so many stops, more than they are explained now.
FEWEST = 3
# ... and so many of those that follow; others may have moved, too, or be wrong.
_LEAST_SHARE = 0.25
# So many observations are asked in turn which other place they speak for.
_ASKED = 24
_FALSE_ALARM, FALSE_MOVE = 1e-3, 1e-4
# The noise that a share of the stops shows is not all that there is.
_MARGIN = 2.0
# Another frame that explains so many as well may be the one that moved.
_RIVAL_SHARE = 0.9
# Moves that explain such a share of the most are followed up by one more, not more than so many;
# of each frame so many different ones.
_RIVAL_GAIN, _MOST_TRIED, _STEPS_EACH = 0.6, 6, 2


@dataclass(frozen=True, eq=False)
class Move:
    """A frame that stands elsewhere from some stop on.

    Attributes:
        frame: The frame, as the problem knows it until then.
        twin: Its name from then on.
        stop: The first stop at which it stands elsewhere.
        change: (4, 4) where it then is, in its own frame before: as first estimated.
        rivals: Frames of which the same may be said as well.
        mahalanobis_sq: The evidence for it, where it is slight.
    """

    frame: str
    twin: str
    stop: int
    change: FloatArray
    rivals: tuple[str, ...] = ()
    mahalanobis_sq: float = 0.0


def moved(problem: Problem, fit: Solution, move: Move) -> tuple[Problem, Solution]:
    """The problem in which what moved is two frames, and its state."""
    rows = problem.observations.stops >= move.stop
    wider = replace(
        problem,
        tree=problem.tree.with_twin(move.frame, move.twin),
        observations=problem.observations.renamed(move.frame, move.twin, rows),
    )
    there = problem.frames(fit.state)
    there[move.twin] = there[move.frame] @ move.change
    edges = np.array([there[name] for name in wider.unknown])
    return wider, replace(fit, state=State(edges, fit.state.values))


def explained_by_noise(problem: Problem, fit: Solution, among: int) -> Mask:
    """(n,) whether noise explains observations as the unknowns are, out of so many in all."""
    return np.asarray(by_noise_alone(problem, fit) < _noise_limit(among))


def _noise_limit(among: int) -> float:
    """The largest squared distance that noise explains, out of so many observations."""
    return _MARGIN**2 * float(chi2_limit(_FALSE_ALARM / among, 6))


def _weighted_mean(twists: FloatArray, weights: FloatArray) -> FloatArray:
    """(6,) the mean of (n, 6) twists, each by its own (n, 6, 6) information."""
    pulls = np.einsum("nij,nj->i", weights, twists)
    return np.asarray(np.linalg.solve(weights.sum(axis=0), pulls))


def better_stop(problem: Problem, fit: Solution, move: Move) -> int:
    """The stop from which on a move explains most, now that both places are known better.

    Args:
        problem: All n observations.
        fit: The unknowns and the noise.
        move: What moved.
    """
    mine = problem.observations.involves(move.frame) | problem.observations.involves(move.twin)
    part = problem.subset(mine)
    every = np.ones(len(part), dtype=bool)
    explained = []
    for old, new in ((move.twin, move.frame), (move.frame, move.twin)):
        there = replace(part, observations=part.observations.renamed(old, new, every))
        explained.append(explained_by_noise(there, fit, len(problem)))
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
    mine = problem.observations
    after = mine.stops >= stop
    sightings = mine.renamed(move.frame, move.twin, after).renamed(move.twin, move.frame, ~after)
    return (
        replace(problem, observations=sightings),
        [replace(item, stop=stop) if item is move else item for item in moves],
    )


def needless_move(problem: Problem, fit: Solution, moves: Sequence[Move]) -> Move | None:
    """The least significant move whose two places are one, up to noise; None where none is.

    Args:
        problem: The observations that agree.
        fit: The unknowns and the noise.
        moves: What is thought to have moved.
    """
    if not moves:
        return None
    known = fitted_covariance(problem, fit.state, fit.noise)
    found = []
    for move in moves:
        away, covariance = fitted_change(problem, fit, known, move)
        found.append((float(away @ np.linalg.solve(covariance, away)), move))
    squared, move = min(found, key=lambda pair: pair[0])
    stops = len(np.unique(problem.observations.stops))
    return move if squared < move_limit(problem, len(problem.unknown) * stops) else None


def fitted_change(
    problem: Problem, fit: Solution, known: FloatArray, move: Move
) -> tuple[FloatArray, FloatArray]:
    """A change (6,) in the frame's own place before, and its covariance (6, 6), by a fit.

    Args:
        problem: The observations, with both places.
        fit: The unknowns and the noise.
        known: (p, p) the covariance of the unknowns.
        move: What moved.
    """
    first, second = (problem.unknown[name] for name in (move.frame, move.twin))
    between = invert(fit.state.edges[first]) @ fit.state.edges[second]
    slope = np.zeros((6, len(known)))
    slope[:, 6 * first : 6 * first + 6] = -adjoint(invert(between))
    slope[:, 6 * second : 6 * second + 6] = np.eye(6)
    return log(between), slope @ known @ slope.T


def unmoved(
    problem: Problem, fit: Solution, moves: Sequence[Move], move: Move
) -> tuple[Problem, Solution, list[Move]]:
    """The problem without a move, its two places being one; what moved later stays."""
    at = problem.unknown[move.twin]
    everywhere = np.ones(len(problem), dtype=bool)
    joined = replace(
        problem,
        tree=problem.tree.without([move.twin]),
        observations=problem.observations.renamed(move.twin, move.frame, everywhere),
    )
    state = State(np.delete(fit.state.edges, at, axis=0), fit.state.values)
    rest = [
        replace(item, frame=move.frame if item.frame == move.twin else item.frame)
        for item in moves
        if item is not move
    ]
    return joined, replace(fit, state=state), rest


def twin_name(problem: Problem, frame: str) -> str:
    """A name for a frame from when on it moved."""
    first, _, number = frame.partition("@")
    count = int(number or 1) + 1
    while f"{first}@{count}" in problem.tree.branches:
        count += 1
    return f"{first}@{count}"


def gross_move(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str]
) -> Move | None:
    """The move that explains most of what is not explained yet; None where none explains enough.

    Two things that moved at once look like one from where both are seen: of moves that explain
    about as much, the one counts that leaves most to the next. A robot that was pushed is none:
    what looks like it stays unexplained.

    Args:
        problem: All n observations.
        fit: The unknowns and the noise, by those that agree.
        agrees: (n,) what is explained.
        movable: Frames that may have moved.
    """
    steps = _steps(problem, fit, agrees, movable)
    if not steps or _pushed_gain(problem, fit, agrees) > steps[0].gain:
        return None
    rivals = [step for step in steps if step.gain >= _RIVAL_GAIN * steps[0].gain][:_MOST_TRIED]
    moves = [_move(problem, rival) for rival in rivals]
    if len(rivals) == 1:
        return moves[0]
    followed = [_followed(problem, fit, agrees, movable, move) for move in moves]
    totals = [rival.gain + gain for rival, (gain, _) in zip(rivals, followed, strict=True)]
    best = int(np.argmax(totals))
    # What goes next is no rival: it moved as well.
    own = {moves[best].frame, followed[best][1]}
    others = [
        rival.frame
        for rival, total in zip(rivals, totals, strict=True)
        if total >= _RIVAL_SHARE * totals[best] and rival.frame not in own
    ]
    return replace(moves[best], rivals=tuple(dict.fromkeys(others)))


@dataclass(frozen=True, eq=False)
class _MoveCandidate:
    """A step of a frame, from a stop on, and how many more observations it explains."""

    gain: int
    frame: str
    stop: int
    change: FloatArray


def _steps(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str]
) -> list[_MoveCandidate]:
    """The steps that explain enough, those that explain most first."""
    found: list[_MoveCandidate] = []
    for frame in movable:
        rows = np.flatnonzero(problem.observations.involves(frame))
        if np.sum(~agrees[rows]) >= FEWEST:
            found += _best_steps(problem, fit, agrees, frame, rows)
    return sorted(found, key=lambda value: -value.gain)


def _pushed_gain(problem: Problem, fit: Solution, agrees: Mask) -> int:
    """How many more observations the step of a robot's base explains that explains most."""
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
    """How many more observations the best next move explains, and the frame that it is of."""
    wider, there = moved(problem, fit, move)
    mine = wider.observations.involves(move.twin)
    agrees = np.where(mine, explained_by_noise(wider, there, len(problem)), agrees)
    steps = _steps(wider, there, agrees, (*movable, move.twin))
    return (steps[0].gain, steps[0].frame) if steps else (0, "")


def _move(problem: Problem, step: _MoveCandidate) -> Move:
    return Move(step.frame, twin_name(problem, step.frame), step.stop, step.change)


def _best_steps(
    problem: Problem, fit: Solution, agrees: Mask, frame: str, rows: IntArray
) -> list[_MoveCandidate]:
    """The step of a frame that explains most, and the best that is another one."""
    part = problem.subset(np.isin(np.arange(len(problem)), rows))
    order = np.argsort(part.observations.stops, kind="stable")
    asked = part.change_of(frame, fit.state)[order]
    covariance = _asked_spread(part, fit, frame)[order]
    stops, explained = part.observations.stops[order], agrees[rows][order]
    open_rows = np.flatnonzero(~explained)
    some = open_rows[np.linspace(0, len(open_rows) - 1, min(_ASKED, len(open_rows))).astype(int)]
    apart = log(invert(asked[some])[:, None] @ asked[None])
    both = covariance[some][:, None] + covariance[None]
    squares = np.einsum("abi,abi->ab", apart, np.linalg.solve(both, apart[..., None])[..., 0])
    alike = squares < _noise_limit(len(problem))
    gains = np.cumsum((alike.astype(int) - explained.astype(int))[:, ::-1], axis=1)[:, ::-1]
    # Of stops that explain as much the last: between them nothing speaks for either.
    first = np.flatnonzero(np.diff(stops, prepend=-1) > 0)[::-1]
    found, left = [], np.ones(len(some), dtype=bool)
    for _ in range(_STEPS_EACH):
        at, place = np.unravel_index(
            np.where(left[:, None], gains[:, first], -1).argmax(), (len(some), len(first))
        )
        begin = int(first[place])
        after = alike[at] & (stops >= stops[begin])
        gain = int(gains[at, begin]) if left[at] else 0
        if gain >= FEWEST and _is_enough(after, explained, stops, begin):
            # By all that ask for this step.
            weights = np.asarray(np.linalg.inv(covariance[after]), dtype=float)
            mean = _weighted_mean(apart[at, after], weights)
            change = asked[some[at]] @ exp(mean)
            found.append(_MoveCandidate(gain, frame, int(stops[begin]), change))
        left &= ~alike[at][some]
        left[at] = False
    return found


def _is_enough(after: Mask, explained: Mask, stops: IntArray, begin: int) -> bool:
    """Whether a step from a row on is seen at enough stops, before it and after."""
    return bool(
        len(np.unique(stops[after])) >= FEWEST
        and len(np.unique(stops[explained & (stops < stops[begin])])) >= FEWEST
        and after.sum() > _LEAST_SHARE * (len(stops) - begin)
    )


def _asked_spread(problem: Problem, fit: Solution, frame: str) -> FloatArray:
    """Covariances (n, 6, 6) of the changes that observations ask for."""
    linear = problem.linear(fit.state, ideal=True)
    covariance = problem.total_covariance(linear, fit.noise)
    back = np.linalg.inv(linear.jacobian[:, :, problem.edge_columns(frame)])
    return np.asarray(back @ covariance @ np.swapaxes(back, 1, 2))


def common_change(
    problem: Problem, fit: Solution, frame: str, some: Mask
) -> tuple[FloatArray, Mask] | None:
    """The other place of a frame that some observations ask for together.

    Args:
        problem: All n observations.
        fit: The unknowns and the noise, by others.
        frame: The frame.
        some: (n,) which observations.

    Returns:
        (4, 4) the change in the frame's own place, and for each of them whether noise explains what
        is left; None where not all have to do with the frame.
    """
    part = problem.subset(some)
    if not part.observations.involves(frame).all():
        return None
    asked, covariance = part.change_of(frame, fit.state), _asked_spread(part, fit, frame)
    middle = mean_transform(asked)
    apart = log(invert(middle) @ asked)
    weights = np.asarray(np.linalg.inv(covariance), dtype=float)
    mean = _weighted_mean(apart, weights)
    left = apart - mean
    squares = np.einsum("ni,nij,nj->n", left, weights, left)
    return middle @ exp(mean), squares < _noise_limit(len(problem))


def move_limit(problem: Problem, tried: int, kinds: int = 1) -> float:
    """The squared length from which a step is significant, of so many tried (F distribution).

    Args:
        problem: The observations.
        tried: How many steps are tried.
        kinds: Of how many kinds of residuals a step may be in one alone.
    """
    freedom = max(0.5 * (6.0 * len(problem) - problem.size) / kinds, 6.0)
    return 6.0 * float(f_limit(FALSE_MOVE / tried, 6, freedom))
