"""Ties the frames of a whole cell together: where each is, to begin a joint adjustment with.

Every pair of frames of which one saw the other at several stops is solved by itself, by a consensus
of its earliest views: what moves later on has not moved yet. A pair that no robot parts gives one
transform; one that a robot parts gives two, as a hand-eye calibration does. Of all that is so
found the best transforms are taken first (Prim 1957), until every frame hangs on the tree.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimation.problem import FramePrior
from visioncal.estimation.tree import Step, Tree
from visioncal.stages.grow import grow
from visioncal.stages.pairwise import FEWEST, consensus, hand_eye
from visioncal.stages.placing import mounted_points
from visioncal.stages.sighted import Growth, Pair, Relation, Sighted
from visioncal.transforms import invert
from visioncal.types import FloatArray, IntArray, Mount


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


def tie(
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
    placed, ambiguous = grow(replace(growth, relations=relations))
    edges = {
        name: invert(placed[tree.branches[name].parent]) @ placed[name]
        for name in tree.unknown
        if name in placed and tree.branches[name].parent in placed
    }
    return Tied(edges, tuple(it for it in tree.unknown if it not in edges), ambiguous)


def pick(predicted: FloatArray, sighted: Sighted) -> IntArray:
    """Picks of each observation the candidate (n,) that is nearest to what is predicted.

    Args:
        predicted: (n, 4, 4) `seer_from_seen`.
        sighted: What may have been seen.
    """
    return np.asarray(sighted.candidates.distances(predicted).argmin(axis=1))


def _pairs(tree: Tree, sighted: Sighted) -> tuple[Pair, ...]:
    rows: dict[tuple[str, str], list[int]] = {}
    for at in np.argsort(sighted.stops, kind="stable").tolist():
        rows.setdefault((sighted.seers[at], sighted.seen[at]), []).append(at)
    return tuple(Pair(*pair, np.array(at), tree.path(*pair)) for pair, at in rows.items())


def _known(tree: Tree) -> Iterator[Relation]:
    for name, branch in tree.branches.items():
        if branch.known is not None:
            yield Relation(branch.parent, name, branch.known, 0.0, np.eye(4)[None])


def _solved(
    tree: Tree, poses: Mapping[str, FloatArray], sighted: Sighted, pair: Pair
) -> Iterator[Relation]:
    """What one pair says by itself."""
    rows, turns = sighted.early(pair.rows), sighted.turns_of(pair.seen)
    if not pair.robots:
        matrix, _, sigma_m = consensus(sighted.candidates.take(rows))
        yield Relation(pair.seer, pair.seen, matrix, sigma_m, turns)
        return
    if len(pair.robots) > 1:
        return
    (step,) = pair.robots
    flange, base = step.frame, tree.branches[step.frame].parent
    near, far = (flange, base) if step.is_up else (base, flange)
    # Where the earliest views do not agree by half, perhaps all do.
    for mine in (rows, pair.rows) if len(rows) < len(pair.rows) else (rows,):
        found = _parted(poses, sighted, step, mine)
        if found is not None:
            (x, z), (sigma_x, sigma_z) = found
            yield Relation(near, pair.seer, x, sigma_x, np.eye(4)[None])
            yield Relation(far, pair.seen, z, sigma_z, turns)
            return


def _parted(
    poses: Mapping[str, FloatArray], sighted: Sighted, step: Step, rows: IntArray
) -> tuple[tuple[FloatArray, FloatArray], tuple[float, float]] | None:
    """Both transforms beside a robot, by some views, and what each is known to [m]."""
    if len(rows) < FEWEST:
        return None
    robot = poses[step.robot][sighted.stops[rows]]
    mount: Mount = "eye-in-hand" if step.is_up else "eye-to-hand"
    robot = robot if step.is_up else invert(robot)
    return hand_eye(robot, sighted.candidates.take(rows), mount)
