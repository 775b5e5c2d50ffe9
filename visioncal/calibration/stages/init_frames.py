"""Where all frames are to begin with, and by which of its poses each view goes.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.init_network import Tied, init_network
from visioncal.calibration.stages.pair_observations import Sighted
from visioncal.calibration.stages.pairwise import FEWEST, Candidates
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.pose_ambiguity import chosen, has_rival, settled
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask, Rejection, Target
from visioncal.estimation.problem import Problem
from visioncal.vision.targets import rotation_transforms


@dataclass(frozen=True, eq=False)
class InitialFrames:
    """A start.

    Attributes:
        tied: Where the frames are.
        views: The views that are clear, with one pose each; where a turned pose was chosen, the
            corners are renumbered to match.
        rejections: The others.
    """

    tied: Tied
    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]


def init_frames(
    problem: Problem, views: Sequence[ViewPoses], targets: Mapping[str, Target]
) -> InitialFrames:
    """Finds where the frames are, and which pose of each view goes with that.

    Args:
        problem: What the views measured, one observation a view, each by any of its poses.
        views: The views with their candidates.
        targets: The printed targets by their frames.

    Raises:
        DegenerateError: The motion leaves most views ambiguous.
    """
    seen, candidates = problem.observations, Candidates.of(views)
    turned = {
        frame: turns
        for frame, target in targets.items()
        if len(turns := rotation_transforms(target)) > 1
    }
    sighted = Sighted(
        seen.observers,
        seen.observed,
        seen.stops,
        candidates,
        turned,
        ~seen.has_rotation,
    )
    tied = init_network(problem.tree, problem.poses, sighted, problem.priors)
    away = _distances(problem, candidates, tied)
    unclear = _unclear(problem, candidates, tied, away)
    tied, picks = _numbered_as_first(problem, tied, away.argmin(axis=1), turned)
    if unclear.sum() > len(views) / 2:
        raise DegenerateError(
            f"pnp: {unclear.sum()} of {len(views)} views allow two poses of the target that the "
            "robot's motion cannot distinguish.",
            culprits=[
                f"view {view.view}" for view, value in zip(views, unclear, strict=True) if value
            ],
            next_step="Add views tilted about different axes, or use a board without symmetry "
            "(ChArUco, or an odd sum of columns and rows).",
        )
    rows = list(zip(views, picks.tolist(), unclear.tolist(), seen.observed, strict=True))
    return InitialFrames(
        tied,
        tuple(
            chosen(view, pick, targets.get(frame)) for view, pick, value, frame in rows if not value
        ),
        tuple(
            Rejection(view.view, "ambiguous: two poses of the target fit image and motion alike")
            for view, _, value, _ in rows
            if value
        ),
    )


def _distances(problem: Problem, candidates: Candidates, tied: Tied) -> FloatArray:
    """(n, k) how far the views' candidates are from what the start predicts [m]."""
    # Of views of frames that are not tied, they say nothing.
    frames = {name: tied.edges.get(name, np.eye(4)) for name in problem.unknown}
    away = candidates.distances(problem.predicted(problem.start(frames)))
    for group in problem.groups:
        rows, robots = group.rows, [step for step in group.path if step.robot]
        if not candidates.valid[rows, 1:].any():
            continue
        if len(robots) == 1 and max(FEWEST, len(away) / 2) <= len(rows):
            # What most views say by themselves is nearer than what the earliest say.
            robot = problem.poses[robots[0].robot][problem.observations.stops[rows]]
            robot = robot if robots[0].is_up else invert(robot)
            away[rows] = settled(robot, candidates.take(rows), away[rows].argmin(axis=1))
    return away


def _unclear(problem: Problem, candidates: Candidates, tied: Tied, away: FloatArray) -> Mask:
    """(n,) for which views another pose is as likely as the nearest."""
    seen, unclear = problem.observations, np.zeros(len(away), dtype=bool)
    least = away.min(axis=1)
    for group in problem.groups:
        if not any(step.frame in tied.untied for step in group.path):
            typical = max(float(np.median(least[group.rows])), float(np.median(least)))
            unclear[group.rows] = has_rival(away[group.rows], typical)
    poses = (candidates.valid & (candidates.turns == 0)).sum(axis=1)
    for frame in tied.edges.keys() - _measured(problem):
        rows = seen.involves(frame)
        # Nothing else speaks for one of the poses of the only view.
        unclear |= rows & (rows.sum() == 1) & (poses > 1)
    return unclear


def _numbered_as_first(
    problem: Problem, tied: Tied, picks: IntArray, turned: Mapping[str, FloatArray]
) -> tuple[Tied, IntArray]:
    """Turns boards that look the same turned so that their first views keep their numbering."""
    # Those stay that were measured to be somewhere.
    edges, picks = dict(tied.edges), picks.copy()
    for frame in edges.keys() & turned.keys() - _measured(problem):
        rows, turns = problem.observations.involves(frame), turned[frame]
        # A target's turns are powers of the first, and candidates come in blocks of all turns.
        planar, turn = np.divmod(picks[rows], len(turns))
        picks[rows] = planar * len(turns) + (turn - turn[0]) % len(turns)
        edges[frame] = edges[frame] @ invert(turns[turn[0]])
    return replace(tied, edges=edges), picks


def _measured(problem: Problem) -> set[str]:
    return {name for prior in problem.priors for name in (prior.first, prior.second)}
