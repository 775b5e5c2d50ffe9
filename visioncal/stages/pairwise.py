"""What most views of one pair of frames agree on: one transform, or two that a robot parts."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closure import Closure, Edges, Noise, closure_information
from visioncal.estimation.linalg import covariance, spectrum
from visioncal.solvers import SOLVERS
from visioncal.stages.choose import Candidates, distances_to
from visioncal.transforms import invert, mean_transform, rotation_angle
from visioncal.types import FloatArray, IntArray, Mount

# Triples of views to start a hand-eye calibration from, and how many are followed up.
_TRIPLES, _REFINED, _ROUNDS = 30, 3, 4
FEWEST = 3
# Below this scaled eigenvalue ratio the motion leaves a direction open; an edge that is known worse
# than this [m, with rotations on a lever] is no start.
_NULL_RATIO, _WORST_M = 1e-8, 0.1
# Views that agree do so to this, on average, rotations on a lever [m].
_AGREE_M = 0.02
# Noise by which pairs are weighed against each other [rad, m].
_USUAL = Noise(5e-4, 5e-4)
# ... and so little is the camera's beside it [rad and m].
_EXACT = 1e-6


def some(candidates: Candidates, rows: IntArray) -> Candidates:
    """The candidates of some observations."""
    return Candidates(candidates.poses[rows], candidates.valid[rows])


def distances_from(predicted: FloatArray, candidates: Candidates) -> FloatArray:
    """Distances (n, c) [m] of candidates from (n, 4, 4) predictions, rotations on a lever."""
    between = invert(predicted)[:, None] @ candidates.poses
    away = np.linalg.norm(between[..., :3, 3], axis=-1) + LEVER_M * rotation_angle(between)
    return np.asarray(np.where(candidates.valid, away, np.inf))


def consensus(candidates: Candidates, turns: IntArray, turn: int = 0) -> tuple[FloatArray, float]:
    """The transform that most of m views agree on, and what it is known to [m].

    Args:
        candidates: What each view allows.
        turns: (m, c) which turn of the target each candidate has applied.
        turn: By which turn the target is taken to be other than the view has it that agrees best.
    """
    half, least, best = len(turns) // 2 + 1, np.inf, (0, 0)
    for view, pose in np.argwhere(candidates.valid & (turns == 0)).tolist():
        away = distances_from(candidates.poses[view, pose][None], candidates)
        trimmed = float(np.sort(away.min(axis=1))[:half].sum())
        if trimmed < least:
            least, best = trimmed, (view, pose)
    # Candidates come in blocks of all turns.
    away = distances_from(candidates.poses[best[0], best[1] + turn][None], candidates)
    nearest = np.argsort(away.min(axis=1))[:half]
    picked = candidates.poses[nearest, away[nearest].argmin(axis=1)]
    return mean_transform(picked), least / half / np.sqrt(half)


def hand_eye(
    robot: FloatArray, candidates: Candidates, turns: IntArray, mount: Mount
) -> tuple[tuple[FloatArray, FloatArray], tuple[float, float]] | None:
    """Both edges of `robot * x * camera = z` by a consensus of m views.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        candidates: What each view allows of the camera's.
        turns: (m, c) which turn of the target each candidate has applied.
        mount: Whose flange it is that errs.

    Returns:
        (4, 4) x and z, and what each is known to, rotations on a lever [m]; None where the motion
        leaves a direction open, or no half of the views agrees.
    """
    half = max(len(robot) // 2 + 1, FEWEST)
    found = []
    for rows, picks in _starts(candidates, turns):
        away = distances_to(robot, candidates, *_park(robot[rows], candidates.poses[rows, picks]))
        found.append((_trimmed(away, half), away))
    found.sort(key=lambda it: it[0])
    settled = [_concentrated(robot, candidates, away, half) for _, away in found[:_REFINED]]
    trimmed, chosen, picks, edges = min(settled, key=lambda it: it[0])
    if trimmed > _AGREE_M * half:
        return None
    picked = candidates.poses[chosen, picks[chosen]]
    exact = np.tile(_EXACT**2 * np.eye(6), (len(chosen), 1, 1))
    data = Closure(mount, robot[chosen], picked, exact)
    information = closure_information(data, Edges(*edges, np.zeros(0)), _USUAL)
    if spectrum(information).ratio < _NULL_RATIO:
        return None
    spread = covariance(information)
    variances = np.diag(spread).reshape(4, 3).sum(axis=1)
    x, z = np.sqrt(variances[1::2]) + LEVER_M * np.sqrt(variances[::2])
    # Views that agree badly tell less than their motion would.
    worse = max(trimmed / half / _USUAL.sigma_m, 1.0)
    return None if max(x, z) > _WORST_M else (edges, (worse * float(x), worse * float(z)))


def _trimmed(away: FloatArray, half: int) -> float:
    return float(np.sort(away.min(axis=1))[:half].sum())


def _park(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    solution = SOLVERS["park"](robot, camera)
    return solution.x, solution.z


def _starts(candidates: Candidates, turns: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Rows and picks to solve from: all views' best by image, then triples of views."""
    yield np.arange(len(turns)), np.zeros(len(turns), dtype=np.int64)
    rng = np.random.default_rng(0)
    counts = candidates.valid.sum(axis=1)
    likely = 1.0 / counts**2
    for _ in range(_TRIPLES):
        triple = rng.choice(len(turns), FEWEST, replace=False, p=likely / likely.sum())
        options = [list(range(counts[at])) for at in triple]
        # A turn of the target in all views alike is a change of its frame, and no other solution.
        options[0] = [at for at in options[0] if turns[triple[0], at] == 0]
        for picks in product(*options):
            yield triple, np.array(picks)


def _concentrated(
    robot: FloatArray, candidates: Candidates, away: FloatArray, half: int
) -> tuple[float, IntArray, IntArray, tuple[FloatArray, FloatArray]]:
    """Solves from the nearest half, again and again (Rousseeuw and Van Driessen 1999)."""
    for _ in range(_ROUNDS):
        picks = away.argmin(axis=1)
        chosen = np.sort(np.argsort(away.min(axis=1))[:half])
        edges = _park(robot[chosen], candidates.poses[chosen, picks[chosen]])
        away = distances_to(robot, candidates, *edges)
    return _trimmed(away, half), chosen, away.argmin(axis=1), edges
