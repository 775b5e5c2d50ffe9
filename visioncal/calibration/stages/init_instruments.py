"""Where instruments and points are of which places alone were read, to begin with."""

from collections.abc import Iterator, Mapping

import numpy as np

from visioncal.calibration.stages.pair_observations import (
    FramePair,
    Growth,
    Relation,
    factors_of,
    product_of,
)
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.positions import Places, find_mounting
from visioncal.estimation.procrustes import align, apply, spreads

# Stops at which points must have been read before they determine their and the instrument's
# place; points by which an instrument is placed, and how far they must reach to both sides [m].
_FEWEST_STOPS, _FEWEST_POINTS, _SPREAD_M = 4, 3, 0.02
# What starts are known to, for want of better [m].
_ROUGH_M = 1e-2
_NOMINAL_M = 1e-4


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
