"""Growth of a whole cell's frame tree from relations between pairs of frames.

Each body of frames (what stands in the cell, what a flange carries) is grown by the best transforms
first (Prim 1957). Frames that these do not reach are placed by views in which all else is placed. A
board that looks the same turned does not determine its orientation: frames that are placed through
it are tried in every orientation, and all views together decide.

Where one arm looks at a board in the hand of another, views give `u * first * v * second * w =
seen`
with both arms' poses and three unknown transforms. With one of them known, the other two are a
hand-eye calibration: these are solved in turn (as Wu, Wang, Qi and Ren 2016 iterate), from starts
with v in 24 orientations.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.calibration.stages.pair_observations import (
    Factor,
    FramePair,
    Growth,
    Relation,
    factors_of,
    product_of,
)
from visioncal.calibration.stages.pairwise import (
    AGREE_M,
    FEWEST,
    Candidates,
    common_transform,
    hand_eye,
    partial_hand_eye,
)
from visioncal.calibration.stages.pose_ambiguity import CLEAR_RATIO
from visioncal.core.transforms import apply, compose, invert, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.positions import find_mounting, mounting_problem
from visioncal.estimation.procrustes import align, spreads

# Distances of views are capped here in a start's score [m].
_CAPPED_M = 0.1
# Most combinations of board orientations that are tried, and fewest views between two arms.
_MOST_TRIED = 256
_FEWEST = 5
# Rounds of a start, number of starts that are continued, and their rounds.
_ROUNDS, _FOLLOWED, _LONG = 6, 4, 40
# Largest median distance of the views after the alternation, rotations on a lever [m].
_NEAR_M = 0.02

# Fewest stops at which points are read to determine them and the instrument; fewest points that
# place an instrument, and their least extent in the second direction [m].
_FEWEST_STOPS, _FEWEST_POINTS, _SPREAD_M = 4, 3, 0.02
# Assumed sigma of these starts [m].
_ROUGH_M = 1e-2

# (4, 4) `body_from_frame` by name; and a frame with (t, 4, 4) candidate poses and a sigma [m].
_Placed: TypeAlias = Mapping[str, FloatArray]
_Option: TypeAlias = tuple[str, FloatArray, float]


@dataclass(frozen=True, eq=False)
class _Grown:
    """Frames (4, 4) in their bodies, those placed by a turned board, and their option counts."""

    placed: dict[str, FloatArray]
    by_turn: tuple[str, ...]
    counts: tuple[int, ...]


def spanning_tree(growth: Growth) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Places all frames in their bodies.

    Returns:
        (4, 4) `body_from_frame` by name, and the ambiguous frames: those that depend on the unknown
        orientation of a board.
    """
    first = _grow(growth, ())
    if not first.by_turn:
        return first.placed, ()
    grown = [(choice, _grow(growth, choice)) for choice in _choices(first.counts)]
    tried = [(_score(growth, item.placed), choice, item) for choice, item in grown]
    tried.sort(key=lambda pair: pair[0])
    score, chosen, best = tried[0]
    rivals = [pair for value, pair, _ in tried[1:] if value < CLEAR_RATIO * score]
    ambiguous = {
        name
        for rival in rivals
        for name, best_choice, rival_choice in zip(best.by_turn, chosen, rival, strict=False)
        if best_choice != rival_choice
    }
    return best.placed, tuple(name for name in best.placed if name in ambiguous)


def _choices(counts: Sequence[int]) -> Iterator[tuple[int, ...]]:
    numbers = list(counts)
    while np.prod(numbers, dtype=float) > _MOST_TRIED:
        numbers[numbers.index(max(numbers))] = 1
    yield from product(*(range(number) for number in numbers))


def _grow(growth: Growth, chosen: Sequence[int]) -> _Grown:
    tree = growth.tree
    placed = dict.fromkeys((tree.root, *tree.flanges.values()), np.eye(4))
    by_turn: list[str] = []
    counts: list[int] = []
    while options := (
        [*_related(growth, placed)]
        or [*_completed(growth, placed)]
        or [*placed_by_points(growth, placed)]
        or [*_hand_eye_placed(growth, placed)]
        or [*_hand_eye_placed(growth, placed, partly=True)]
    ):
        # Frames with several candidates come last: others may be reached unambiguously.
        name, matrices, _ = min(options, key=lambda pair: (len(pair[1]), pair[2]))
        choice = 0
        if len(matrices) > 1:
            choice = chosen[len(by_turn)] if len(by_turn) < len(chosen) else 0
            by_turn.append(name)
            counts.append(len(matrices))
        placed[name] = matrices[choice]
    return _Grown(placed, tuple(by_turn), tuple(counts))


def _related(growth: Growth, placed: _Placed) -> Iterator[_Option]:
    """Frames that a relation places."""
    for relation in growth.relations:
        if relation.first in placed and relation.second not in placed:
            pose = placed[relation.first] @ relation.matrix
            yield relation.second, pose[None], relation.sigma_m
        elif relation.second in placed and relation.first not in placed:
            poses = placed[relation.second] @ invert(relation.matrix @ relation.turns)
            yield relation.first, poses, relation.sigma_m


def _completed(growth: Growth, placed: _Placed) -> Iterator[_Option]:
    """Frames that are the only unplaced one in the chain of some views."""
    for pair in growth.oriented:
        rows = growth.sighted.early(pair.rows)
        factors = factors_of(growth, pair, rows)
        unplaced = [factor for factor in factors if factor.frame and factor.frame not in placed]
        if len(unplaced) != 1:
            continue
        (factor,) = unplaced
        at = factors.index(factor)
        before, after = (product_of(part, placed) for part in (factors[:at], factors[at + 1 :]))
        candidates = growth.sighted.candidates.take(rows).carried(invert(before), invert(after))
        if factor.is_inverse:
            candidates = replace(candidates, poses=invert(candidates.poses))
        # A board's own frame may be in any orientation: that of its first view is taken.
        turns = range(1 if factor.frame == pair.seen else len(growth.sighted.turns_of(pair.seen)))
        fits = [common_transform(candidates, turn) for turn in turns]
        yield factor.frame, np.array([matrix for matrix, *_ in fits]), fits[0][2]


def _hand_eye_placed(growth: Growth, placed: _Placed, *, partly: bool = False) -> Iterator[_Option]:
    """Frames that are one of two unplaced ones in the chain of some views, with a robot between.

    Where the motion determines them in part, a prior may determine the rest: these are found with
    `partly`, and the fit decides.
    """
    # Views give `before * u * between * v * after = seen` with unknown u and v: a hand-eye
    # calibration with `between^-1` as the robot. With three unknowns, two arms are between them.
    for pair in growth.oriented:
        rows = growth.sighted.early(pair.rows)
        factors = factors_of(growth, pair, rows)
        unplaced = [
            at for at, factor in enumerate(factors) if factor.frame and factor.frame not in placed
        ]
        if len(rows) < FEWEST or len(unplaced) not in (2, 3):
            continue
        # Unknowns without a robot between cannot be distinguished.
        between = [factors[begin + 1 : end] for begin, end in pairwise(unplaced)]
        if not all(any(not factor.frame for factor in part) for part in between):
            continue
        parts = [
            product_of(factors[begin + 1 : end], placed)
            for begin, end in pairwise([-1, *unplaced, len(factors)])
        ]
        candidates = growth.sighted.candidates.take(rows)
        candidates = candidates.carried(invert(parts[0]), invert(parts[-1]))
        if len(unplaced) == 2:
            robot, edges = invert(parts[1]), None
            if not partly:
                edges = hand_eye(robot, candidates, "eye-in-hand")
            elif growth.measured & ({step.frame for step in pair.path} - placed.keys()):
                x, z, typical_m = partial_hand_eye(robot, candidates)
                edges = None if typical_m > AGREE_M else ((x, z), (np.inf, np.inf))
            if edges is not None:
                (u_inverse, v), (sigma_u, sigma_v) = edges
                yield _option(factors[unplaced[0]], invert(u_inverse), sigma_u)
                yield _option(factors[unplaced[1]], v, sigma_v)
        elif not partly and (found_v := _between_arms(parts[1], parts[2], candidates)) is not None:
            yield _option(factors[unplaced[1]], *found_v)


def _option(factor: Factor, matrix: FloatArray, sigma_m: float) -> _Option:
    return factor.frame, (invert(matrix) if factor.is_inverse else matrix)[None], sigma_m


def _score(growth: Growth, placed: Mapping[str, FloatArray]) -> float:
    """Mean distance [m] of the early views from their predictions."""
    capped = []
    for pair in growth.oriented:
        rows = growth.sighted.early(pair.rows)
        factors = factors_of(growth, pair, rows)
        if all(factor.frame in placed for factor in factors if factor.frame):
            distances = growth.sighted.candidates.take(rows).distances(product_of(factors, placed))
            capped.append(np.minimum(distances.min(axis=1), _CAPPED_M))
    return float(np.concatenate(capped).mean()) if capped else 0.0


def _between_arms(
    first: FloatArray, second: FloatArray, candidates: Candidates
) -> tuple[FloatArray, float] | None:
    """Finds the transform v between two arms, and the views' median distance [m]."""
    if len(first) < _FEWEST or candidates.turns.max(initial=0) > 0:
        return None
    seen = candidates.poses[:, 0]
    starts = compose(Rotation.create_group("O").as_matrix(), np.zeros(3))
    tried = [_alternated(first, second, seen, start, _ROUNDS) for start in starts]
    tried.sort(key=lambda pair: pair[1])
    followed = [_alternated(first, second, seen, start, _LONG) for start, _ in tried[:_FOLLOWED]]
    middle, median = min(followed, key=lambda pair: pair[1])
    return (middle, median) if median < _NEAR_M else None


def _alternated(
    first: FloatArray, second: FloatArray, seen: FloatArray, middle: FloatArray, rounds: int
) -> tuple[FloatArray, float]:
    """Solves for two of the three in turn; returns v, and the views' median distance [m]."""
    median = np.inf
    for _ in range(rounds):
        # u and w for given v; then v and w for given u; then u and v for given w.
        u_inverse, w = _park(invert(first @ middle @ second), seen)
        _, w = _park(invert(second), invert(first) @ u_inverse @ seen)
        u_inverse, middle = _park(invert(first), seen @ invert(w) @ invert(second))
        between = invert(invert(u_inverse) @ first @ middle @ second @ w) @ seen
        distances = np.linalg.norm(between[:, :3, 3], axis=1) + LEVER_M * rotation_angle(between)
        median = float(np.median(distances))
    return middle, median


def _park(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    solution = SOLVERS["park"](robot, camera)
    return solution.x, solution.z


def mounted_points(growth: Growth) -> Iterator[Relation]:
    """Relations from an instrument that reads points on a robot's flange, to both."""
    groups: dict[tuple[str, str], list[FramePair]] = {}
    for pair in growth.pointed:
        if len(pair.robots) == 1 and not pair.robots[0].is_up:
            groups.setdefault((pair.seer, pair.robots[0].frame), []).append(pair)
    for (seer, flange), pairs in groups.items():
        robot = growth.tree.branches[flange].robot
        rows = np.concatenate([pair.rows for pair in pairs])
        stops = growth.sighted.stops[rows]
        if len(np.unique(stops)) < _FEWEST_STOPS:
            continue
        points = np.repeat(np.arange(len(pairs)), [len(pair.rows) for pair in pairs])
        read = growth.sighted.candidates.poses[rows, 0, :3, 3]
        problem = mounting_problem(growth.poses[robot][stops], read, points)
        mounting, errors = find_mounting(problem, np.unique(stops, return_inverse=True)[1])
        off_m = np.linalg.norm(errors, axis=1)
        no_turns, sigma_m = np.eye(4)[None], float(np.median(off_m)) + _ROUGH_M
        base = growth.tree.branches[flange].parent
        yield Relation(base, seer, mounting.frame, sigma_m, no_turns)
        for pair, point in zip(pairs, mounting.points, strict=True):
            yield Relation(flange, pair.seen, compose(np.eye(3), point), sigma_m, no_turns)


def placed_by_points(growth: Growth, placed: _Placed) -> Iterator[_Option]:
    """Points that a placed instrument read, and instruments that read placed points."""
    unplaced_seers: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    for pair in growth.pointed:
        inner = factors_of(growth, pair, pair.rows)[1:-1]
        if not all(factor.frame in placed for factor in inner if factor.frame):
            continue
        read = growth.sighted.candidates.poses[pair.rows, 0, :3, 3]
        body = product_of(inner, placed)
        if pair.seer in placed and pair.seen not in placed:
            seen = apply(invert(body), apply(placed[pair.seer][None], read[:, None]))
            yield pair.seen, compose(np.eye(3), np.median(seen[:, 0], axis=0))[None], _ROUGH_M
        elif pair.seer not in placed and pair.seen in placed:
            points = apply(body, np.broadcast_to(placed[pair.seen][:3, 3], (len(read), 1, 3)))
            unplaced_seers.setdefault(pair.seer, []).append((points[:, 0], read))
    for seer, parts in unplaced_seers.items():
        points, read = (np.concatenate(pair) for pair in zip(*parts, strict=True))
        if len(read) >= _FEWEST_POINTS and spreads(points)[0][1] > _SPREAD_M:
            yield seer, align(points, read)[None], _ROUGH_M
