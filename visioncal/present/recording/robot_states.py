"""How robots stand in the views of a session, for what is drawn of them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.present import parts
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.session import Session, View
from visioncal.session.observations import standing
from visioncal.session.table import reported_matrices


@dataclass(frozen=True, eq=False)
class RobotState:
    """How a robot stands in a view.

    Attributes:
        pose: (4, 4) `base_from_flange`.
        q: (n,) its joint angles [rad]; None where they are not known.
        is_past: Whether that is how it stood in another view: in this one it is not known.
    """

    pose: FloatArray
    q: FloatArray | None
    is_past: bool = False

    def link_frames(self, robot: Robot | None) -> FloatArray | None:
        """(n, 4, 4) of the robot in its base; None where it or its joints' angles are not known."""
        if robot is None or self.q is None or len(self.q) != robot.joint_count:
            return None
        return robot.link_frames(self.q)


def robot_states(
    session: Session, calibration: Calibration | None, evidence: Mapping[int, ViewEvidence]
) -> Mapping[str, Mapping[int, RobotState]]:
    """By flange and by the view's number, how its robot stands, where that is known."""
    if calibration is not None and calibration.cell is not None:
        return _of_cell(session, calibration)
    # Of several robots, each pose is in a base of its own, which nothing places.
    views = () if session.is_network else session.views
    poses = reported_matrices(views)
    seen = {view.view: view.base_from_flange for view in evidence.values()}
    poses |= {view: pose for view, pose in seen.items() if pose is not None}
    (flange,) = parts.frames(calibration).robots
    robot = None if calibration is None else calibration.calibrated_robot
    states = {
        view.number: RobotState(poses[view.number], view.joints_rad)
        if view.number in poses
        else _state(view, robot)
        for view in views
    }
    return {flange: {view: state for view, state in states.items() if state is not None}}


def _of_cell(session: Session, calibration: Calibration) -> Mapping[str, Mapping[int, RobotState]]:
    """Of a whole cell: as of the view's stop, or else as at the last one with a pose.

    A robot without a pose yet stands as at its first one.
    """
    rows = standing(session.declaration, session.views)
    models = parts.calibrated_robots(calibration)
    found: dict[str, Mapping[int, RobotState]] = {}
    for flange, name in parts.frames(calibration).robots.items():
        by_view = {view: mine[name] for view, mine in rows.items() if name in mine}
        own = {view: _state(row, models.get(name)) for view, row in by_view.items()}
        last = next((robot_state for robot_state in own.values() if robot_state is not None), None)
        shown: dict[int, RobotState] = {}
        for view in session.views:
            last = own.get(view.number) or (last and replace(last, is_past=True))
            if last is not None:
                shown[view.number] = last
        found[flange] = shown
    return found


def _state(row: View, robot: Robot | None) -> RobotState | None:
    """How a robot stands by the row with its pose, or with its joint angles."""
    pose, q = row.base_from_flange(), row.joints_rad
    if pose is not None:
        return RobotState(np.asarray(pose.as_matrix()), q)
    if q is None or robot is None or len(q) != robot.joint_count:
        return None
    return RobotState(np.asarray(robot.base_from_flange(q[None])[0]), q)
