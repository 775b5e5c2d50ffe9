"""What most views of one pair of frames agree on: one transform, or two that a robot parts."""

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
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.robust import nearest, trimmed_start, trimmed_sum
from visioncal.estimation.solve import fisher_information

# Triples of views to start from: with half of the views unusable, all 40 contain a bad one with
# probability (1 - 1/8)^40 = 0.5 %.
_TRIPLES = 40
FEWEST = 3
# Below this scaled eigenvalue ratio the motion leaves a direction open; an edge that is known worse
# than this [m, with rotations on a lever] is no start.
_NULL_RATIO, _WORST_M = 1e-8, 0.1
# Views that agree do so to this, on average, rotations on a lever [m].
AGREE_M = 0.02
# Noise by which pairs are weighed against each other [rad, m].
_USUAL = Noise(np.full((1, 2), 5e-4), np.zeros(0))
# ... and so little is the camera's beside it [rad and m].
_EXACT = 1e-6


@dataclass(frozen=True, eq=False)
class Candidates:
    """The poses that m views allow, padded to k.

    Attributes:
        poses: (m, k, 4, 4) `cam_from_target`.
        turns: (m, k) which turn of the target's own each has applied.
        valid: (m, k) which of them there are.
    """

    poses: FloatArray
    turns: IntArray
    valid: Mask

    def __len__(self) -> int:
        return len(self.poses)

    @staticmethod
    def of(views: Sequence[ViewPoses]) -> "Candidates":
        """Puts those of views into one array."""
        most = max(len(view.cam_from_target) for view in views)
        every = [np.minimum(np.arange(most), len(view.cam_from_target) - 1) for view in views]
        pairs = list(zip(views, every, strict=True))
        return Candidates(
            np.array([view.cam_from_target[rows] for view, rows in pairs]),
            np.array([np.array(view.turns)[rows] for view, rows in pairs]),
            np.array([np.arange(most) < len(view.cam_from_target) for view in views]),
        )

    def take(self, rows: IntArray) -> "Candidates":
        """Returns those of some views."""
        return Candidates(self.poses[rows], self.turns[rows], self.valid[rows])

    def carried(self, before: FloatArray, after: FloatArray) -> "Candidates":
        """Returns them with (m or 1, 4, 4) transforms before and behind."""
        return replace(self, poses=before[:, None] @ self.poses @ after[:, None])

    def distances(self, predicted: FloatArray) -> FloatArray:
        """Distances (..., m, k) [m] from (..., m or 1, 4, 4) predictions, rotations on a lever."""
        between = invert(predicted)[..., None, :, :] @ self.poses
        away = np.linalg.norm(between[..., :3, 3], axis=-1) + LEVER_M * rotation_angle(between)
        return np.asarray(np.where(self.valid, away, np.inf))


@dataclass(frozen=True, eq=False)
class Parted:
    """Both edges of `robot * x * camera = z`, and how far (m, k) candidates are from them [m]."""

    x: FloatArray
    z: FloatArray
    away: FloatArray

    @property
    def picks(self) -> IntArray:
        """(m,) the nearest candidate of each view."""
        return np.asarray(self.away.argmin(axis=1))


def parted(
    robot: FloatArray,
    candidates: Candidates,
    rows: IntArray,
    picks: IntArray,
    solver: Solver = SOLVERS["park"],
) -> Parted:
    """Solves for both edges by one candidate each of some views.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        candidates: What each view allows.
        rows: The views to solve from.
        picks: Their candidates.
        solver: The closed form.
    """
    found = solver(robot[rows], candidates.poses[rows, picks])
    return Parted(found.x, found.z, candidates.distances(invert(robot @ found.x) @ found.z))


def _parted_by(
    robot: FloatArray, candidates: Candidates, rows: IntArray, picks: IntArray
) -> list[Parted]:
    """What `parted` gives of (s, t) views and picks, for s sets at once."""
    found = SOLVERS["park"](robot[rows], candidates.poses[rows, picks])
    away = candidates.distances(invert(robot @ found.x[:, None]) @ found.z[:, None])
    return [Parted(*item) for item in zip(found.x, found.z, away, strict=True)]


def trimmed(
    robot: FloatArray, candidates: Candidates, solver: Solver = SOLVERS["park"]
) -> tuple[Mask, Parted]:
    """Both edges by the better half of the views, whichever candidates these take.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        candidates: What each view allows.
        solver: The closed form.

    Returns:
        (m,) mask of that half, and the edges.
    """

    def solve(mask: Mask, at: Parted) -> Parted:
        rows = np.flatnonzero(mask)
        return parted(robot, candidates, rows, at.picks[rows], solver)

    every, *sets = _starts(candidates)
    starts = [parted(robot, candidates, *every, solver)]
    if sets and solver is SOLVERS["park"]:
        starts += _parted_by(robot, candidates, *map(np.array, zip(*sets, strict=True)))
    else:
        starts += [parted(robot, candidates, *item, solver) for item in sets]
    return trimmed_start(
        starts,
        lambda item: np.asarray(item.away.min(axis=1)),
        solve,
        max(len(robot) // 2 + 1, FEWEST),
    )


def common_transform(candidates: Candidates, turn: int = 0) -> tuple[FloatArray, float, float]:
    """The transform that most views agree on.

    Args:
        candidates: What each view allows.
        turn: By which turn the target is taken to be other than the view has it that agrees best.

    Returns:
        (4, 4), how far these views are from it on average, and what it is known to [m].
    """
    half, least, best = len(candidates) // 2 + 1, np.inf, (0, 0)
    for view, pose in np.argwhere(candidates.valid & (candidates.turns == 0)).tolist():
        away = candidates.distances(candidates.poses[view, pose][None]).min(axis=1)
        if (sum_m := trimmed_sum(away, half)) < least:
            least, best = sum_m, (view, pose)
    # Candidates come in blocks of all turns.
    away = candidates.distances(candidates.poses[best[0], best[1] + turn][None])
    rows = np.flatnonzero(nearest(away.min(axis=1), half))
    picked = candidates.poses[rows, away[rows].argmin(axis=1)]
    return mean_transform(picked), least / half, least / half / np.sqrt(half)


def hand_eye(
    robot: FloatArray, candidates: Candidates, mount: Mount
) -> tuple[tuple[FloatArray, FloatArray], tuple[float, float]] | None:
    """Both edges of `robot * x * camera = z` by a consensus of m views.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        candidates: What each view allows of the camera's.
        mount: Whose flange it is that errs.

    Returns:
        (4, 4) x and z, and what each is known to, rotations on a lever [m]; None where the motion
        leaves a direction open, or no half of the views agrees.
    """
    half, found = trimmed(robot, candidates)
    typical = float(found.away.min(axis=1)[half].mean())
    if typical > AGREE_M:
        return None
    picked = candidates.poses[half, found.picks[half]]
    exact = np.tile(_EXACT**2 * np.eye(6), (len(picked), 1, 1))
    poses = robot[half] if mount == "eye-in-hand" else invert(robot[half])
    problem = chain(mount, poses, picked, exact)
    state = State(np.stack([found.x, found.z]), np.zeros(0))
    information = fisher_information(problem, state, _USUAL)
    if spectrum(information).ratio < _NULL_RATIO:
        return None
    variances = np.diag(covariance_from(information)).reshape(4, 3).sum(axis=1)
    x, z = np.sqrt(variances[1::2]) + LEVER_M * np.sqrt(variances[::2])
    # Views that agree badly determine less than their motion would.
    worse = max(typical / _USUAL.robots[0, 1], 1.0)
    known = worse * float(x), worse * float(z)
    return None if max(x, z) > _WORST_M else ((found.x, found.z), known)


def partial_hand_eye(
    robot: FloatArray, candidates: Candidates
) -> tuple[FloatArray, FloatArray, float]:
    """Both edges of `robot * x * camera = z` as far as the motion of m views determines them.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        candidates: What each view allows of the camera's.

    Returns:
        (4, 4) x and z, and how far the better half of the views is from them on average [m].
    """
    found = []
    for solver in (SOLVERS["park"], lone_axis):
        half, edges = trimmed(robot, candidates, solver)
        found.append((float(edges.away.min(axis=1)[half].mean()), edges))
    typical, edges = min(found, key=lambda pair: pair[0])
    return edges.x, edges.z, typical


def _starts(candidates: Candidates) -> Iterator[tuple[IntArray, IntArray]]:
    """Views and picks to solve from: all views' best by image, then triples of views."""
    yield np.arange(len(candidates)), np.zeros(len(candidates), dtype=np.int64)
    rng = np.random.default_rng(0)
    # Views with few candidates first: they need the fewest combinations.
    counts = candidates.valid.sum(axis=1)
    likely = 1.0 / counts**2
    for _ in range(_TRIPLES):
        triple = rng.choice(len(candidates), FEWEST, replace=False, p=likely / likely.sum())
        options = [list(range(counts[at])) for at in triple]
        # A turn of the target in all views alike is a change of its frame, and no other solution.
        options[0] = [at for at in options[0] if candidates.turns[triple[0], at] == 0]
        for picks in product(*options):
            yield triple, np.array(picks)
