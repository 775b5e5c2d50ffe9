"""Frames that moved during the session by more than noise: a bumped camera, a displaced board.

From some stop on, all observations of a frame agree on one other pose of it. Such a move is found
by the number of observations that only it explains. `steps` finds those within the noise of single
observations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.quantiles import FALSE_REJECTION, chi2_limit
from visioncal.core.transforms import adjoint, exp, invert, log
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import Solution, by_noise_alone

# Least share of the following observations explained; others may have moved, too, or be wrong.
_LEAST_SHARE = 0.25
# Number of observations whose implied change is tried as a candidate.
_CANDIDATES = 24


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
    split = replace(
        problem,
        tree=problem.tree.with_twin(frame, twin),
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


def find_move(
    problem: Problem, fit: Solution, agrees: Mask, movable: Sequence[str]
) -> tuple[str, int, FloatArray] | None:
    """Frame, stop and (6,) change of the move that explains most outliers; None for too few.

    A pushed robot base is no move: its observations stay outliers. `agrees` is the (n,) inlier
    mask.
    """
    bases = {base for base in problem.tree.bases.values() if base in problem.unknown}
    found = []
    for frame in (*movable, *bases):
        rows = problem.observations.involves(frame)
        if frame in bases:
            rows = np.isfinite(problem.change_of(frame, fit.state)[:, 0, 0])
        if np.sum(~agrees[rows]) >= FEWEST_VIEWS:
            found += [(*step, frame) for step in _best_move(problem, fit, agrees, frame, rows)]
    if not found:
        return None
    _, stop, change, frame = max(found, key=lambda step: step[0])
    return None if frame in bases else (frame, stop, log(change))


def _best_move(
    problem: Problem, fit: Solution, agrees: Mask, frame: str, rows: Mask
) -> list[tuple[int, int, FloatArray]]:
    """The move of a frame that explains most: further observations, first stop, (4, 4) change."""
    part = problem.subset(rows)
    order = np.argsort(part.observations.stops, kind="stable")
    changes = part.change_of(frame, fit.state)[order]
    # Covariances of the changes that the observations imply.
    linear = part.linear(fit.state, ideal=True)
    inverse = np.linalg.inv(linear.jacobian[:, :, part.edge_columns(frame)])
    residual_covariance = part.total_covariance(linear, fit.noise)
    covariance = (inverse @ residual_covariance @ np.swapaxes(inverse, 1, 2))[order]
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
    candidate, index = np.unravel_index(gains[:, first].argmax(), (len(tried), len(first)))
    begin = int(first[index])
    after = agreeing[candidate] & (stops >= stops[begin])
    gain = int(gains[candidate, begin])
    if (
        gain < FEWEST_VIEWS
        or len(np.unique(stops[after])) < FEWEST_VIEWS
        or len(np.unique(stops[explained & (stops < stops[begin])])) < FEWEST_VIEWS
        or after.sum() <= _LEAST_SHARE * (len(stops) - begin)
    ):
        return []
    # The mean over all observations that agree with this step.
    weights = np.linalg.inv(covariance[after])
    weighted_sum = np.einsum("nij,nj->i", weights, differences[candidate, after])
    mean = np.linalg.solve(weights.sum(axis=0), weighted_sum)
    return [(gain, int(stops[begin]), changes[tried[candidate]] @ exp(mean))]
