"""Initial poses of all frames, and the choice among each view's candidate poses.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DegenerateError
from visioncal.core.limits import CLEAR_RATIO, FEWEST_VIEWS
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask, Rejection, Target
from visioncal.estimation.outliers import EARLY_SHARE
from visioncal.estimation.problem import Problem
from visioncal.fit.consensus import Candidates, settled_distances
from visioncal.fit.joining import Connected, Network, Relation
from visioncal.vision.targets import rotation_transforms


@dataclass(frozen=True, eq=False)
class InitialFrames:
    """Initial poses of the frames, and one pose of each view."""

    # (4, 4) `parent_from_frame` of the unknown frames that are connected.
    edges: Mapping[str, FloatArray]
    untied: tuple[str, ...]  # The unknown frames that are not.
    # Frames that are connected only through boards that look the same turned, so that other poses
    # fit as well.
    ambiguous: tuple[str, ...]
    # The unambiguous views, with one pose each; where a turned pose was chosen, the corners are
    # renumbered to match.
    views: tuple[ViewPoses, ...] = ()
    rejections: tuple[Rejection, ...] = ()  # The ambiguous views.


def network_of(
    problem: Problem, candidates: Candidates, symmetries: Mapping[str, FloatArray]
) -> Network:
    """The observations as a network, of which the earliest come first: frames may move later.

    Args:
        problem: The observations.
        candidates: Their poses.
        symmetries: (t, 4, 4) turns after which a target looks the same, the identity first, by the
            frame of a target that has them.
    """
    seen, priors = problem.observations, problem.priors
    stated = [(one, one.matrix) for one in priors if one.matrix is not None]
    return Network(
        problem.tree,
        problem.poses,
        seen.observers,
        seen.observed,
        seen.stops,
        seen.has_rotation,
        candidates,
        symmetries,
        tuple(Relation(one.first, one.second, at[None], one.sigma_m) for one, at in stated),
        frozenset(_with_priors(problem)),
        EARLY_SHARE,
    )


def init_frames(
    problem: Problem, views: Sequence[ViewPoses], targets: Mapping[str, Target]
) -> InitialFrames:
    """Finds initial poses of the frames, and the pose of each view that fits them.

    Args:
        problem: The observations, one a view, each by any of its poses.
        views: The views with their candidates.
        targets: The printed targets by their frames.

    Raises:
        DegenerateError: The motion leaves most views ambiguous.
    """
    candidates = Candidates.of(
        [view.cam_from_target for view in views], [view.turns for view in views]
    )
    turns_of = {frame: rotation_transforms(target) for frame, target in targets.items()}
    symmetries = {frame: turns for frame, turns in turns_of.items() if len(turns) > 1}
    tied = network_of(problem, candidates, symmetries).connected()
    distances = _distances(problem, candidates, tied)
    ambiguous = _is_ambiguous(problem, candidates, tied, distances)
    edges, picks = _numbered_as_first(problem, tied, distances.argmin(axis=1), symmetries)
    clear, unclear = np.flatnonzero(~ambiguous).tolist(), np.flatnonzero(ambiguous).tolist()
    if len(unclear) > len(views) / 2:
        raise DegenerateError(
            f"pnp: {len(unclear)} of {len(views)} views allow two poses of the target that the "
            "robot's motion cannot distinguish.",
            culprits=[f"view {views[at].view}" for at in unclear],
            next_step="Add views tilted about different axes, or use a board without symmetry "
            "(ChArUco, or an odd sum of columns and rows).",
        )
    why = "ambiguous: two poses of the target fit image and motion alike"
    seen = problem.observations.observed
    chosen = (views[at].chosen(int(picks[at]), targets.get(seen[at])) for at in clear)
    rejections = tuple(Rejection(views[at].view, why) for at in unclear)
    return InitialFrames(edges, tied.untied, tied.ambiguous, tuple(chosen), rejections)


def _distances(problem: Problem, candidates: Candidates, tied: Connected) -> FloatArray:
    """(n, k) distances of the views' candidates from their predictions [m]."""
    # The distances of views of unconnected frames have no meaning.
    frames = {name: tied.edges.get(name, np.eye(4)) for name in problem.unknown}
    distances = candidates.distances(problem.predicted(problem.start(frames)))
    for group in problem.groups:
        rows, robots = group.rows, [step for step in group.path if step.robot]
        is_enough = max(FEWEST_VIEWS, len(distances) / 2) <= len(rows)
        if is_enough and len(robots) == 1 and candidates.valid[rows, 1:].any():
            # A fit to most views is more precise than one to the earliest.
            picks = distances[rows].argmin(axis=1)
            robot = problem.poses[robots[0].robot][problem.observations.stops[rows]]
            part = robot if robots[0].is_up else invert(robot)
            distances[rows] = settled_distances(part, candidates.take(rows), picks)
    return distances


def _is_ambiguous(
    problem: Problem, candidates: Candidates, tied: Connected, distances: FloatArray
) -> Mask:
    """(n,) whether another candidate is as likely as the nearest."""
    ordered, ambiguous = np.sort(distances, axis=1), np.zeros(len(distances), dtype=bool)
    best, second = ordered[:, 0], ordered[:, 1:].min(axis=1, initial=np.inf)
    for group in problem.groups:
        if not any(step.frame in tied.untied for step in group.path):
            typical_m = max(float(np.median(best[group.rows])), float(np.median(best)))
            # Views that are far with any candidate are outliers.
            is_near = best < CLEAR_RATIO**2 * typical_m
            has_rival = second < CLEAR_RATIO * np.maximum(best, typical_m)
            ambiguous[group.rows] = (is_near & has_rival)[group.rows]
    poses = (candidates.valid & (candidates.turns == 0)).sum(axis=1)
    for frame in tied.edges.keys() - _with_priors(problem):
        rows = problem.observations.involves(frame)
        # Nothing else decides between the poses of a frame's only view.
        ambiguous |= rows & (rows.sum() == 1) & (poses > 1)
    return ambiguous


def _numbered_as_first(
    problem: Problem, tied: Connected, picks: IntArray, symmetries: Mapping[str, FloatArray]
) -> tuple[Mapping[str, FloatArray], IntArray]:
    """Turns symmetric boards so that first views keep their corner numbers."""
    # Frames with priors are left as they are.
    edges, picks = dict(tied.edges), picks.copy()
    for frame in edges.keys() & symmetries.keys() - _with_priors(problem):
        rows, turns = problem.observations.involves(frame), symmetries[frame]
        # A target's turns are powers of the first, and candidates come in blocks of all turns.
        planar, turned = np.divmod(picks[rows], len(turns))
        picks[rows] = planar * len(turns) + (turned - turned[0]) % len(turns)
        edges[frame] = edges[frame] @ invert(turns[turned[0]])
    return edges, picks


def _with_priors(problem: Problem) -> set[str]:
    return {name for prior in problem.priors for name in (prior.first, prior.second)}
