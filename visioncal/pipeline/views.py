"""What became of each view: its figures for the result, and its evidence for people."""

from dataclasses import replace

import numpy as np

from visioncal.calibration import HELD_BACK, Rms, ViewResult
from visioncal.estimation.chain import scatter
from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem
from visioncal.evidence import ViewEvidence
from visioncal.pipeline.known import Known, rms_of
from visioncal.pipeline.layout import own_numbers
from visioncal.session import View
from visioncal.stages.validate import chain_rms_px, predict_corners
from visioncal.types import Corners, FloatArray

_OF_LENS = "it tells of the camera's lens alone (role = intrinsics)"
_NO_POSE = (
    "no pose of the target: it has neither image nor rows in corners.csv nor cft_ nor meas_ columns"
)


def view_results(known: Known) -> tuple[ViewResult, ...]:
    """Tells of each view of the session, in its order, what became of it."""
    measured = _measurable(known)
    away_m, away_rad, rms_px = _residuals(known, measured)
    at = {view: index for index, view in enumerate(measured)}
    results = []
    for row in known.session.views:
        view = row.number
        result = ViewResult(view, view in known.used, _reason(known, row), _corners(known, view))
        if view in at:
            index = at[view]
            result = replace(
                result,
                rms_px=float(rms_px[index]) if np.isfinite(rms_px[index]) else None,
                residual_mm=float(1e3 * away_m[index]),
                residual_deg=(
                    float(np.rad2deg(away_rad[index])) if np.isfinite(away_rad[index]) else None
                ),
            )
        results.append(result)
    return tuple(results)


def used_rms(known: Known) -> Rms:
    """Residuals of the used views."""
    return rms_of(*_residuals(known, list(known.used)))


def holdout_rms(known: Known) -> Rms | None:
    """Residuals of the views that the session held back; None where there are none."""
    views = [view for view in _measurable(known) if view in known.held_back]
    return rms_of(*_residuals(known, views)) if views else None


def view_evidence(known: Known) -> tuple[ViewEvidence, ...]:
    """Collects what was seen and computed of each view."""
    return tuple(_evidence(known, view.number) for view in known.session.views)


def _measurable(known: Known) -> list[int]:
    """The views whose chain can be closed: used ones, those left out, and those held back."""
    views = {*known.candidates, *known.measurable_held_back}
    return [it.number for it in known.session.views if it.number in views]


def _residuals(known: Known, views: list[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Deviations (m,) [m], [rad] from the used views' mean, and through the chain [px].

    Each view's place of its board is compared with the mean of those that show the same one.
    """
    state, problem = known.solved.state, known.problem(views)
    away_m, away_rad = scatter(problem, known.problem(known.used), state)
    if problem.points:
        away_rad = np.full(len(views), np.nan)
    return away_m, away_rad, chain_px(known, views, problem, state)


def chain_px(known: Known, views: list[int], problem: Problem, state: State) -> FloatArray:
    """Reprojection errors (m,) [px] of some views, those of a problem, through the chain."""
    if known.free is None:
        return np.full(len(views), np.nan)
    cameras = [known.free.after(state.values).camera] * len(views)
    positions = known.free.corners_after(state.values)
    return chain_rms_px(known.seen(views), problem.predicted(state), cameras, positions)


def _reason(known: Known, row: View) -> str:
    view, none = row.number, _OF_LENS if row.is_of_lens else _NO_POSE
    if view in known.used:
        return ""
    if view in known.held_back and view not in known.reasons:
        return HELD_BACK
    return known.reasons.get(view) or known.spared.get(view, none)


def _corners(known: Known, view: int) -> int | None:
    found = known.corners.get(view)
    return None if found is None else len(found.ids)


def _evidence(known: Known, view: int) -> ViewEvidence:
    poses, state = known.poses.get(view), known.solved.state
    corners = known.corners.get(view) if poses is None else poses.corners
    reported = known.base_from_flange.get(view)
    base_from_flange = None if reported is None else known.flange_poses([view])[0]
    predicted = cam_from_target = None
    if poses is not None and len(poses.cam_from_target) > 1:
        # Never chosen from: neither how they move with lens and board nor the corners' numbering
        # is known.
        cam_from_target = poses.cam_from_target[0]
    elif poses is not None and reported is not None and poses.board in known.boards:
        problem = known.problem([view])
        cam_from_target = problem.measured(state)[0]
        if corners is not None:
            predicted = _predicted(known, problem.predicted(state)[0], corners)
    return ViewEvidence(
        view=view,
        corners=None if corners is None else own_numbers(known, corners),
        predicted_px=predicted,
        base_from_flange=base_from_flange,
        cam_from_target=cam_from_target,
    )


def _predicted(known: Known, cam_from_target: FloatArray, corners: Corners) -> FloatArray | None:
    if known.free is None:
        return None
    change = known.solved.state.values
    positions = known.free.corners_after(change)[corners.ids]
    return predict_corners(known.free.after(change).camera, cam_from_target, positions)
