"""Chooses among the poses that each view allows, by the robot's motion."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.pairwise import Candidates, parted
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.types import FloatArray, IntArray, Mask, Target
from visioncal.vision.targets import rotations

# A rival that closes the chain within this many times the chosen one's distance is as likely.
CLEAR_RATIO = 3.0
_ROUNDS = 10


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


def settled(robot: FloatArray, candidates: Candidates, picks: IntArray) -> FloatArray:
    """Solves for both edges from all views, until none picks another pose than before.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        candidates: What each view allows.
        picks: (m,) which of these each takes at first.

    Returns:
        (m, k) how far the candidates are from what that predicts [m].
    """
    rows = np.arange(len(robot))
    for _ in range(_ROUNDS):
        found = parted(robot, candidates, rows, picks)
        if np.array_equal(found.picks, picks):
            break
        picks = found.picks
    return found.away


def chosen(view: ViewPoses, pick: int, target: Target | None) -> ViewPoses:
    """Leaves one pose to a view, and numbers its corners accordingly."""
    corners, turn = view.corners, view.turns[pick]
    if corners is not None and target is not None and turn:
        # Turned, corner i lies where corner rotations[i] was: what was seen as that one is i.
        renumbered = np.argsort(rotations(target)[turn])[corners.ids - view.first] + view.first
        corners = replace(corners, ids=renumbered).take(np.argsort(renumbered))
    return replace(
        view,
        corners=corners,
        cam_from_target=view.cam_from_target[pick : pick + 1],
        turns=(turn,),
        covariance=view.covariance[pick : pick + 1],
        by_shared=view.by_shared[pick : pick + 1],
    )
