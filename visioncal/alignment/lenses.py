"""Lenses and boards of a whole cell, fitted with its frames: what is free of them, and how far."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.alignment.cell import Cell
from visioncal.alignment.looking import CameraLook
from visioncal.estimation.effects.lenses import LENSES, Looks, Seen
from visioncal.estimation.joint import CornerProblem, Scene, chance_limit, repeat_shares
from visioncal.estimation.outliers import Agreed
from visioncal.estimation.problem import Effect, Problem, State
from visioncal.estimation.solve import (
    fit_problem,
    fitted_covariance,
    normal_equations,
    score_gain,
)
from visioncal.stages.pnp import ViewPoses
from visioncal.types import Corners, IntArray, Mask

# Values that move by less than this share of their sigma have settled.
_SETTLED, _ROUNDS = 0.02, 6


def with_looks(
    cell: Cell,
    cameras: Mapping[str, CameraLook],
    views: Sequence[ViewPoses],
    agreed: Agreed,
    others: Sequence[Effect],
) -> tuple[Agreed, Seen]:
    """Fits lenses and boards with the rest, and with other effects."""
    looks = _looks(cell, cameras, views, _shares(cell, agreed))
    agreed, seen = settled_looks(cell, looks, looks.first, agreed, others)
    wider = _wider(cell, seen, agreed, others)
    if len(wider) > len(seen.free):
        agreed, seen = settled_looks(cell, seen.looks, wider, agreed, others)
    return agreed, seen


def _shares(cell: Cell, agreed: Agreed) -> dict[int, float]:
    """As how much of a view each row counts for lenses and boards; see `repeat_shares`."""
    observations, tree = agreed.problem.observations, agreed.problem.tree
    pairs = list(zip(observations.observers, observations.observed, strict=True))
    parted = {it: any(step.robot for step in tree.path(*it)) for it in set(pairs)}
    return repeat_shares(
        {
            row.view: (pair, row.station if parted[pair] else None)
            for row, pair in zip(cell.rows, pairs, strict=True)
        }
    )


def _looks(
    cell: Cell,
    cameras: Mapping[str, CameraLook],
    views: Sequence[ViewPoses],
    shares: Mapping[int, float],
) -> Looks:
    targets = tuple(cell.session.boards.values())
    one = {it.view: it for it in views}
    problems, poses = {}, {}
    for name, it in cameras.items():
        scene = Scene(
            "eye-to-hand",
            targets,
            it.camera,
            it.estimated,
            it.table.intrinsics,
            it.table.matrix_sigma_px,
            tuple(cell.session.boards),
        )
        mine = [one.get(view.view, view) for view in it.views]
        corners: dict[int, Corners] = {
            view.view: view.corners for view in mine if view.corners is not None
        }
        problems[name] = CornerProblem.of(scene, corners, shares)
        poses[name] = np.array([view.cam_from_target[0] for view in mine])
    return Looks.of(problems, poses)


def settled_looks(
    cell: Cell, looks: Looks, free: IntArray, agreed: Agreed, others: Sequence[Effect]
) -> tuple[Agreed, Seen]:
    """Linearises corners and fits the cell in turn, until lenses and boards stay."""
    bent = np.concatenate([np.zeros(0), *(it.values for it in others)])
    for _ in range(_ROUNDS):
        seen = looks.seen(free)
        problem = with_seen(cell, agreed.problem, seen, others)
        part = problem.subset(agreed.used)
        values = seen.looks.values[free]
        start = State(agreed.fit.state.edges, np.concatenate([values, bent]))
        fit = fit_problem(part, start, agreed.fit.noise)
        found, bent = np.split(fit.state.values, [len(free)])
        agreed = replace(agreed, problem=problem, fit=fit)
        spread = fitted_covariance(part, fit.state, fit.noise)
        sigma = np.sqrt(np.diag(spread))[problem.effect_columns[LENSES]] if len(free) else values
        if np.all(np.abs(found - values) <= _SETTLED * sigma):
            break
        looks = seen.looks.with_values(free, found)
    return agreed, seen


def with_seen(cell: Cell, problem: Problem, seen: Seen, others: Sequence[Effect]) -> Problem:
    """The problem with poses as its lenses and boards make them, and with other effects."""
    places = {view: at for at, view in enumerate(seen.views)}
    rows = np.array([places.get(it.view, -1) for it in cell.rows], dtype=np.int64)
    mine, before = rows >= 0, problem.observations
    measured, spread = before.measured.copy(), before.covariance.copy()
    measured[mine], spread[mine] = seen.looks.poses[rows[mine]], seen.spread[rows[mine]]
    wider = replace(problem, observations=replace(before, measured=measured, covariance=spread))
    return wider.with_effects([seen.effect(rows), *others])


def _wider(cell: Cell, seen: Seen, agreed: Agreed, others: Sequence[Effect]) -> IntArray:
    """What more the corners ask to set free: boards' bends, and lenses that were stated."""
    looks = seen.looks
    groups: list[IntArray] = [looks.shape_of(it) for it in looks.printed]
    for name, corners in looks.problems.items():
        lens = np.arange(looks.lenses[name].start, looks.lenses[name].stop)
        if corners.scene.mode == "auto" and not np.isin(lens, seen.free).all():
            groups.append(lens)
    if not all(it.has_spare_corners for it in looks.problems.values()):
        return seen.free
    every = np.unique(np.concatenate([seen.free, *groups]))
    repeated = replace(agreed.problem, with_repeats=True)
    problem = with_seen(cell, repeated, looks.seen(every), others)
    bent = agreed.fit.state.values[len(seen.free) :]
    state = State(agreed.fit.state.edges, np.concatenate([looks.values[every], bent]))
    scores = normal_equations(problem.subset(agreed.used), state, agreed.fit.noise)

    def among(free: IntArray) -> Mask:
        columns = problem.moving.copy()
        columns[problem.effect_columns[LENSES]] = np.isin(every, free)
        return columns

    def gain(group: IntArray) -> float:
        """By how much more than chance the squared error falls with a group free (Rao)."""
        more = np.setdiff1d(group, free)
        wider, now = among(np.union1d(free, more)), among(free)
        return score_gain(*scores, wider, now) - chance_limit(len(more))

    free = seen.free
    while groups:
        most, at = max((gain(it), at) for at, it in enumerate(groups))
        if most <= 0.0:
            break
        free = np.union1d(free, groups.pop(at))
    return free
