"""What was seen and computed of each view, for people."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.holdout import held_back
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.validate import predict_corners
from visioncal.core.types import Corners, FloatArray
from visioncal.results.evidence import ViewEvidence
from visioncal.session.observations import Observation
from visioncal.vision.targets import first_corners


def view_evidence(known: RunState) -> tuple[ViewEvidence, ...]:
    """Collects what was seen and computed of each view."""
    solved, state = known.fitted, known.solved.state
    held = held_back(solved, known)
    problems = [(solved.cell.rows, solved.poses, solved.agreed.problem)]
    problems += [] if held is None else [(held.rows, held.views, held.problem)]
    found = dict[int, ViewEvidence]()
    for rows, views, problem in problems:
        poses = zip(problem.measured(state), problem.predicted(state), strict=True)
        for row, view, (measured, predicted) in zip(rows, views, poses, strict=True):
            px = None
            if view.corners is not None:
                px = _predicted(known, row.seer, predicted, view.corners)
            found[row.view] = ViewEvidence(row.view, view.corners, px, None, measured)
    stood = {observation.view.number: observation for observation in known.timed.observations}
    return tuple(
        _evidence(known, view.number, found.get(view.number), stood.get(view.number))
        for view in known.session.views
    )


def _evidence(
    known: RunState, view: int, found: ViewEvidence | None, row: Observation | None
) -> ViewEvidence:
    if found is None:
        poses = known.poses.get(view)
        found = ViewEvidence(
            view,
            known.corners.get(view) if poses is None else poses.corners,
            cam_from_target=None if poses is None else poses.cam_from_target[0],
        )
    corners = None if found.corners is None else _own_numbers(known, found.corners)
    return replace(found, corners=corners, base_from_flange=_flange(known, view, row))


def _flange(known: RunState, view: int, row: Observation | None) -> FloatArray | None:
    """(4, 4) where the robot stood: by the calibrated arm where there is one."""
    if row is not None and len(row.robots) == 1:
        arm = known.fitted.arms.get(robot_key(next(iter(row.robots))))
        if arm is not None and arm.stood[row.station]:
            return np.asarray(arm.poses[row.station])
    return known.base_from_flange.get(view)


def _own_numbers(known: RunState, corners: Corners) -> Corners:
    """The corners of a view by their numbers on its own board, again."""
    if len(known.session.boards) < 2 or not len(corners.ids):
        return corners
    starts = first_corners(tuple(known.session.boards.values()))
    return replace(corners, ids=corners.ids - int(starts[starts <= corners.ids[0]][-1]))


def _predicted(
    known: RunState, seer: str, cam_from_target: FloatArray, corners: Corners
) -> FloatArray | None:
    looks = known.fitted.looks
    if looks is None or seer not in looks.problems:
        return None
    positions = looks.points[corners.ids]
    return predict_corners(looks.camera(seer), cam_from_target, positions)
