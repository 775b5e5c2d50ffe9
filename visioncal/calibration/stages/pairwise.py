"""Consensus transforms of one pair of frames: one, or two with a robot between."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.transforms import invert, mean_transform, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Mount
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.chain import chain
from visioncal.estimation.closed_form import SOLVERS, Solver, lone_axis
from visioncal.estimation.linalg import covariance_from, spectrum
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robust import nearest, trimmed_start, trimmed_sum

# Triples of views to start from: with half of the views unusable, all 40 contain a bad one with
# probability (1 - 1/8)^40 = 0.5 %.
_TRIPLES = 40
FEWEST = 3
# Below this scaled eigenvalue ratio the motion leaves a direction undetermined; an edge with a
# larger sigma [m, with rotations on a lever] is no start.
_NULL_RATIO, _WORST_M = 1e-8, 0.1
# Largest mean distance of views that agree, rotations on a lever [m].
AGREE_M = 0.02
# Robot noise by which pairs are compared [rad, m], and the camera's, negligible beside it.
_NOISE = Noise(np.full((1, 2), 5e-4), np.zeros(0))
_CAMERA_SIGMA = 1e-6


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate poses of m views, padded to k."""

    poses: FloatArray  # (m, k, 4, 4) `cam_from_target`.
    turns: IntArray  # (m, k) which of the target's symmetries each has applied.
    valid: Mask  # (m, k) which are not padding.

    def __len__(self) -> int:
        return len(self.poses)

    @staticmethod
    def of(views: Sequence[ViewPoses]) -> "Candidates":
        """Collects the candidates of views."""
        most = max(len(view.cam_from_target) for view in views)
        counts = [len(view.cam_from_target) for view in views]
        indices = [np.minimum(np.arange(most), count - 1) for count in counts]
        padded = list(zip(views, indices, strict=True))
        poses = np.array([view.cam_from_target[rows] for view, rows in padded])
        turns = np.array([np.array(view.turns)[rows] for view, rows in padded])
        return Candidates(poses, turns, np.array([np.arange(most) < count for count in counts]))

    def take(self, rows: IntArray) -> "Candidates":
        """Returns the candidates of some views."""
        return Candidates(self.poses[rows], self.turns[rows], self.valid[rows])

    def carried(self, before: FloatArray, after: FloatArray) -> "Candidates":
        """Returns them multiplied by (m or 1, 4, 4) transforms on both sides."""
        return replace(self, poses=before[:, None] @ self.poses @ after[:, None])

    def distances(self, predicted: FloatArray) -> FloatArray:
        """Distances (..., m, k) [m] from (..., m or 1, 4, 4) predictions, rotations on a lever."""
        between = invert(predicted)[..., None, :, :] @ self.poses
        distances = np.linalg.norm(between[..., :3, 3], axis=-1) + LEVER_M * rotation_angle(between)
        return np.asarray(np.where(self.valid, distances, np.inf))


@dataclass(frozen=True, eq=False)
class HandEyeEdges:
    """Both edges of `robot * x * camera = z`, and the residuals (m, k) of the candidates [m]."""

    x: FloatArray
    z: FloatArray
    residuals: FloatArray

    @property
    def picks(self) -> IntArray:
        """(m,) the nearest candidate of each view."""
        return np.asarray(self.residuals.argmin(axis=1))


def solve_edges(
    robot: FloatArray,
    candidates: Candidates,
    rows: IntArray,
    picks: IntArray,
    solver: Solver = SOLVERS["park"],
) -> HandEyeEdges:
    """Solves for both edges by one candidate (`picks`) each of some views (`rows`).

    `robot` is (m, 4, 4), the robot's part of the chain.
    """
    edges = solver(robot[rows], candidates.poses[rows, picks])
    return HandEyeEdges(edges.x, edges.z, candidates.distances(invert(robot @ edges.x) @ edges.z))


def _solve_edges_of_sets(
    robot: FloatArray, candidates: Candidates, rows: IntArray, picks: IntArray
) -> list[HandEyeEdges]:
    """The result of `solve_edges` for each of s sets of (s, t) views and picks, in one batch."""
    edges = SOLVERS["park"](robot[rows], candidates.poses[rows, picks])
    residuals = candidates.distances(invert(robot @ edges.x[:, None]) @ edges.z[:, None])
    return [HandEyeEdges(*item) for item in zip(edges.x, edges.z, residuals, strict=True)]


def trimmed_edges(
    robot: FloatArray, candidates: Candidates, solver: Solver = SOLVERS["park"]
) -> tuple[Mask, HandEyeEdges]:
    """Solves for both edges by the better half of the views, with any of their candidates.

    `robot` is (m, 4, 4), the robot's part of the chain.

    Returns:
        (m,) mask of that half, and the edges.
    """

    def solve(mask: Mask, edges: HandEyeEdges) -> HandEyeEdges:
        rows = np.flatnonzero(mask)
        return solve_edges(robot, candidates, rows, edges.picks[rows], solver)

    every, *sets = _starts(candidates)
    starts = [solve_edges(robot, candidates, *every, solver)]
    if sets and solver is SOLVERS["park"]:
        starts += _solve_edges_of_sets(robot, candidates, *map(np.array, zip(*sets, strict=True)))
    else:
        starts += [solve_edges(robot, candidates, *item, solver) for item in sets]
    return trimmed_start(
        starts,
        lambda item: np.asarray(item.residuals.min(axis=1)),
        solve,
        max(len(robot) // 2 + 1, FEWEST),
    )


def common_transform(candidates: Candidates, turn: int = 0) -> tuple[FloatArray, float, float]:
    """Finds the transform that most views agree on.

    With `turn`, the target is turned by it relative to the view that agrees best.

    Returns:
        (4, 4), the mean distance of these views from it, and its sigma [m].
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
    return mean_transform(picked), least_sum / half, least_sum / half / np.sqrt(half)


def hand_eye(
    robot: FloatArray, candidates: Candidates, mount: Mount
) -> tuple[tuple[FloatArray, FloatArray], tuple[float, float]] | None:
    """Solves for both edges of `robot * x * camera = z` by a consensus of m views.

    `robot` is (m, 4, 4), the robot's part of the chain; its noise is modelled for the mount.

    Returns:
        (4, 4) x and z, and the sigma of each, rotations on a lever [m]; None where the motion
        leaves a direction undetermined, or no half of the views agrees.
    """
    half, edges = trimmed_edges(robot, candidates)
    typical = float(edges.residuals.min(axis=1)[half].mean())
    if typical > AGREE_M:
        return None
    picked = candidates.poses[half, edges.picks[half]]
    exact = np.tile(_CAMERA_SIGMA**2 * np.eye(6), (len(picked), 1, 1))
    poses = robot[half] if mount == "eye-in-hand" else invert(robot[half])
    problem = chain(mount, poses, picked, exact)
    state = State(np.stack([edges.x, edges.z]), np.zeros(0))
    information = fisher_information(problem, state, _NOISE)
    if spectrum(information).ratio < _NULL_RATIO:
        return None
    variances = np.diag(covariance_from(information)).reshape(4, 3).sum(axis=1)
    x, z = np.sqrt(variances[1::2]) + LEVER_M * np.sqrt(variances[::2])
    # Views that agree poorly determine less than their motion would.
    excess = max(typical / _NOISE.robots[0, 1], 1.0)
    sigmas = excess * float(x), excess * float(z)
    return None if max(x, z) > _WORST_M else ((edges.x, edges.z), sigmas)


def partial_hand_eye(
    robot: FloatArray, candidates: Candidates
) -> tuple[FloatArray, FloatArray, float]:
    """Solves for both edges of `robot * x * camera = z` as far as the motion determines them.

    Returns:
        (4, 4) x and z, and the mean distance of the better half of the views [m].
    """
    solutions = []
    for solver in (SOLVERS["park"], lone_axis):
        half, edges = trimmed_edges(robot, candidates, solver)
        solutions.append((float(edges.residuals.min(axis=1)[half].mean()), edges))
    typical, edges = min(solutions, key=lambda pair: pair[0])
    return edges.x, edges.z, typical


def _starts(candidates: Candidates) -> Iterator[tuple[IntArray, IntArray]]:
    """Views and picks to solve from: all views' best by image, then triples of views."""
    yield np.arange(len(candidates)), np.zeros(len(candidates), dtype=np.int64)
    rng = np.random.default_rng(0)
    # Views with few candidates first: they need the fewest combinations.
    counts = candidates.valid.sum(axis=1)
    weights = 1.0 / counts**2
    for _ in range(_TRIPLES):
        triple = rng.choice(len(candidates), FEWEST, replace=False, p=weights / weights.sum())
        options = [list(range(counts[at])) for at in triple]
        # A turn of the target in all views alike changes its frame and is no other solution.
        options[0] = [at for at in options[0] if candidates.turns[triple[0], at] == 0]
        for picks in product(*options):
            yield triple, np.array(picks)
