"""Chooses among the poses that each view allows, by the robot's motion."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from visioncal.errors import DegenerateError
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closure import Edges
from visioncal.solvers import SOLVERS
from visioncal.stages.pnp import ViewPoses
from visioncal.targets import rotations
from visioncal.transforms import invert, rotation_angle
from visioncal.types import FloatArray, IntArray, Mask, Rejection, Target

# A rival that closes the chain within this many times the chosen one's distance is as likely.
CLEAR_RATIO = 3.0
# Triples of views to start from: with half of the views unusable, all 40 contain a bad one with
# probability (1 - 1/8)^40 = 0.5 %.
_TRIPLES = 40
# Of the starts, so many are followed up with all views.
_REFINED, _ROUNDS = 5, 10


@dataclass(frozen=True, eq=False)
class Choice:
    """The views with one pose each, and those that stay ambiguous."""

    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Padded (m, k, 4, 4) candidates of m views, and their (m, k) validity."""

    poses: FloatArray
    valid: Mask


def choose_poses(views: Sequence[ViewPoses], robot: FloatArray, target: Target | None) -> Choice:
    """Chooses each view's pose so that all views place the target consistently.

    The mirrored solutions of a planar target, and the turns of a board with a rotational
    symmetry, look alike in one image; the robot's motion tells them apart.

    Args:
        views: The views with their candidates.
        robot: (m, 4, 4) the robot's part of the chain, one a view.
        target: What was seen, for its symmetries.

    Returns:
        The views, each with its one pose; where a turned pose was chosen, the corners are
        renumbered to match.

    Raises:
        DegenerateError: The motion leaves most views ambiguous.
    """
    if all(len(view.cam_from_target) == 1 for view in views) or len(views) < 3:
        return Choice(tuple(chosen(view, 0, target) for view in views), ())
    candidates = padded(views)
    turns = len(set(views[0].turns))
    picks = _as_the_first(_assign(robot, candidates, views), turns)
    distance = _distances(robot, candidates, picks)
    best = distance[np.arange(len(views)), picks]
    others = distance.copy()
    others[np.arange(len(views)), picks] = np.inf
    typical = np.median(best)
    unclear = others.min(axis=1) < CLEAR_RATIO * np.maximum(best, typical)
    # A view far from all others with any of its poses is wrong, which is for the verdict to say.
    unclear &= best < CLEAR_RATIO**2 * typical
    if unclear.sum() > len(views) / 2:
        raise DegenerateError(
            f"pnp: {unclear.sum()} of {len(views)} views allow two poses of the target that the "
            "robot's motion cannot tell apart.",
            culprits=[f"view {view.view}" for view, it in zip(views, unclear, strict=True) if it],
            next_step="Add views tilted about different axes, or use a board without symmetry "
            "(ChArUco, or an odd sum of columns and rows).",
        )
    return Choice(
        tuple(
            chosen(view, int(pick), target)
            for view, pick, it in zip(views, picks, unclear, strict=True)
            if not it
        ),
        tuple(
            Rejection(view.view, "ambiguous: two poses of the target fit image and motion alike")
            for view, it in zip(views, unclear, strict=True)
            if it
        ),
    )


def choose_by(view: ViewPoses, robot: FloatArray, edges: Edges, target: Target | None) -> ViewPoses:
    """Chooses the pose of one view by edges that are known already.

    Args:
        view: The view with its candidates.
        robot: (4, 4) the robot's part of its chain.
        edges: Both edges.
        target: What was seen, for its symmetries.
    """
    pick = distances_to(robot[None], padded([view]), edges.x, edges.z)[0].argmin()
    return chosen(view, int(pick), target)


def padded(views: Sequence[ViewPoses]) -> Candidates:
    """Puts the candidates of m views into one array."""
    most = max(len(view.cam_from_target) for view in views)
    valid = np.array([np.arange(most) < len(view.cam_from_target) for view in views])
    poses = np.array(
        [
            view.cam_from_target[np.minimum(np.arange(most), len(view.cam_from_target) - 1)]
            for view in views
        ]
    )
    return Candidates(poses, valid)


def _assign(robot: FloatArray, candidates: Candidates, views: Sequence[ViewPoses]) -> IntArray:
    """Finds the assignment under which the views agree best, from the best of many starts."""
    picked = [
        distances_to(robot, candidates, *_solve(robot[rows], candidates.poses[rows, picks]))
        for rows, picks in _starts(candidates, views)
    ]
    picked.sort(key=_score)
    settled = [_settle(robot, candidates, it.argmin(axis=1)) for it in picked[:_REFINED]]
    return min(settled, key=lambda picks: _score(_distances(robot, candidates, picks)))


def _as_the_first(picks: IntArray, turns: int) -> IntArray:
    """Turns all picks alike, so that the first view keeps the numbering that it was found with.

    A target's turns are powers of the first, and candidates come in blocks of all turns.
    """
    planar, turn = np.divmod(picks, turns)
    return np.asarray(planar * turns + (turn - turn[0]) % turns)


def _score(distance: FloatArray) -> float:
    return float(np.median(distance.min(axis=1)))


def _settle(robot: FloatArray, candidates: Candidates, picks: IntArray) -> IntArray:
    """Solves from all views and picks anew, until nothing changes."""
    for _ in range(_ROUNDS):
        before, picks = picks, _distances(robot, candidates, picks).argmin(axis=1)
        if np.array_equal(before, picks):
            break
    return picks


def _starts(
    candidates: Candidates, views: Sequence[ViewPoses]
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yields rows and picks to solve from: all views' best by image, then triples of views."""
    yield np.arange(len(views)), np.zeros(len(views), dtype=np.int64)
    rng = np.random.default_rng(0)
    # Views with few candidates first: they need the fewest combinations.
    counts = candidates.valid.sum(axis=1)
    likely = 1.0 / counts**2
    for _ in range(_TRIPLES):
        triple = rng.choice(len(views), 3, replace=False, p=likely / likely.sum())
        options = [list(range(counts[at])) for at in triple]
        # A turn of the target in all views alike is a change of its frame, and no other solution.
        options[0] = [at for at in options[0] if views[triple[0]].turns[at] == 0]
        for picks in product(*options):
            yield triple, np.array(picks)


def _solve(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    solution = SOLVERS["park"](robot, camera)
    return solution.x, solution.z


def _distances(robot: FloatArray, candidates: Candidates, picks: IntArray) -> FloatArray:
    """Distances under the solution of an assignment, (m, k)."""
    x, z = _solve(robot, candidates.poses[np.arange(len(robot)), picks])
    return distances_to(robot, candidates, x, z)


def distances_to(
    robot: FloatArray, candidates: Candidates, x: FloatArray, z: FloatArray
) -> FloatArray:
    """Distance (m, k) [m] between where each candidate places the target, and z."""
    placed = robot[:, None] @ x @ candidates.poses
    away = np.linalg.norm(placed[..., :3, 3] - z[:3, 3], axis=-1)
    away = away + LEVER_M * rotation_angle(invert(z) @ placed)
    return np.asarray(np.where(candidates.valid, away, np.inf))


def chosen(view: ViewPoses, pick: int, target: Target | None) -> ViewPoses:
    """Leaves one pose to a view, and numbers its corners accordingly.

    Args:
        view: The view.
        pick: Which of its poses.
        target: What it shows.
    """
    corners, turn = view.corners, view.turns[pick]
    if corners is not None and target is not None and turn:
        # Turned, corner i lies where corner rotations[i] was: what was seen as that one is i.
        renumbered = np.argsort(rotations(target)[turn])[corners.ids - view.first] + view.first
        order = np.argsort(renumbered)
        weights = None if corners.weights is None else corners.weights[order]
        px = corners.px[order]
        corners = replace(corners, ids=renumbered[order], px=px, weights=weights)
    return replace(
        view,
        corners=corners,
        cam_from_target=view.cam_from_target[pick : pick + 1],
        turns=(turn,),
        covariance=view.covariance[pick : pick + 1],
        by_shared=view.by_shared[pick : pick + 1],
    )
