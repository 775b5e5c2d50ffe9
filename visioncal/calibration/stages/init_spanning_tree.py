"""Grows the tree of a whole cell's frames from what pairs of them say of each other.

Each body of frames (what stands in the cell, what a flange carries) is grown by the best transforms
first (Prim 1957). What these do not reach is placed by views of which all else is known. A board
that looks the same turned does not say which way round it was seen: what is placed by way of such
a board is tried every way round, and all views together decide which it was.

Where one arm looks at a board in the hand of another, views say `u * first * v * second * w = seen`
with both arms' poses, and three transforms are unknown. Were one of them known, the two others
would be a hand-eye calibration: each is solved with the others as they were, in turn (as Wu, Wang,
Qi and Ren 2016 iterate), from turns of the bases all around.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

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
from visioncal.estimation.positions import Places, find_mounting
from visioncal.estimation.procrustes import align, spreads

# A view that is farther off than this says nothing more about which start is right [m].
_FAR_M = 0.1
# So many starts are tried, by turns of boards, and not more.
_MOST_TRIED = 256
_FEWEST = 5
# Rounds of a start, how many starts are followed, and for how long.
_ROUNDS, _FOLLOWED, _LONG = 6, 4, 40
# A start is one where views lie within so much of what is predicted, rotations on a lever [m].
_NEAR_M = 0.02

# Stops at which points must have been read before they determine their and the instrument's
# place; points by which an instrument is placed, and how far they must reach to both sides [m].
_FEWEST_STOPS, _FEWEST_POINTS, _SPREAD_M = 4, 3, 0.02
# What starts are known to, for want of better [m].
_ROUGH_M = 1e-2
_NOMINAL_M = 1e-4


@dataclass(frozen=True, eq=False)
class _Grown:
    """Frames (4, 4) in their bodies, and those that stand there by a turned board, one or more."""

    placed: dict[str, FloatArray]
    by_turn: tuple[str, ...]
    counts: tuple[int, ...]


def spanning_tree(growth: Growth) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Places all frames in their bodies.

    Returns:
        (4, 4) `body_from_frame` by name, and the frames that might as well be elsewhere, because
        it is not known which way round a board was seen.
    """
    first = _grown(growth, ())
    if not first.by_turn:
        return first.placed, ()
    found = []
    for chosen in _choices(first.counts):
        grown = _grown(growth, chosen)
        found.append((_score(growth, grown.placed), chosen, grown))
    found.sort(key=lambda pair: pair[0])
    score, chosen, best = found[0]
    rivals = [pair for value, pair, _ in found[1:] if value < CLEAR_RATIO * score]
    ambiguous = {
        name
        for rival in rivals
        for name, mine, other in zip(best.by_turn, chosen, rival, strict=False)
        if mine != other
    }
    return best.placed, tuple(name for name in best.placed if name in ambiguous)


def _choices(counts: Sequence[int]) -> Iterator[tuple[int, ...]]:
    tried = list(counts)
    while np.prod(tried, dtype=float) > _MOST_TRIED:
        tried[tried.index(max(tried))] = 1
    yield from product(*(range(index) for index in tried))


def _grown(growth: Growth, chosen: Sequence[int]) -> _Grown:
    tree = growth.tree
    placed = {tree.root: np.eye(4)}
    placed |= dict.fromkeys(tree.flanges.values(), np.eye(4))
    by_turn: list[str] = []
    counts: list[int] = []
    while options := (
        [*_related(growth, placed)]
        or [*_implied(growth, placed)]
        or [*placed_by_points(growth, placed)]
        or [*_parted(growth, placed)]
        or [*_parted(growth, placed, partly=True)]
    ):
        # What a turned board places comes last: others may come by a way that is certain.
        name, matrices, _ = min(options, key=lambda pair: (len(pair[1]), pair[2]))
        at = 0
        if len(matrices) > 1:
            at = chosen[len(by_turn)] if len(by_turn) < len(chosen) else 0
            by_turn.append(name)
            counts.append(len(matrices))
        placed[name] = matrices[at]
    return _Grown(placed, tuple(by_turn), tuple(counts))


def _related(
    growth: Growth, placed: Mapping[str, FloatArray]
) -> Iterator[tuple[str, FloatArray, float]]:
    """Frames that a relation places: each with (t, 4, 4) where it may be, and how well [m]."""
    for relation in growth.relations:
        if relation.first in placed and relation.second not in placed:
            yield (
                relation.second,
                (placed[relation.first] @ relation.matrix)[None],
                relation.sigma_m,
            )
        elif relation.second in placed and relation.first not in placed:
            yield (
                relation.first,
                placed[relation.second] @ invert(relation.matrix @ relation.turns),
                relation.sigma_m,
            )


def _implied(
    growth: Growth, placed: Mapping[str, FloatArray]
) -> Iterator[tuple[str, FloatArray, float]]:
    """Frames that are all that is not placed of what some views have to do with."""
    for pair in growth.oriented:
        rows = growth.sighted.early(pair.rows)
        factors = factors_of(growth, pair, rows)
        missing = [factor for factor in factors if factor.frame and factor.frame not in placed]
        if len(missing) != 1:
            continue
        (factor,) = missing
        at = factors.index(factor)
        before, after = (product_of(part, placed) for part in (factors[:at], factors[at + 1 :]))
        there = growth.sighted.candidates.take(rows).carried(invert(before), invert(after))
        if factor.is_inverse:
            there = replace(there, poses=invert(there.poses))
        # A board's own frame may be either way round: that of its first view is taken.
        ways = range(1 if factor.frame == pair.seen else len(growth.sighted.turns_of(pair.seen)))
        found = [common_transform(there, way) for way in ways]
        yield factor.frame, np.array([matrix for matrix, *_ in found]), found[0][2]


def _parted(
    growth: Growth, placed: Mapping[str, FloatArray], *, partly: bool = False
) -> Iterator[tuple[str, FloatArray, float]]:
    """Frames that are one of two that robots part, of all that some views have to do with.

    Where the motion determines them in part, a prior about them may determine the rest: these are
    found with `partly`, and the fit decides.
    """
    # Views say `before * u * between * v * after = seen`, u and v being unknown: a hand-eye
    # calibration with `between^-1` for its robot. Where three are unknown, two arms part them.
    for pair in growth.oriented:
        rows = growth.sighted.early(pair.rows)
        factors = factors_of(growth, pair, rows)
        open_ones = [
            at for at, factor in enumerate(factors) if factor.frame and factor.frame not in placed
        ]
        if len(rows) < FEWEST or len(open_ones) not in (2, 3):
            continue
        # What no robot separates cannot be distinguished.
        inner = [factors[begin + 1 : end] for begin, end in pairwise(open_ones)]
        if not all(any(not factor.frame for factor in part) for part in inner):
            continue
        parts = [
            product_of(factors[begin + 1 : end], placed)
            for begin, end in pairwise([-1, *open_ones, len(factors)])
        ]
        there = growth.sighted.candidates.take(rows).carried(invert(parts[0]), invert(parts[-1]))
        if len(open_ones) == 2:
            robot, found = invert(parts[1]), None
            if not partly:
                found = hand_eye(robot, there, "eye-in-hand")
            elif growth.measured & ({step.frame for step in pair.way} - placed.keys()):
                x, z, typical_m = partial_hand_eye(robot, there)
                found = None if typical_m > AGREE_M else ((x, z), (np.inf, np.inf))
            if found is not None:
                (u_inverse, v), (sigma_u, sigma_v) = found
                yield _as_placed(factors[open_ones[0]], invert(u_inverse), sigma_u)
                yield _as_placed(factors[open_ones[1]], v, sigma_v)
        elif not partly and (middle := _between_arms(parts[1], parts[2], there)) is not None:
            yield _as_placed(factors[open_ones[1]], *middle)


def _as_placed(factor: Factor, matrix: FloatArray, sigma_m: float) -> tuple[str, FloatArray, float]:
    there = invert(matrix) if factor.is_inverse else matrix
    return factor.frame, there[None], sigma_m


def _score(growth: Growth, placed: Mapping[str, FloatArray]) -> float:
    """Mean distance [m] of the early views from what the placed frames predict."""
    away = []
    for pair in growth.oriented:
        rows = growth.sighted.early(pair.rows)
        factors = factors_of(growth, pair, rows)
        if all(factor.frame in placed for factor in factors if factor.frame):
            distances = growth.sighted.candidates.take(rows).distances(product_of(factors, placed))
            away.append(np.minimum(distances.min(axis=1), _FAR_M))
    return float(np.concatenate(away).mean()) if away else 0.0


def _between_arms(
    first: FloatArray, second: FloatArray, candidates: Candidates
) -> tuple[FloatArray, float] | None:
    """Finds the transform in the middle."""
    if len(first) < _FEWEST or candidates.turns.max(initial=0) > 0:
        return None
    seen = candidates.poses[:, 0]
    starts = Rotation.create_group("O").as_matrix()
    found = []
    for turn in starts:
        middle, away = _alternated(first, second, seen, compose(turn, np.zeros(3)), _ROUNDS)
        found.append((away, middle))
    found.sort(key=lambda pair: pair[0])
    followed = [_alternated(first, second, seen, array, _LONG) for _, array in found[:_FOLLOWED]]
    middle, away = min(followed, key=lambda pair: pair[1])
    return (middle, away) if away < _NEAR_M else None


def _alternated(
    first: FloatArray, second: FloatArray, seen: FloatArray, middle: FloatArray, rounds: int
) -> tuple[FloatArray, float]:
    """Solves for two of the three in turn; returns the middle, and the views' median distance."""
    away = np.inf
    for _ in range(rounds):
        # u and w with v as it is; then v and w with u; then u and v with w.
        u_inverse, w = _park(invert(first @ middle @ second), seen)
        _, w = _park(invert(second), invert(first) @ u_inverse @ seen)
        u_inverse, middle = _park(invert(first), seen @ invert(w) @ invert(second))
        between = invert(invert(u_inverse) @ first @ middle @ second @ w) @ seen
        apart = np.linalg.norm(between[:, :3, 3], axis=1) + LEVER_M * rotation_angle(between)
        away = float(np.median(apart))
    return middle, away


def _park(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    solution = SOLVERS["park"](robot, camera)
    return solution.x, solution.z


def mounted_points(growth: Growth) -> Iterator[Relation]:
    """What an instrument says that reads points on a robot's flange: where both are."""
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
        places = Places(
            growth.poses[robot][stops],
            growth.sighted.candidates.poses[rows, 0, :3, 3],
            points,
            np.unique(stops, return_inverse=True)[1],
            np.full(len(rows), _NOMINAL_M),
        )
        mounting, away = find_mounting(places)
        none = np.eye(4)[None]
        sigma_m = float(np.median(away)) + _ROUGH_M
        base = growth.tree.branches[flange].parent
        yield Relation(base, seer, mounting.base_from_instrument, sigma_m, none)
        for pair, point in zip(pairs, mounting.on_flange, strict=True):
            yield Relation(flange, pair.seen, compose(np.eye(3), point), sigma_m, none)


def placed_by_points(
    growth: Growth, placed: Mapping[str, FloatArray]
) -> Iterator[tuple[str, FloatArray, float]]:
    """Points that a placed instrument read, and instruments that read placed points."""
    open_seers: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
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
            there = apply(body, np.broadcast_to(placed[pair.seen][:3, 3], (len(read), 1, 3)))
            open_seers.setdefault(pair.seer, []).append((there[:, 0], read))
    for seer, parts in open_seers.items():
        there, read = (np.concatenate(pair) for pair in zip(*parts, strict=True))
        if len(read) >= _FEWEST_POINTS and spreads(there)[0][1] > _SPREAD_M:
            yield seer, align(there, read)[None], _ROUGH_M
