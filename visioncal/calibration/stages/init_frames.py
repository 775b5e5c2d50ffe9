"""Where all frames are to begin with, and by which of its poses each view goes.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.

Every pair of frames of which one saw the other at several stops is solved by itself, by a consensus
of its earliest views: what moves later on has not moved yet. A pair that no robot parts gives one
transform; one that a robot parts gives two, as a hand-eye calibration does. Of all that is so
found the best transforms are taken first (Prim 1957), until every frame hangs on the tree.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.init_spanning_tree import mounted_points, spanning_tree
from visioncal.calibration.stages.pair_observations import FramePair, Growth, Relation, Sighted
from visioncal.calibration.stages.pairwise import (
    FEWEST,
    Candidates,
    common_transform,
    hand_eye,
    partial_hand_eye,
)
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.pose_ambiguity import chosen, has_rival, settled
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask, Mount, Rejection, Target
from visioncal.estimation.parts import FramePrior
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Tree
from visioncal.vision.targets import rotation_transforms


@dataclass(frozen=True, eq=False)
class Tied:
    """A start.

    Attributes:
        edges: (4, 4) `parent_from_frame` of the unknown frames that are tied.
        untied: The unknown frames that are not.
        ambiguous: Frames that are tied by nothing but boards that look the same turned, so that
            they might as well be elsewhere.
    """

    edges: Mapping[str, FloatArray]
    untied: tuple[str, ...]
    ambiguous: tuple[str, ...]


def init_network(
    tree: Tree,
    poses: Mapping[str, FloatArray],
    sighted: Sighted,
    priors: Sequence[FramePrior] = (),
) -> Tied:
    """Finds where the frames are.

    Args:
        tree: The frames; its root's body has its place by known edges.
        poses: (s, 4, 4) `base_from_flange` by robot and stop.
        sighted: What was seen.
        priors: Where frames were measured to be.
    """
    measured = frozenset(name for prior in priors for name in (prior.first, prior.second))
    growth = Growth(tree, poses, sighted, _pairs(tree, sighted), (), measured)
    relations = [*_known(tree), *mounted_points(growth)]
    for prior in priors:
        if prior.matrix is not None:
            unturned = np.eye(4)[None]
            relation = Relation(prior.first, prior.second, prior.matrix, prior.sigma_m, unturned)
            relations.append(relation)
    for pair in growth.oriented:
        relations += _solved(tree, poses, sighted, pair)
    placed, ambiguous = spanning_tree(replace(growth, relations=relations))
    if not placed.keys() & {*tree.unknown}:
        # What the motion leaves open is for those to say who know how far it does.
        relations += _loose(growth)
        placed, ambiguous = spanning_tree(replace(growth, relations=relations))
    edges = {
        name: invert(placed[tree.branches[name].parent]) @ placed[name]
        for name in tree.unknown
        if name in placed and tree.branches[name].parent in placed
    }
    return Tied(edges, tuple(name for name in tree.unknown if name not in edges), ambiguous)


def _pairs(tree: Tree, sighted: Sighted) -> tuple[FramePair, ...]:
    rows: dict[tuple[str, str], list[int]] = {}
    for at in np.argsort(sighted.stops, kind="stable").tolist():
        rows.setdefault((sighted.seers[at], sighted.seen[at]), []).append(at)
    return tuple(FramePair(*pair, np.array(at), tree.path(*pair)) for pair, at in rows.items())


def _known(tree: Tree) -> Iterator[Relation]:
    for name, branch in tree.branches.items():
        if branch.known is not None:
            yield Relation(branch.parent, name, branch.known, 0.0, np.eye(4)[None])


def _solved(
    tree: Tree, poses: Mapping[str, FloatArray], sighted: Sighted, pair: FramePair
) -> Iterator[Relation]:
    """What one pair says by itself."""
    rows = sighted.early(pair.rows)
    if not pair.robots:
        matrix, _, sigma_m = common_transform(sighted.candidates.take(rows))
        yield Relation(pair.seer, pair.seen, matrix, sigma_m, sighted.turns_of(pair.seen))
    if len(pair.robots) != 1:
        return
    mount: Mount = "eye-in-hand" if pair.robots[0].is_up else "eye-to-hand"
    # Where the earliest views do not agree by half, perhaps all do.
    for mine in (rows, pair.rows) if len(rows) < len(pair.rows) else (rows,):
        if len(mine) < FEWEST:
            continue
        found = hand_eye(*_parted(poses, sighted, pair, mine), mount)
        if found is not None:
            yield from _both(tree, sighted, pair, *found)
            return


def _loose(growth: Growth) -> Iterator[Relation]:
    """What the pair with the most views says, however little that is."""
    pairs = [pair for pair in growth.oriented if len(pair.robots) == 1 and len(pair.rows) >= FEWEST]
    if pairs:
        pair = max(pairs, key=lambda value: len(value.rows))
        x, z, _ = partial_hand_eye(*_parted(growth.poses, growth.sighted, pair, pair.rows))
        yield from _both(growth.tree, growth.sighted, pair, (x, z), (np.inf, np.inf))


def _both(
    tree: Tree,
    sighted: Sighted,
    pair: FramePair,
    edges: tuple[FloatArray, FloatArray],
    sigmas_m: tuple[float, float],
) -> Iterator[Relation]:
    """The transforms on both sides of the robot that parts a pair."""
    (step,) = pair.robots
    flange, base = step.frame, tree.branches[step.frame].parent
    near, far = (flange, base) if step.is_up else (base, flange)
    yield Relation(near, pair.seer, edges[0], sigmas_m[0], np.eye(4)[None])
    yield Relation(far, pair.seen, edges[1], sigmas_m[1], sighted.turns_of(pair.seen))


def _parted(
    poses: Mapping[str, FloatArray], sighted: Sighted, pair: FramePair, rows: IntArray
) -> tuple[FloatArray, Candidates]:
    """The robot's part of the chain (m, 4, 4) in some views of a pair, and what these allow."""
    (step,) = pair.robots
    robot = poses[step.robot][sighted.stops[rows]]
    return robot if step.is_up else invert(robot), sighted.candidates.take(rows)


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
