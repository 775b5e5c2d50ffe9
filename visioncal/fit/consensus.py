"""Consensus transforms of one pair of frames: one, two with a robot between, or three."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.limits import FEWEST_COMPARED, FEWEST_VIEWS
from visioncal.core.linalg import NULL_SHARE, covariance_from, eigenvalue_shares
from visioncal.core.robust import REFINED, nearest, trimmed_start, trimmed_sum
from visioncal.core.transforms import LEVER_M, adjoint, compose, distances_m, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.closed_form import SOLVERS, Solver, lone_axis

# An edge with a larger sigma [m, with rotations on a lever] is no start.
WORST_M = 0.1
# Largest mean distance of views that agree, rotations on a lever [m].
AGREE_M = 0.02
# Robot noise by which pairs are compared [rad], [m]; the camera's is negligible beside it.
_ROBOT_SIGMA = 5e-4


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate poses of m views, padded to k."""

    poses: FloatArray  # (m, k, 4, 4) `cam_from_target`.
    turns: IntArray  # (m, k) which of the target's symmetries each has applied.
    valid: Mask  # (m, k) which are not padding.

    def __len__(self) -> int:
        return len(self.poses)

    @classmethod
    def of(cls, poses: Sequence[FloatArray], turns: Sequence[Sequence[int] | IntArray]) -> Self:
        """Collects the (c, 4, 4) candidates of each view, and their (c,) turns."""
        counts = np.array([len(view_poses) for view_poses in poses], dtype=np.int64)
        numbers = np.arange(counts.max(initial=1))
        valid = numbers < counts[:, None]
        at = np.minimum(numbers, counts[:, None] - 1)
        padded = [view_poses[rows] for view_poses, rows in zip(poses, at, strict=True)]
        turned = [np.asarray(view_turns)[rows] for view_turns, rows in zip(turns, at, strict=True)]
        return cls(np.array(padded), np.array(turned), valid)

    def take(self, rows: IntArray) -> Self:
        """Returns the candidates of some views."""
        return type(self)(self.poses[rows], self.turns[rows], self.valid[rows])

    def carried(self, before: FloatArray, after: FloatArray) -> Self:
        """Multiplies the candidates by (m or 1, 4, 4) transforms on both sides."""
        return replace(self, poses=before[:, None] @ self.poses @ after[:, None])

    def distances(self, predicted: FloatArray) -> FloatArray:
        """Distances (..., m, k) [m] from (..., m or 1, 4, 4) predictions, rotations on a lever."""
        return np.where(self.valid, distances_m(self.poses, predicted[..., None, :, :]), np.inf)


@dataclass(frozen=True, eq=False)
class PairEdges:
    """Both edges of `robot * x * camera = z`, and the residuals (m, k) of the candidates [m]."""

    x: FloatArray
    z: FloatArray
    residuals: FloatArray
    # Of each edge, rotations on a lever [m]; infinite where undetermined.
    sigmas_m: tuple[float, float] = (np.inf, np.inf)

    @property
    def picks(self) -> IntArray:
        """(m,) the nearest candidate of each view."""
        return np.asarray(self.residuals.argmin(axis=1))


def _solve_edges(
    robot: FloatArray, candidates: Candidates, rows: IntArray, picks: IntArray, solver: Solver
) -> PairEdges:
    """Solves for both edges by (..., t) views with one candidate each, for (...,) sets at once."""
    edges = solver(robot[rows], candidates.poses[rows, picks])
    predicted = invert(robot @ edges.x[..., None, :, :]) @ edges.z[..., None, :, :]
    return PairEdges(edges.x, edges.z, candidates.distances(predicted))


def _trimmed_edges(
    robot: FloatArray, candidates: Candidates, solver: Solver
) -> tuple[Mask, PairEdges, float]:
    """Solves for both edges by the better half of the views, with any of their candidates.

    Returns:
        (m,) mask of that half, the edges, and the half's mean distance [m].
    """

    def solve(mask: Mask, edges: PairEdges) -> PairEdges:
        rows = np.flatnonzero(mask)
        return _solve_edges(robot, candidates, rows, edges.picks[rows], solver)

    count, every = max(len(robot) // 2 + 1, FEWEST_VIEWS), np.arange(len(robot))
    # All views' best by image, and the best of the triples.
    starts = [_solve_edges(robot, candidates, every, np.zeros_like(every), solver)]
    many = _solve_edges(robot, candidates, *_triples(candidates), solver)
    sums = np.sort(many.residuals.min(axis=2), axis=1)[:, :count].sum(axis=1)
    best = np.argsort(sums, kind="stable")[:REFINED]
    starts += map(PairEdges, many.x[best], many.z[best], many.residuals[best])
    half, edges = trimmed_start(
        starts, lambda item: np.asarray(item.residuals.min(axis=1)), solve, count
    )
    return half, edges, float(edges.residuals.min(axis=1)[half].mean())


def common_transform(candidates: Candidates, turn: int = 0) -> tuple[FloatArray, float]:
    """Finds the transform that most views agree on.

    With `turn`, the target is turned by it relative to the view that agrees best.

    Returns:
        (4, 4), and its sigma [m].
    """
    half, least_sum, best = len(candidates) // 2 + 1, np.inf, (0, 0)
    for view, pose in np.argwhere(candidates.valid & (candidates.turns == 0)).tolist():
        distances = candidates.distances(candidates.poses[view, pose][None]).min(axis=1)
        if (sum_m := trimmed_sum(distances, half)) < least_sum:
            least_sum, best = sum_m, (view, pose)
    # Candidates come in blocks of all turns.
    distances = candidates.distances(candidates.poses[best[0], best[1] + turn][None])
    rows = np.flatnonzero(nearest(distances.min(axis=1), half))
    picked = candidates.poses[rows, distances[rows].argmin(axis=1)]
    return mean_transform(picked), least_sum / half**1.5


def hand_eye(robot: FloatArray, candidates: Candidates) -> PairEdges | None:
    """Solves for both edges of `robot * x * camera = z` by a consensus of m views.

    `robot` is (m, 4, 4), the robot's part of the chain. None where the motion leaves a direction
    undetermined, or no half of the views agrees. A robot that was parked while others moved repeats
    one pose, and half of the views may have it: then each pose counts once.
    """
    if (edges := _half_edges(robot, candidates)) is not None:
        return edges
    rows = _distinct(robot)
    if not FEWEST_VIEWS <= len(rows) < len(robot):
        return None
    edges = _half_edges(robot[rows], candidates.take(rows))
    if edges is None:
        return None
    return replace(edges, residuals=candidates.distances(invert(robot @ edges.x) @ edges.z))


def _distinct(robot: FloatArray) -> IntArray:
    """(d,) the first row of each of (m, 4, 4) poses that differ by more than views may."""
    rows = list[int]()
    for at, pose in enumerate(robot):
        if not rows or distances_m(robot[rows], pose).min() > AGREE_M:
            rows.append(at)
    return np.array(rows, dtype=np.int64)


def _half_edges(robot: FloatArray, candidates: Candidates) -> PairEdges | None:
    """Both edges by the half of the views that agrees best; None where it determines them not."""
    half, edges, typical_m = _trimmed_edges(robot, candidates, SOLVERS["park"])
    if typical_m > AGREE_M:
        return None
    # Right perturbations of both, as twists of the frame in which the robot errs.
    by_z = adjoint(invert(robot[half]) @ edges.z)
    rows = np.concatenate([np.broadcast_to(-adjoint(edges.x), by_z.shape), by_z], axis=2)
    information = np.einsum("mij,mik->jk", rows, rows) / _ROBOT_SIGMA**2
    if eigenvalue_shares(information)[0] < NULL_SHARE:
        return None
    variances = np.diag(covariance_from(information)).reshape(4, 3).sum(axis=1)
    # Views that agree poorly determine less than their motion would.
    excess = max(typical_m / _ROBOT_SIGMA, 1.0)
    x, z = (np.sqrt(variances[1::2]) + LEVER_M * np.sqrt(variances[::2])).tolist()
    return None if max(x, z) > WORST_M else replace(edges, sigmas_m=(excess * x, excess * z))


def partial_hand_eye(robot: FloatArray, candidates: Candidates) -> tuple[PairEdges, float]:
    """Solves for both edges as far as the motion determines them.

    Returns:
        The edges, and the mean distance of the better half of the views [m].
    """
    found = [_trimmed_edges(robot, candidates, item) for item in (SOLVERS["park"], lone_axis)]
    return min((item[1:] for item in found), key=lambda item: item[1])


def between_arms(
    first: FloatArray, second: FloatArray, candidates: Candidates
) -> tuple[FloatArray, float] | None:
    """Finds v of `u * first * v * second * w = camera`, of two arms, and the views' median [m].

    With one of the three known, the others are a hand-eye calibration: these are solved in turn (as
    Wu, Wang, Qi and Ren 2016 iterate), from starts with v in 24 orientations. `first` and `second`
    are (m, 4, 4). None where no start converges, or with too few views.
    """
    if len(first) < FEWEST_COMPARED or candidates.turns.any():
        return None
    middle = compose(Rotation.create_group("O").as_matrix(), np.zeros(3))[:, None]
    seen, park = candidates.poses[None, :, 0].repeat(len(middle), axis=0), SOLVERS["park"]
    before, after = (invert(arm)[None].repeat(len(middle), axis=0) for arm in (first, second))
    for _ in range(40):
        # u and w for given v; then v and w for given u; then u and v for given w.
        u_inverse = park(after @ invert(middle) @ before, seen).x[:, None]
        w = park(after, before @ u_inverse @ seen).z[:, None]
        edges = park(before, seen @ invert(w) @ after)
        u_inverse, middle = edges.x[:, None], edges.z[:, None]
    predicted = invert(u_inverse) @ first @ middle @ second @ w
    medians = np.median(distances_m(seen, predicted), axis=1)
    best = medians.argmin()
    return (middle[best, 0], float(medians[best])) if medians[best] < AGREE_M else None


@lru_cache(maxsize=64)
def _drawn(counts: tuple[int, ...]) -> tuple[IntArray, ...]:
    """Triples of views with so many candidates: often those with few, of fewer combinations."""
    rng, weights = np.random.default_rng(0), 1.0 / np.array(counts) ** 2
    shares = weights / weights.sum()
    # Triples of views to start from: with half of the views unusable, all 40 contain a bad one with
    # probability (1 - 1/8)^40 = 0.5 %.
    return tuple(rng.choice(len(counts), FEWEST_VIEWS, replace=False, p=shares) for _ in range(40))


def _triples(candidates: Candidates) -> tuple[IntArray, IntArray]:
    """(s, 3) views and picks to solve from, with all combinations of each triple's candidates."""
    counts, rows, picks = candidates.valid.sum(axis=1).tolist(), [], []
    for triple in _drawn(tuple(counts)):
        options = [list(range(counts[at])) for at in triple]
        # A turn of the target in all views alike changes its frame and is no other solution.
        options[0] = [at for at in options[0] if candidates.turns[triple[0], at] == 0]
        more = [*product(*options)]
        picks += more
        rows += [triple] * len(more)
    return np.array(rows), np.array(picks)
