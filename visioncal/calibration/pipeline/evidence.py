"""The evidence of each view: its corners, predictions and poses."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.assessment import held_back
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.validate import predict_corners
from visioncal.core.types import Corners, FloatArray
from visioncal.results.evidence import ViewEvidence
from visioncal.session.observations import Observation
from visioncal.vision.targets import first_corners


def view_evidence(state: RunState) -> tuple[ViewEvidence, ...]:
    """Collects the evidence of each view: corners, predictions, poses."""
    cell_fit, fit_state = state.cell_fit, state.assessment.state
    held, parameters = held_back(cell_fit, state), cell_fit.camera_parameters
    problems = [(cell_fit.cell.rows, cell_fit.poses, cell_fit.inlier_fit.problem)]
    problems += [] if held is None else [(held.rows, held.views, held.problem)]
    evidence = dict[int, ViewEvidence]()
    for cell_rows, views, problem in problems:
        poses = zip(problem.measured(fit_state), problem.predicted(fit_state), strict=True)
        for row, view, (measured, predicted) in zip(cell_rows, views, poses, strict=True):
            corners, px = view.corners, None
            if corners is not None and parameters is not None and row.seer in parameters.problems:
                camera = parameters.camera(row.seer)
                px = predict_corners(camera, predicted, parameters.points[corners.ids])
            evidence[row.view] = ViewEvidence(row.view, view.corners, px, None, measured)
    rows = {observation.view.number: observation for observation in state.timed.observations}
    return tuple(
        _evidence(state, view.number, evidence.get(view.number), rows.get(view.number))
        for view in state.session.views
    )


def _evidence(
    state: RunState, view: int, evidence: ViewEvidence | None, observation: Observation | None
) -> ViewEvidence:
    if evidence is None:
        poses = state.poses.get(view)
        evidence = ViewEvidence(
            view,
            state.corners.get(view) if poses is None else poses.corners,
            cam_from_target=None if poses is None else poses.cam_from_target[0],
        )
    corners = None if evidence.corners is None else _board_numbers(state, evidence.corners)
    return replace(evidence, corners=corners, base_from_flange=_flange(state, view, observation))


def _flange(state: RunState, view: int, observation: Observation | None) -> FloatArray | None:
    """(4, 4) `base_from_flange` of a view, by the calibrated arm where there is one."""
    if observation is not None and len(observation.robots) == 1:
        arm = state.cell_fit.arms.get(robot_key(next(iter(observation.robots))))
        if arm is not None and arm.has_pose[observation.station]:
            return np.asarray(arm.poses[observation.station])
    return state.base_from_flange.get(view)


def _board_numbers(state: RunState, corners: Corners) -> Corners:
    """Renumbers a view's corners from the first of its own board."""
    if len(state.session.boards) < 2 or not len(corners.ids):
        return corners
    starts = first_corners(tuple(state.session.boards.values()))
    return replace(corners, ids=corners.ids - int(starts[starts <= corners.ids[0]][-1]))
