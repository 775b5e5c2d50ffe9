"""Observations that a session keeps from every fit (`role = holdout`), beside the answer."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration import HELD_BACK, Sight
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.poses import fit_poses
from visioncal.estimation.problem import Problem
from visioncal.pipeline.solving import Solved, problem_of, targets_of
from visioncal.stages.choose import choose_by, chosen
from visioncal.stages.clocks import clock_effects
from visioncal.stages.observed import Observed
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.validate import apart, chain_rms_px


def held_sights(solved: Solved, looked: Observed) -> dict[int, Sight]:
    """How far such observations are from what the rest of the cell predicts, by view."""
    cell, state, placed = solved.cell, solved.agreed.fit.state, solved.cell.tree.branches.keys()
    rows = [it for it in cell.held if it.view in looked.poses and {it.seer, it.seen} <= placed]
    if not rows:
        return {}
    solved = replace(solved, cell=replace(cell, rows=tuple(rows)))
    views = [looked.poses[it.view] for it in rows]
    predicted = _problem(solved, looked, [chosen(it, 0, None) for it in views]).predicted(state)
    targets = targets_of(cell)
    views = [
        choose_by(view, pose, targets.get(row.seen))
        for view, pose, row in zip(views, predicted, rows, strict=True)
    ]
    looks = solved.looks
    lenses = {} if looks is None else {it: looks.camera(it) for it in looks.problems}
    positions = np.zeros((0, 3)) if looks is None else np.concatenate(looks.corners)
    cameras = [lenses.get(it.seer) for it in rows]
    for at, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        if view.corners is not None and camera is not None:
            stack = CornerStack.of({view.view: view.corners}, positions)
            poses = fit_poses(stack, camera, view.cam_from_target).cam_from_target
            views[at] = replace(view, cam_from_target=poses)
    away_m, away_rad = apart(_problem(solved, looked, views), state)
    rms_px = chain_rms_px([it.corners for it in views], predicted, cameras, positions)
    figures = np.stack([1e3 * away_m, np.rad2deg(away_rad), rms_px], axis=1)
    found = {}
    for row, view, each in zip(rows, views, figures.tolist(), strict=True):
        mm, deg, px = (it if np.isfinite(it) else None for it in each)
        count = None if view.corners is None else len(view.corners.ids)
        found[row.view] = Sight(
            row.view,
            cell.stops[row.station],
            row.seer,
            row.seen,
            False,
            HELD_BACK,
            mm,
            deg,
            count,
            px,
        )
    return found


def _problem(solved: Solved, looked: Observed, views: Sequence[ViewPoses]) -> Problem:
    """The problem of a cell's rows, with the unknowns of the fit."""
    fitted = solved.agreed.problem
    problem = replace(problem_of(solved.cell, views), tree=fitted.tree, poses=fitted.poses)
    seen, none = problem.observations, np.zeros(len(problem), dtype=bool)
    for move in solved.agreed.moves:
        seen = seen.renamed(move.frame, move.twin, seen.stops >= move.stop)
    late = {it.name: it for it in clock_effects(solved.cell, looked.clocks)}
    effects = [
        late.get(it.name)
        or replace(it, by_sensor=None, concerned=None if it.concerned is None else none)
        for it in fitted.effects
    ]
    return replace(problem, observations=seen, points=fitted.points).with_effects(effects)
