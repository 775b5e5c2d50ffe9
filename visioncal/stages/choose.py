"""Chooses among the poses that each view allows, by the robot's motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.errors import DegenerateError
from visioncal.stages.pairwise import Candidates, parted, trimmed
from visioncal.stages.pnp import ViewPoses
from visioncal.targets import rotations
from visioncal.types import FloatArray, IntArray, Mask, Rejection, Target

# A rival that closes the chain within this many times the chosen one's distance is as likely.
CLEAR_RATIO = 3.0
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Choice:
    """The views with one pose each, and those that stay ambiguous."""

    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]


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
    candidates, turns = Candidates.of(views), len(set(views[0].turns))
    picks = _as_the_first(_settled(robot, candidates), turns)
    away = parted(robot, candidates, np.arange(len(views)), picks).away
    unclear = has_rival(away, float(np.median(away.min(axis=1))))
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


def has_rival(away: FloatArray, typical: float) -> Mask:
    """(m,) for which views another pose is as likely as the nearest.

    A view that is far from all others with any of its poses is wrong, which is for others to say.

    Args:
        away: (m, k) distances of their poses from the prediction [m].
        typical: Distance of a sound view's pose [m].
    """
    ordered = np.sort(away, axis=1)
    best, second = ordered[:, 0], ordered[:, 1:].min(axis=1, initial=np.inf)
    near = best < CLEAR_RATIO**2 * typical
    return np.asarray(near & (second < CLEAR_RATIO * np.maximum(best, typical)))


def choose_by(view: ViewPoses, predicted: FloatArray, target: Target | None) -> ViewPoses:
    """Chooses the pose of one view that is nearest to a predicted one.

    Args:
        view: The view with its candidates.
        predicted: (4, 4) `cam_from_target`.
        target: What was seen, for its symmetries.
    """
    return chosen(view, int(Candidates.of([view]).distances(predicted[None]).argmin()), target)


def _settled(robot: FloatArray, candidates: Candidates) -> IntArray:
    """Solves from the better half of the views, then from all, until no view picks anew."""
    picks, rows = trimmed(robot, candidates)[1].picks, np.arange(len(robot))
    for _ in range(_ROUNDS):
        before, picks = picks, parted(robot, candidates, rows, picks).picks
        if np.array_equal(before, picks):
            break
    return picks


def _as_the_first(picks: IntArray, turns: int) -> IntArray:
    """Turns all picks alike, so that the first view keeps the numbering that it was found with.

    A target's turns are powers of the first, and candidates come in blocks of all turns.
    """
    planar, turn = np.divmod(picks, turns)
    return np.asarray(planar * turns + (turn - turn[0]) % turns)


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
