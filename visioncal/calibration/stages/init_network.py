"""Ties the frames of a whole cell together: where each is, to begin a joint adjustment with.

Every pair of frames of which one saw the other at several stops is solved by itself, by a consensus
of its earliest views: what moves later on has not moved yet. A pair that no robot parts gives one
transform; one that a robot parts gives two, as a hand-eye calibration does. Of all that is so
found the best transforms are taken first (Prim 1957), until every frame hangs on the tree.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.init_instruments import mounted_points
from visioncal.calibration.stages.init_spanning_tree import spanning_tree
from visioncal.calibration.stages.pair_observations import FramePair, Growth, Relation, Sighted
from visioncal.calibration.stages.pairwise import (
    FEWEST,
    Candidates,
    common_transform,
    hand_eye,
    trimmed,
)
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.estimation.parts import FramePrior
from visioncal.estimation.tree import Tree


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
    growth = Growth(tree, poses, sighted, _pairs(tree, sighted), ())
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
    # Where the earliest views do not agree by half, perhaps all do.
    for mine in (rows, pair.rows) if len(rows) < len(pair.rows) else (rows,):
        if len(mine) < FEWEST:
            continue
        found = hand_eye(*_parted(poses, sighted, pair, mine), _mount(pair))
        if found is not None:
            yield from _both(tree, sighted, pair, *found)
            return


def _loose(growth: Growth) -> Iterator[Relation]:
    """What the pair with the most views says, however little that is."""
    pairs = [pair for pair in growth.oriented if len(pair.robots) == 1 and len(pair.rows) >= FEWEST]
    if pairs:
        pair = max(pairs, key=lambda value: len(value.rows))
        found = trimmed(*_parted(growth.poses, growth.sighted, pair, pair.rows))[1]
        yield from _both(growth.tree, growth.sighted, pair, (found.x, found.z), (np.inf, np.inf))


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


def _mount(pair: FramePair) -> Mount:
    return "eye-in-hand" if pair.robots[0].is_up else "eye-to-hand"
