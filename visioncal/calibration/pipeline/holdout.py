"""Observations that a session keeps from every fit (`role = holdout`), beside the answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.pipeline.solved import Solved
from visioncal.calibration.pipeline.starting import problem_of, targets_of
from visioncal.calibration.stages.cell import ObservationRow
from visioncal.calibration.stages.clocks import clock_effects
from visioncal.calibration.stages.kinematics import unseen_views
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.pose_ambiguity import choose_by, chosen
from visioncal.calibration.stages.validate import apart
from visioncal.estimation.chain import scatter
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.parts import State
from visioncal.estimation.poses import fit_poses
from visioncal.estimation.problem import Problem
from visioncal.results import HELD_BACK, ViewResult
from visioncal.results.arm import UnseenView


@dataclass(frozen=True, eq=False)
class Held:
    """The observations that are held back, as the lenses and boards of the fit have them.

    Attributes:
        rows: The h observations.
        views: Their poses.
        problem: What they measured, with the unknowns of the fit.
    """

    rows: tuple[ObservationRow, ...]
    views: tuple[ViewPoses, ...]
    problem: Problem


def held_back(solved: Solved, looked: Observed) -> Held | None:
    """What is held back and can be compared with the fit; None for nothing."""
    cell, state, placed = solved.cell, solved.agreed.fit.state, solved.cell.tree.branches.keys()
    rows = [row for row in cell.held if row.view in looked.poses and {row.seer, row.seen} <= placed]
    if not rows:
        return None
    solved = replace(solved, cell=replace(cell, rows=tuple(rows)))
    views = [looked.poses[row.view] for row in rows]
    predicted = _problem(solved, looked, [chosen(view, 0, None) for view in views]).predicted(state)
    targets = targets_of(cell)
    views = [
        choose_by(view, pose, targets.get(row.seen))
        for view, pose, row in zip(views, predicted, rows, strict=True)
    ]
    looks = solved.looks
    for at, (view, row) in enumerate(zip(views, rows, strict=True)):
        if looks is not None and view.corners is not None and row.seer in looks.problems:
            stack, camera = CornerStack.of({view.view: view.corners}, looks.points), row.seer
            poses = fit_poses(stack, looks.camera(camera), view.cam_from_target).cam_from_target
            views[at] = replace(view, cam_from_target=poses)
    return Held(tuple(rows), tuple(views), _problem(solved, looked, views))


def held_views(solved: Solved, looked: Observed) -> dict[int, ViewResult]:
    """How far such observations are from what the rest of the cell predicts, by view."""
    held = held_back(solved, looked)
    if held is None:
        return {}
    state, problem = solved.agreed.fit.state, held.problem
    away_m, away_rad = apart(problem, state)
    if solved.cell.mount is not None:
        among = set(solved.part.observations.observed)
        known = np.array([name in among for name in problem.observations.observed])
        from_mean = scatter(problem.subset(known), solved.part, state)
        away_m[known] = from_mean[0]
        away_rad[known] = np.where(np.isnan(away_rad[known]), np.nan, from_mean[1])
    rms_px = solved.pixels(held.rows, held.views, problem.predicted(state), state)
    figures = np.stack([1e3 * away_m, np.rad2deg(away_rad), rms_px], axis=1)
    found = {}
    for row, seen, each in zip(held.rows, held.views, figures.tolist(), strict=True):
        mm, deg, px = (value if np.isfinite(value) else None for value in each)
        stop = solved.cell.stops[row.station]
        count = None if seen.corners is None else len(seen.corners.ids)
        found[row.view] = ViewResult(
            row.view, False, HELD_BACK, count, px, mm, deg, row.seer, row.seen, stop
        )
    return found


def held_by_both_arms(solved: Solved, looked: Observed, robot: str) -> tuple[UnseenView, ...]:
    """How far what is held back is off by a robot's nominal arm with its own fit, and by ours."""
    arm, held = solved.arms[robot], held_back(solved, looked)
    if held is None or arm.kinematics is None:
        return ()
    stated = arm.without_errors(held.problem)
    stated = arm.stated(stated) or stated
    was, now = (
        np.stack(apart(problem, _in(problem, state))[::-1], axis=1)
        for problem, state in (
            (stated, arm.kinematics.nominal.fit.state),
            (held.problem, solved.agreed.fit.state),
        )
    )
    views = [row.view for row in held.rows]
    return unseen_views(views, was, now, np.isfinite(now[:, 0]))


def _in(problem: Problem, state: State) -> State:
    """The state of an earlier fit, of other random coefficients of lenses: these move nothing."""
    if not problem.effects:
        return state
    first = problem.effects[0]
    behind = len(problem.start_values) - len(first)
    values = [state.values[: len(first.determined)], np.zeros(first.random)]
    return State(state.edges, np.concatenate([*values, state.values[len(state.values) - behind :]]))


def _problem(solved: Solved, looked: Observed, views: Sequence[ViewPoses]) -> Problem:
    """The problem of a cell's rows, with the unknowns of the fit."""
    fitted = solved.agreed.problem
    problem = replace(problem_of(solved.cell, views), tree=fitted.tree, poses=fitted.poses)
    seen, none = problem.observations, np.zeros(len(problem), dtype=bool)
    for move in solved.agreed.moves:
        seen = seen.renamed(move.frame, move.twin, seen.stops >= move.stop)
    late = {effect.name: effect for effect in clock_effects(solved.cell, looked.clocks)}
    effects = [
        late.get(effect.name)
        or replace(effect, by_sensor=None, concerned=None if effect.concerned is None else none)
        for effect in fitted.effects
    ]
    return replace(problem, observations=seen, points=fitted.points).with_effects(effects)
