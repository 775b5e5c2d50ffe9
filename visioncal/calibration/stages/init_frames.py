"""Initial poses of all frames, and the choice among each view's candidate poses.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.

Every pair of frames of which one saw the other at several stops is solved by itself, by a consensus
of its earliest views: what moves later has not moved yet. A pair with no robot between gives one
transform; with one robot between it gives two, by a hand-eye calibration. The best transforms are
taken first (Prim 1957), until every frame is connected to the tree.
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
from visioncal.calibration.stages.pose_ambiguity import has_rival, settle_candidates, with_candidate
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask, Mount, Rejection, Target
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import FramePrior
from visioncal.estimation.tree import Tree
from visioncal.vision.targets import rotation_transforms


@dataclass(frozen=True, eq=False)
class ConnectedFrames:
    """Initial poses of the frames that are connected to the tree."""

    # (4, 4) `parent_from_frame` of the unknown frames that are connected.
    edges: Mapping[str, FloatArray]
    untied: tuple[str, ...]  # The unknown frames that are not.
    # Frames that are connected only through boards that look the same turned, so that other poses
    # fit as well.
    ambiguous: tuple[str, ...]


def init_network(
    tree: Tree,
    poses: Mapping[str, FloatArray],
    sighted: Sighted,
    priors: Sequence[FramePrior] = (),
) -> ConnectedFrames:
    """Finds initial poses of the frames.

    The root's body is placed by known edges; `poses` are (s, 4, 4) `base_from_flange` by robot and
    stop.
    """
    with_priors = frozenset(name for prior in priors for name in (prior.first, prior.second))
    growth = Growth(tree, poses, sighted, _pairs(tree, sighted), (), with_priors)
    relations = [*_known_relations(tree), *mounted_points(growth)]
    for prior in priors:
        if prior.matrix is not None:
            pair = prior.first, prior.second
            relations.append(Relation(*pair, prior.matrix, prior.sigma_m, np.eye(4)[None]))
    for frame_pair in growth.oriented:
        relations += _pair_relations(growth, frame_pair)
    placed, ambiguous = spanning_tree(replace(growth, relations=relations))
    if not placed.keys() & {*tree.unknown}:
        # Whether the motion determines them is checked later.
        relations += _weak_relations(growth)
        placed, ambiguous = spanning_tree(replace(growth, relations=relations))
    edges = {
        name: invert(placed[tree.branches[name].parent]) @ placed[name]
        for name in tree.unknown
        if name in placed and tree.branches[name].parent in placed
    }
    untied = tuple(name for name in tree.unknown if name not in edges)
    return ConnectedFrames(edges, untied, ambiguous)


def _pairs(tree: Tree, sighted: Sighted) -> tuple[FramePair, ...]:
    rows: dict[tuple[str, str], list[int]] = {}
    for at in np.argsort(sighted.stops, kind="stable").tolist():
        rows.setdefault((sighted.seers[at], sighted.seen[at]), []).append(at)
    return tuple(FramePair(*pair, np.array(at), tree.path(*pair)) for pair, at in rows.items())


def _known_relations(tree: Tree) -> Iterator[Relation]:
    for name, branch in tree.branches.items():
        if branch.known is not None:
            yield Relation(branch.parent, name, branch.known, 0.0, np.eye(4)[None])


def _pair_relations(growth: Growth, pair: FramePair) -> Iterator[Relation]:
    """The relations that one pair determines by itself."""
    sighted, rows = growth.sighted, growth.sighted.early(pair.rows)
    if not pair.robots:
        matrix, _, sigma_m = common_transform(sighted.candidates.take(rows))
        yield Relation(pair.seer, pair.seen, matrix, sigma_m, sighted.turns_of(pair.seen))
    if len(pair.robots) != 1:
        return
    mount: Mount = "eye-in-hand" if pair.robots[0].is_up else "eye-to-hand"
    # Where the earliest views do not agree by half, all may.
    for subset in (rows, pair.rows) if len(rows) < len(pair.rows) else (rows,):
        if len(subset) < FEWEST:
            continue
        edges = hand_eye(*_robot_and_candidates(growth, pair, subset), mount)
        if edges is not None:
            yield from _edges_of_robot(growth, pair, *edges)
            return


def _weak_relations(growth: Growth) -> Iterator[Relation]:
    """The relations of the pair with the most views, even if partly determined."""
    pairs = [pair for pair in growth.oriented if len(pair.robots) == 1 and len(pair.rows) >= FEWEST]
    if pairs:
        pair = max(pairs, key=lambda value: len(value.rows))
        x, z, _ = partial_hand_eye(*_robot_and_candidates(growth, pair, pair.rows))
        yield from _edges_of_robot(growth, pair, (x, z), (np.inf, np.inf))


def _edges_of_robot(
    growth: Growth,
    pair: FramePair,
    edges: tuple[FloatArray, FloatArray],
    sigmas_m: tuple[float, float],
) -> Iterator[Relation]:
    """The transforms on both sides of the robot that is between a pair."""
    (step,) = pair.robots
    flange, base = step.frame, growth.tree.branches[step.frame].parent
    near, far = (flange, base) if step.is_up else (base, flange)
    yield Relation(near, pair.seer, edges[0], sigmas_m[0], np.eye(4)[None])
    turns = growth.sighted.turns_of(pair.seen)
    yield Relation(far, pair.seen, edges[1], sigmas_m[1], turns)


def _robot_and_candidates(
    growth: Growth, pair: FramePair, rows: IntArray
) -> tuple[FloatArray, Candidates]:
    """The robot's part of the chain (m, 4, 4) in some views of a pair, and their candidates."""
    (step,) = pair.robots
    robot = growth.poses[step.robot][growth.sighted.stops[rows]]
    return robot if step.is_up else invert(robot), growth.sighted.candidates.take(rows)


@dataclass(frozen=True, eq=False)
class InitialFrames:
    """Initial poses of the frames, and one pose of each view."""

    connected: ConnectedFrames  # The frames.
    # The unambiguous views, with one pose each; where a turned pose was chosen, the corners are
    # renumbered to match.
    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]  # The ambiguous views.


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
    observations, candidates = problem.observations, Candidates.of(views)
    turns_of = {frame: rotation_transforms(target) for frame, target in targets.items()}
    symmetries = {frame: turns for frame, turns in turns_of.items() if len(turns) > 1}
    sighted = Sighted(
        observations.observers,
        observations.observed,
        observations.stops,
        candidates,
        symmetries,
        ~observations.has_rotation,
    )
    tied = init_network(problem.tree, problem.poses, sighted, problem.priors)
    distances = _distances(problem, candidates, tied)
    ambiguous = _is_ambiguous(problem, candidates, tied, distances)
    tied, picks = _numbered_as_first(problem, tied, distances.argmin(axis=1), symmetries)
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
    rejections = tuple(Rejection(views[at].view, why) for at in unclear)
    targets_seen = [targets.get(frame) for frame in observations.observed]
    chosen_views = (with_candidate(views[at], int(picks[at]), targets_seen[at]) for at in clear)
    return InitialFrames(tied, tuple(chosen_views), rejections)


def _distances(problem: Problem, candidates: Candidates, tied: ConnectedFrames) -> FloatArray:
    """(n, k) distances of the views' candidates from their predictions [m]."""
    # The distances of views of unconnected frames have no meaning.
    frames = {name: tied.edges.get(name, np.eye(4)) for name in problem.unknown}
    distances = candidates.distances(problem.predicted(problem.start(frames)))
    for group in problem.groups:
        rows, robots = group.rows, [step for step in group.path if step.robot]
        if not candidates.valid[rows, 1:].any():
            continue
        if len(robots) == 1 and max(FEWEST, len(distances) / 2) <= len(rows):
            # A fit to most views is more precise than one to the earliest.
            robot = problem.poses[robots[0].robot][problem.observations.stops[rows]]
            robot = robot if robots[0].is_up else invert(robot)
            distances[rows] = settle_candidates(
                robot, candidates.take(rows), distances[rows].argmin(axis=1)
            )
    return distances


def _is_ambiguous(
    problem: Problem, candidates: Candidates, tied: ConnectedFrames, distances: FloatArray
) -> Mask:
    """(n,) whether another candidate is as likely as the nearest."""
    observations, ambiguous = problem.observations, np.zeros(len(distances), dtype=bool)
    nearest = distances.min(axis=1)
    for group in problem.groups:
        if not any(step.frame in tied.untied for step in group.path):
            typical_m = max(float(np.median(nearest[group.rows])), float(np.median(nearest)))
            ambiguous[group.rows] = has_rival(distances[group.rows], typical_m)
    poses = (candidates.valid & (candidates.turns == 0)).sum(axis=1)
    for frame in tied.edges.keys() - _with_priors(problem):
        rows = observations.involves(frame)
        # Nothing else decides between the poses of a frame's only view.
        ambiguous |= rows & (rows.sum() == 1) & (poses > 1)
    return ambiguous


def _numbered_as_first(
    problem: Problem, tied: ConnectedFrames, picks: IntArray, symmetries: Mapping[str, FloatArray]
) -> tuple[ConnectedFrames, IntArray]:
    """Turns symmetric boards so that first views keep their corner numbers."""
    # Frames with priors are left as they are.
    edges, picks = dict(tied.edges), picks.copy()
    for frame in edges.keys() & symmetries.keys() - _with_priors(problem):
        rows, turns = problem.observations.involves(frame), symmetries[frame]
        # A target's turns are powers of the first, and candidates come in blocks of all turns.
        planar, turned = np.divmod(picks[rows], len(turns))
        picks[rows] = planar * len(turns) + (turned - turned[0]) % len(turns)
        edges[frame] = edges[frame] @ invert(turns[turned[0]])
    return replace(tied, edges=edges), picks


def _with_priors(problem: Problem) -> set[str]:
    return {name for prior in problem.priors for name in (prior.first, prior.second)}
