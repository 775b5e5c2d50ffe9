"""Ties the frames of a whole cell together: where each is, to begin a joint adjustment with.

Every pair of frames of which one saw the other at several stops is solved by itself, by a consensus
of its earliest views: what moves later on has not moved yet. A pair that no robot parts gives one
transform; one that a robot parts gives two, as a hand-eye calibration does. Of all that is so
found the best transforms are taken first (Prim 1957), until every frame hangs on the tree.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from visioncal.estimator.arm import LEVER_M
from visioncal.estimator.closure import Closure, Edges, Noise, closure_information
from visioncal.estimator.linalg import covariance, spectrum
from visioncal.estimator.networktree import Tree
from visioncal.solvers import SOLVERS
from visioncal.stages.choose import Candidates, distances_to
from visioncal.stages.grow import (
    Growth,
    Pair,
    Relation,
    Sighted,
    consensus,
    distances_from,
    grow,
    some,
)
from visioncal.transforms import invert
from visioncal.types import FloatArray, IntArray, Mount

# Triples of views to start a hand-eye calibration from, and how many are followed up.
_TRIPLES, _REFINED, _ROUNDS = 40, 4, 6
_FEWEST = 3
# Below this scaled eigenvalue ratio the motion leaves a direction open; an edge that is known worse
# than this [m, with rotations on a lever] is no start.
_NULL_RATIO, _WORST_M = 1e-8, 0.1
# Noise by which pairs are weighed against each other [rad, m].
_USUAL = Noise(5e-4, 5e-4)


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


def tie(tree: Tree, poses: Mapping[str, FloatArray], sighted: Sighted) -> Tied:
    """Finds where the frames are.

    Args:
        tree: The frames; its root's body has its place by known edges.
        poses: (s, 4, 4) `base_from_flange` by robot and stop.
        sighted: What was seen.
    """
    pairs = _pairs(tree, sighted)
    relations = [*_known(tree)]
    for pair in pairs:
        relations += _solved(tree, poses, sighted, pair)
    placed, ambiguous = grow(Growth(tree, poses, sighted, pairs, relations))
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
    return np.asarray(distances_from(predicted, sighted.candidates).argmin(axis=1))


def _pairs(tree: Tree, sighted: Sighted) -> tuple[Pair, ...]:
    rows: dict[tuple[str, str], list[int]] = {}
    for at in np.argsort(sighted.stops, kind="stable").tolist():
        rows.setdefault((sighted.seers[at], sighted.seen[at]), []).append(at)
    return tuple(Pair(*pair, np.array(at), tree.way(*pair)) for pair, at in rows.items())


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
        matrix, sigma_m = consensus(some(sighted.candidates, rows), sighted.turns[rows])
        yield Relation(pair.seer, pair.seen, matrix, sigma_m, turns)
        return
    if len(pair.robots) > 1 or len(rows) < _FEWEST:
        return
    (step,) = pair.robots
    flange, base = step.frame, tree.branches[step.frame].parent
    robot = poses[step.robot][sighted.stops[rows]]
    mount: Mount = "eye-in-hand" if step.is_up else "eye-to-hand"
    robot = robot if step.is_up else invert(robot)
    found = _hand_eye(robot, some(sighted.candidates, rows), sighted.turns[rows], mount)
    if found is None:
        return
    (x, z), (sigma_x, sigma_z) = found
    near, far = (flange, base) if step.is_up else (base, flange)
    yield Relation(near, pair.seer, x, sigma_x, np.eye(4)[None])
    yield Relation(far, pair.seen, z, sigma_z, turns)


def _hand_eye(
    robot: FloatArray, candidates: Candidates, turns: IntArray, mount: Mount
) -> tuple[tuple[FloatArray, FloatArray], tuple[float, float]] | None:
    """Both edges by a consensus of m views, and what each is known to [m]; None where open."""
    half = len(robot) // 2 + 1
    found = []
    for rows, picks in _starts(candidates, turns):
        away = distances_to(robot, candidates, *_park(robot[rows], candidates.poses[rows, picks]))
        found.append((_trimmed(away, half), away))
    found.sort(key=lambda it: it[0])
    settled = [_concentrated(robot, candidates, away, half) for _, away in found[:_REFINED]]
    _, chosen, picks, edges = min(settled, key=lambda it: it[0])
    picked = candidates.poses[chosen, picks[chosen]]
    data = Closure(mount, robot[chosen], picked, np.zeros((len(chosen), 6, 6)))
    information = closure_information(data, Edges(*edges, np.zeros(0)), _USUAL)
    if spectrum(information).ratio < _NULL_RATIO:
        return None
    spread = covariance(information)
    variances = np.diag(spread).reshape(4, 3).sum(axis=1)
    x, z = np.sqrt(variances[1::2]) + LEVER_M * np.sqrt(variances[::2])
    return None if max(x, z) > _WORST_M else (edges, (float(x), float(z)))


def _trimmed(away: FloatArray, half: int) -> float:
    return float(np.sort(away.min(axis=1))[:half].sum())


def _park(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    solution = SOLVERS["park"](robot, camera)
    return solution.x, solution.z


def _starts(candidates: Candidates, turns: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Rows and picks to solve from: all views' best by image, then triples of views."""
    yield np.arange(len(turns)), np.zeros(len(turns), dtype=np.int64)
    rng = np.random.default_rng(0)
    counts = candidates.valid.sum(axis=1)
    likely = 1.0 / counts**2
    for _ in range(_TRIPLES):
        triple = rng.choice(len(turns), _FEWEST, replace=False, p=likely / likely.sum())
        options = [list(range(counts[at])) for at in triple]
        # A turn of the target in all views alike is a change of its frame, and no other solution.
        options[0] = [at for at in options[0] if turns[triple[0], at] == 0]
        for picks in product(*options):
            yield triple, np.array(picks)


def _concentrated(
    robot: FloatArray, candidates: Candidates, away: FloatArray, half: int
) -> tuple[float, IntArray, IntArray, tuple[FloatArray, FloatArray]]:
    """Solves from the nearest half, again and again (Rousseeuw and Van Driessen 1999)."""
    for _ in range(_ROUNDS):
        picks = away.argmin(axis=1)
        chosen = np.sort(np.argsort(away.min(axis=1))[:half])
        edges = _park(robot[chosen], candidates.poses[chosen, picks[chosen]])
        away = distances_to(robot, candidates, *edges)
    return _trimmed(away, half), chosen, away.argmin(axis=1), edges
