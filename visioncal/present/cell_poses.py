"""Where the frames of a cell are in each view: its tree of frames, and its robots' states."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.types import Camera, FloatArray, Target
from visioncal.present import result_parts
from visioncal.present.result_parts import FrameHierarchy
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.session import Session, View, frame_name
from visioncal.session.frames import CELL
from visioncal.session.table import reported_matrices


@dataclass(frozen=True, eq=False)
class RobotState:
    """Pose and posture of a robot in a view."""

    pose: FloatArray  # (4, 4) `base_from_flange`.
    q: FloatArray | None  # (n,) joint angles [rad]; None where unknown.
    # Whether the state is that of another view, as it is unknown in this one.
    is_past: bool = False

    def link_frames(self, robot: Robot | None) -> FloatArray | None:
        """(n, 4, 4) link frames in the base; None if the model or the joint angles are unknown."""
        if robot is None or self.q is None or len(self.q) != robot.joint_count:
            return None
        return np.asarray(robot.link_frames(self.q[None])[0])


def states_of(robot: Robot, q: FloatArray) -> dict[int, RobotState]:
    """States by (m, n) joint angles [rad], numbered from 0."""
    poses = robot.base_from_flange(q)
    return {row: RobotState(*state) for row, state in enumerate(zip(poses, q, strict=True))}


def robot_states(
    session: Session, calibration: Calibration | None, evidence: Mapping[int, ViewEvidence]
) -> Mapping[str, Mapping[int, RobotState]]:
    """State of each robot, where known, by flange and view number."""
    if calibration is not None and calibration.cell is not None:
        rows = session.robot_rows
        models = result_parts.calibrated_robots(calibration)
        by_flange: dict[str, Mapping[int, RobotState]] = {}
        for flange, name in result_parts.frames(calibration).robots.items():
            by_view = {view: by_robot[name] for view, by_robot in rows.items() if name in by_robot}
            known = {view: _state(row, models.get(name)) for view, row in by_view.items()}
            # Without a pose at a stop it stands as before, and before its first pose as in that.
            current = next((state for state in known.values() if state is not None), None)
            filled: dict[int, RobotState] = {}
            for view in session.views:
                current = known.get(view.number) or (current and replace(current, is_past=True))
                if current is not None:
                    filled[view.number] = current
            by_flange[flange] = filled
        return by_flange
    # Without a result, the bases of several robots have no known poses.
    views = () if session.is_network else session.views
    poses = reported_matrices(views)
    seen = {view.view: view.base_from_flange for view in evidence.values()}
    poses |= {view: pose for view, pose in seen.items() if pose is not None}
    (flange,) = result_parts.frames(calibration).robots
    robot = None if calibration is None else calibration.calibrated_robot
    states = {
        view.number: RobotState(poses[view.number], view.joints_rad)
        if view.number in poses
        else _state(view, robot)
        for view in views
    }
    return {flange: {view: state for view, state in states.items() if state is not None}}


def _state(row: View, robot: Robot | None) -> RobotState | None:
    """State by the row's pose, or by its joint angles; None without both."""
    pose, q = row.base_from_flange(), row.joints_rad
    if pose is not None:
        return RobotState(np.asarray(pose.as_matrix()), q)
    if q is None or robot is None or len(q) != robot.joint_count:
        return None
    return RobotState(np.asarray(robot.base_from_flange(q[None])[0]), q)


@dataclass(frozen=True, eq=False)
class CellPoses:
    """A cell: its tree of frames, and what hangs on them."""

    frames: FrameHierarchy  # Tree of frames.
    # State of each robot, where known, by flange and view number.
    states: Mapping[str, Mapping[int, RobotState]]
    models: Mapping[str, Robot]  # Models of the robots, where known, by name.
    cameras: Mapping[str, Camera]  # Intrinsics by the camera's frame.
    boards: Mapping[str, Target]  # Targets by frame.
    size_m: float  # Size of the cell, which drawn sizes refer to [m].
    rejected: frozenset[int] = frozenset()  # Views that the fit did not use.
    tools: frozenset[str] = frozenset()  # Frames of tools and fixtures.

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration | None, evidence: Mapping[int, ViewEvidence]
    ) -> Self:
        """The cell of a result, with flange poses from the evidence, or else as recorded."""
        frames = result_parts.frames(calibration)
        states = robot_states(session, calibration, evidence)
        poses = [state.pose for by_view in states.values() for state in by_view.values()]
        distances = [float(np.linalg.norm(pose[:3, 3])) for pose in poses]
        extent_m = float(np.linalg.norm(np.ptp([np.zeros(3), *frames.fixed_m], axis=0)))
        size_m = max(float(np.median(distances)) if distances else 1.0, 0.5 * extent_m)
        if calibration is None:
            return cls(frames, states, {}, {}, {}, size_m)
        cameras = result_parts.cameras(calibration).items()
        stated = result_parts.stated_boards(session).items()
        boards = {frame_name("target", name): target for name, target in stated}
        return cls(
            frames,
            states,
            result_parts.calibrated_robots(calibration),
            {frame or "cam": camera.camera for frame, camera in cameras},
            {frame: target for frame, target in boards.items() if frame in frames.parents},
            size_m,
            frozenset(view.view for view in calibration.views if not view.used),
            frozenset(name.rpartition("_from_")[2] for name in calibration.frames),
        )

    def in_cell(self, frame: str, view: int, *, past: bool = True) -> FloatArray | None:
        """(4, 4) pose of a frame in the cell in a view; None where unknown.

        With `past`, a robot without a pose in this view stands as in another one.
        """
        matrix = np.eye(4)
        while frame != CELL:
            if frame in self.frames.robots:
                state = self.states[frame].get(view)
                edge = None if state is None or (state.is_past and not past) else state.pose
            else:
                edge = self.frames.matrices.get(frame)
            if edge is None:
                return None
            matrix, frame = edge @ matrix, self.frames.parents[frame]
        return matrix

    def unposed(self, view: int) -> list[str]:
        """Robots of a cell without a pose at the stop of a view."""
        states = {robot: self.states[name].get(view) for name, robot in self.frames.robots.items()}
        return [robot for robot, state in states.items() if robot and (not state or state.is_past)]
