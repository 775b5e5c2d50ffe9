"""A cell in 3D, view by view: robots, cameras and targets on the tree of frames."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from visioncal.core.types import Camera, FloatArray, Mount, Target
from visioncal.present import result_parts
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.arm import log_arms, placed
from visioncal.present.recording.recorder import Row, send_rows
from visioncal.present.result_parts import FrameHierarchy
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.session import Session, View, frame_name
from visioncal.session.observations import robot_rows_at_stops
from visioncal.session.table import reported_matrices
from visioncal.vision.camera import matrix_3x3

# Sizes as shares of the cell's size, which is the distance of flanges from their bases.
_AXIS, _FRUSTUM, _LINE, _POINT = 0.12, 0.18, 0.002, 0.004
# Lengths of axes relative to the flange's: of other frames, and of tools.
_AXES = {paths.BASE_FRAME: 2.0, paths.FLANGE_FRAME: 1.0}
_OTHER_AXES, _TOOL_AXES = 0.7, 0.5


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
        return robot.link_frames(self.q)


def states_of(robot: Robot, q: FloatArray) -> dict[int, RobotState]:
    """States by (m, n) joint angles [rad], numbered from 0."""
    poses = robot.base_from_flange(q)
    return {row: RobotState(*state) for row, state in enumerate(zip(poses, q, strict=True))}


def robot_states(
    session: Session, calibration: Calibration | None, evidence: Mapping[int, ViewEvidence]
) -> Mapping[str, Mapping[int, RobotState]]:
    """State of each robot, where known, by flange and view number."""
    if calibration is not None and calibration.cell is not None:
        return _cell_states(session, calibration)
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


def _cell_states(
    session: Session, calibration: Calibration
) -> Mapping[str, Mapping[int, RobotState]]:
    """States in a cell: at the view's stop, or else at the last stop with a pose.

    A robot without a pose so far has its first one.
    """
    rows = robot_rows_at_stops(session.declaration, session.views)
    models = result_parts.calibrated_robots(calibration)
    states: dict[str, Mapping[int, RobotState]] = {}
    for flange, name in result_parts.frames(calibration).robots.items():
        by_view = {view: by_robot[name] for view, by_robot in rows.items() if name in by_robot}
        known = {view: _state(row, models.get(name)) for view, row in by_view.items()}
        current = next((state for state in known.values() if state is not None), None)
        filled: dict[int, RobotState] = {}
        for view in session.views:
            current = known.get(view.number) or (current and replace(current, is_past=True))
            if current is not None:
                filled[view.number] = current
        states[flange] = filled
    return states


def _state(row: View, robot: Robot | None) -> RobotState | None:
    """State by the row's pose, or by its joint angles; None without both."""
    pose, q = row.base_from_flange(), row.joints_rad
    if pose is not None:
        return RobotState(np.asarray(pose.as_matrix()), q)
    if q is None or robot is None or len(q) != robot.joint_count:
        return None
    return RobotState(np.asarray(robot.base_from_flange(q[None])[0]), q)


@dataclass(frozen=True, eq=False)
class Seen:
    """A camera and a board before there is a result."""

    mount: Mount  # Where the camera is.
    target: Target  # The board.
    camera: Camera  # Its intrinsics.
    x: FloatArray  # (4, 4) estimated pose of the camera, on the flange or in the base [m].
    z: FloatArray  # (4, 4) estimated pose of the board, in the base or on the flange [m].


@dataclass(frozen=True, eq=False)
class Scene:
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
    ) -> "Scene":
        """The cell of a result, with flange poses from the evidence, or else as recorded."""
        frames = result_parts.frames(calibration)
        states = robot_states(session, calibration, evidence)
        size_m = _size_m(frames, states)
        if calibration is None:
            return cls(frames, states, {}, {}, {}, size_m)
        cameras = result_parts.cameras(calibration).items()
        stated = result_parts.stated_boards(session).items()
        boards = {frame_name("target", name): target for name, target in stated}
        return cls(
            frames,
            states,
            result_parts.calibrated_robots(calibration),
            {frame or paths.CAM_FRAME: camera.camera for frame, camera in cameras},
            {frame: target for frame, target in boards.items() if frame in frames.parents},
            size_m,
            frozenset(view.view for view in calibration.views if not view.used),
            frozenset(name.rpartition("_from_")[2] for name in calibration.frames),
        )

    @classmethod
    def planned(
        cls,
        robot: Robot | None,
        states: Mapping[int, RobotState],
        size_m: float,
        seen: "Seen | None" = None,
    ) -> "Scene":
        """A robot in given states, with what a camera on it or beside it is to see."""
        parents, matrices = {"base": paths.CELL_FRAME, "flange": "base"}, {"base": np.eye(4)}
        if seen is not None:
            in_hand = seen.mount == "eye-in-hand"
            parents |= {
                paths.CAM_FRAME: "flange" if in_hand else "base",
                paths.TARGET_FRAME: "base" if in_hand else "flange",
            }
            matrices |= {paths.CAM_FRAME: seen.x, paths.TARGET_FRAME: seen.z}
        return cls(
            FrameHierarchy(parents, matrices, {"flange": ""}),
            {"flange": states},
            {} if robot is None else {"": robot},
            {} if seen is None else {paths.CAM_FRAME: seen.camera},
            {} if seen is None else {paths.TARGET_FRAME: seen.target},
            size_m,
        )

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws the frames, and what is fixed on them."""
        for frame, parent in self.frames.parents.items():
            entity = paths.entity_of(frame)
            if frame in self.frames.matrices:
                pose = placed(self.frames.matrices[frame], parent, frame)
                stream.log(entity, pose, static=True)
            is_tool = frame in self.tools
            share = _TOOL_AXES if is_tool else _AXES.get(frame.partition("_")[0], _OTHER_AXES)
            axes = rr.TransformAxes3D(share * _AXIS * self.size_m, show_frame=True)
            stream.log(entity, rr.CoordinateFrame(frame), axes, static=True)
        for flange, name in self.frames.robots.items():
            base = rr.CoordinateFrame(self.frames.parents[flange])
            for part in ("links", "joints", "reach"):
                stream.log(f"{paths.named(paths.ROBOT, name)}/{part}", base, static=True)
            # Lines from the flange to what it carries.
            for child in self._carried_by(flange):
                line = rr.LineStrips3D(
                    [[np.zeros(3), self.frames.matrices[child][:3, 3]]],
                    colors=colours.JOINT,
                    radii=self._radius(2 * _LINE),
                )
                entity = f"{paths.entity_of(flange)}/{flange}_from_{child}"
                stream.log(entity, rr.CoordinateFrame(flange), line, static=True)
        for frame, camera in self.cameras.items():
            self._log_image_plane(stream, camera, frame)
        for frame, target in self.boards.items():
            entity = f"{paths.entity_of(frame)}/sheet"
            stream.log(entity, rr.CoordinateFrame(frame), board.sheet(target), static=True)

    def log_stops(self, stream: rr.RecordingStream, *, labelled: bool = False) -> None:
        """Draws all positions of the flanges; those of unused views in another colour."""
        for flange, robot in self.frames.robots.items():
            stops = paths.part_of(paths.STOPS, robot)
            frame = rr.CoordinateFrame(self.frames.parents[flange])
            for name, colour in ((paths.USED, colours.USED), (paths.REJECTED, colours.REJECTED)):
                poses = {
                    view: state.pose
                    for view, state in self.states[flange].items()
                    if not state.is_past and (view in self.rejected) is (name == paths.REJECTED)
                }
                if not poses:
                    continue
                points = rr.Points3D(
                    [pose[:3, 3] for pose in poses.values()],
                    colors=colour,
                    radii=self._radius(_POINT),
                    labels=list(map(str, poses)) if labelled else None,
                    show_labels=labelled or None,
                )
                stream.log(f"{stops}/{name}", frame, points, static=True)

    def log_views(
        self, stream: rr.RecordingStream, rows: Mapping[int, Row], timeline: str = paths.TIMELINE
    ) -> None:
        """Draws the robots in some views, each at its place on a timeline."""
        for flange, name in self.frames.robots.items():
            states = [self.states[flange].get(view) for view in rows]
            poses = [None if state is None else state.pose for state in states]
            _log_poses(
                stream, self.frames.parents[flange], flange, poses, [*rows.values()], timeline
            )
            robot, entity = self.models.get(name), paths.named(paths.ROBOT, name)
            arms = [None if state is None else state.link_frames(robot) for state in states]
            log_arms(stream, arms, rows.values(), entity, timeline)
            # A line to the flange of a robot whose posture is unknown.
            lines = [
                [np.array([np.zeros(3), state.pose[:3, 3]])] if state and links is None else []
                for state, links in zip(states, arms, strict=True)
            ]
            style = rr.LineStrips3D.from_fields(colors=colours.JOINT, radii=self._radius(2 * _LINE))
            stream.log(f"{entity}/reach", style, static=True)
            send_strips(stream, f"{entity}/reach", rows.values(), lines, timeline)

    def log_lines(
        self,
        stream: rr.RecordingStream,
        entity: str,
        strips: Mapping[int, Sequence[FloatArray]],
        rejected: Mapping[int, bool],
        width: float = 1.0,
    ) -> None:
        """Draws lines in the cell by row, coloured by whether the view was used."""
        if not strips:
            return
        frame = rr.CoordinateFrame(paths.CELL_FRAME)
        style = rr.LineStrips3D.from_fields(radii=self._radius(width * _LINE))
        stream.log(entity, frame, style, static=True)
        colour = [colours.REJECTED if rejected[strip] else colours.DETECTED for strip in strips]
        send_strips(
            stream, entity, strips, [*strips.values()], more=rr.LineStrips3D.columns(colors=colour)
        )

    def in_cell(self, frame: str, view: int) -> FloatArray | None:
        """(4, 4) pose of a frame in the cell in a view; None where unknown."""
        matrix = np.eye(4)
        while frame != paths.CELL_FRAME:
            if frame in self.frames.robots:
                state = self.states[frame].get(view)
                edge = None if state is None else state.pose
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

    def _radius(self, share: float) -> float:
        return share * self.size_m

    def _carried_by(self, flange: str) -> list[str]:
        return [name for name, parent in self.frames.parents.items() if parent == flange]

    def _log_image_plane(self, stream: rr.RecordingStream, camera: Camera, frame: str) -> None:
        """Places the image in a camera's frame."""
        image = paths.image_frame(frame)
        matrix = matrix_3x3(camera)
        # Rerun's origin is the image's corner, not the first pixel's centre.
        matrix[:2, 2] += 0.5
        plane = rr.Pinhole(
            image_from_camera=matrix,
            resolution=camera.resolution,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM * self.size_m,
            parent_frame=frame,
            child_frame=image,
        )
        entity = f"{paths.entity_of(frame)}/image"
        stream.log(entity, rr.CoordinateFrame(image), plane, static=True)


def _size_m(
    frames: result_parts.FrameHierarchy, states: Mapping[str, Mapping[int, RobotState]]
) -> float:
    """Distance of flanges from their bases, or half the cell's extent if that is larger."""
    poses = [state.pose for by_view in states.values() for state in by_view.values()]
    distances = [float(np.linalg.norm(pose[:3, 3])) for pose in poses]
    parents = (paths.CELL_FRAME, paths.BASE_FRAME)
    places = [
        matrix[:3, 3]
        for frame, matrix in frames.matrices.items()
        if frames.parents[frame] in parents
    ]
    extent_m = float(np.linalg.norm(np.ptp([np.zeros(3), *places], axis=0)))
    return max(float(np.median(distances)) if distances else 1.0, 0.5 * extent_m)


def _log_poses(
    stream: rr.RecordingStream,
    parent: str,
    frame: str,
    poses: Sequence[FloatArray | None],
    rows: Sequence[Row],
    timeline: str,
) -> None:
    """Places a frame on its parent in each view; an unknown pose clears that of the view before."""
    entity = paths.entity_of(frame)
    known = {row: pose for row, pose in zip(rows, poses, strict=True) if pose is not None}
    for row in (row for row in rows if row not in known):
        stream.set_time(paths.TIMELINE, sequence=int(row))
        stream.log(entity, rr.Clear(recursive=False))
    if known:
        matrices, count = np.array(list(known.values())), len(known)
        columns = rr.Transform3D.columns(
            translation=matrices[:, :3, 3],
            mat3x3=matrices[:, :3, :3],
            parent_frame=[parent] * count,
            child_frame=[frame] * count,
        )
        send_rows(stream, entity, known, columns, timeline)


def send_strips(
    stream: rr.RecordingStream,
    entity: str,
    rows: Iterable[Row],
    strips: Sequence[Sequence[FloatArray]],
    timeline: str = paths.TIMELINE,
    more: Iterable[rr.ComponentColumn] = (),
) -> None:
    """Draws lines by row; an empty list clears those of the previous view."""
    lines = rr.LineStrips3D.columns(strips=[line for in_view in strips for line in in_view])
    parts = lines.partition([len(in_view) for in_view in strips])
    send_rows(stream, entity, rows, [*parts, *more], timeline)
