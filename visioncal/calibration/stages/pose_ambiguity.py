"""Choice among the candidate poses of each view, by the robot's motion."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.pairwise import Candidates, solve_edges
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.types import FloatArray, IntArray, Mask, Target
from visioncal.vision.targets import rotations

# A rival within this ratio of the chosen candidate's distance is as likely.
CLEAR_RATIO = 3.0
_ROUNDS = 10


def has_rival(distances: FloatArray, typical_m: float) -> Mask:
    """(m,) whether another candidate of a view is as likely as the nearest.

    `distances` are those of (m, k) candidates from the prediction, `typical_m` that of a good
    view's pose [m]. Views that are far with any candidate are outliers and not reported here.
    """
    ordered = np.sort(distances, axis=1)
    best, second = ordered[:, 0], ordered[:, 1:].min(axis=1, initial=np.inf)
    near = best < CLEAR_RATIO**2 * typical_m
    return np.asarray(near & (second < CLEAR_RATIO * np.maximum(best, typical_m)))


def choose_nearest(view: ViewPoses, predicted: FloatArray, target: Target | None) -> ViewPoses:
    """Chooses the candidate of one view that is nearest to a predicted `cam_from_target` (4, 4)."""
    return with_candidate(
        view, int(Candidates.of([view]).distances(predicted[None]).argmin()), target
    )


def settle_candidates(robot: FloatArray, candidates: Candidates, picks: IntArray) -> FloatArray:
    """Solves for both edges from all views and updates each view's candidate until none changes.

    `robot` is (m, 4, 4), the robot's part of the chain, `picks` (m,) the initial choice.

    Returns:
        (m, k) distances of the candidates from the predictions [m].
    """
    rows = np.arange(len(robot))
    for _ in range(_ROUNDS):
        edges = solve_edges(robot, candidates, rows, picks)
        if np.array_equal(edges.picks, picks):
            break
        picks = edges.picks
    return edges.residuals


def with_candidate(view: ViewPoses, pick: int, target: Target | None) -> ViewPoses:
    """Reduces a view to one candidate, and renumbers its corners accordingly."""
    corners, turn = view.corners, view.turns[pick]
    if corners is not None and target is not None and turn:
        # Turned, corner i is where corner rotations[i] was: what was detected as that one is i.
        renumbered = np.argsort(rotations(target)[turn])[corners.ids - view.first] + view.first
        corners = replace(corners, ids=renumbered).take(np.argsort(renumbered))
    return replace(
        view,
        corners=corners,
        cam_from_target=view.cam_from_target[pick : pick + 1],
        turns=(turn,),
        covariance=view.covariance[pick : pick + 1],
        shared_jacobian=view.shared_jacobian[pick : pick + 1],
    )
