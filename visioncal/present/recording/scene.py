"""The cell in 3D by the calibration, view by view: robots, cameras and targets."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import rerun as rr

from visioncal.core.transforms import apply
from visioncal.core.types import Camera, FloatArray, Target
from visioncal.present import result_parts
from visioncal.present.network_layout import layout, pairs, sigma_words
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.accuracy import ArmPicture, Uncertainty
from visioncal.present.recording.arm import log_arms, placed
from visioncal.present.recording.charts import Charts
from visioncal.present.recording.overlays import image_frames, log_image_frames
from visioncal.present.recording.recorder import send_rows
from visioncal.present.result_parts import target_frames
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.session import Session, View, frame_name
from visioncal.session.frames import frames_of_kind
from visioncal.session.observations import robot_rows_at_stops
from visioncal.session.table import reported_matrices
from visioncal.vision.camera import matrix_3x3

# Sizes as shares of the cell's size, which is the distance of flanges from their bases.
_AXIS, _FRUSTUM, _LINE, _POINT = 0.12, 0.18, 0.002, 0.004
# Lengths of axes relative to the flange's: of other frames, and of tools.
_AXES = {paths.BASE_FRAME: 2.0, paths.FLANGE_FRAME: 1.0}
_OTHER_AXES, _TOOL_AXES = 0.7, 0.5
# Size of the small frusta that mark all views.
SMALL_FRUSTUM = 0.05

# Height of the bodies' names, and the drawing's units [px].
_BODY_HEIGHT, _ACROSS_PX, _DOWN_PX = 3.6, 110.0, 120.0


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
class SceneDrawing:
    """Drawing of the cell, with each frame placed on its parent."""

    session: Session  # The session.
    calibration: Calibration | None  # Result of the session; without it only the flange is drawn.
    frames: result_parts.FrameHierarchy  # Tree of frames.
    # State of each robot, where known, by flange and view number.
    states: Mapping[str, Mapping[int, RobotState]]
    size_m: float  # Size of the cell, which drawn sizes refer to [m].
    uncertainty: Uncertainty | None = None  # Drawing of the result's uncertainty.
    charts: Charts | None = None  # Charts over all views.
    arm: ArmPicture | None = None  # Drawing of a calibrated arm.

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration | None, evidence: Mapping[int, ViewEvidence]
    ) -> "SceneDrawing":
        """Collects flange poses from the evidence, or else as recorded."""
        frames = result_parts.frames(calibration)
        states = robot_states(session, calibration, evidence)
        size_m = _size_m(frames, states)
        if calibration is None:
            return cls(session, None, frames, states, size_m)
        return cls(
            session,
            calibration,
            frames,
            states,
            size_m,
            Uncertainty.of(calibration, evidence, size_m, target_frames(calibration, session)),
            Charts.of(session, calibration, evidence),
            ArmPicture.of(session, calibration, size_m),
        )

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Logs what is the same in all views."""
        tools = () if self.calibration is None else self.calibration.frames
        for frame, parent in self.frames.parents.items():
            entity = paths.entity_of(frame)
            if frame in self.frames.matrices:
                pose = placed(self.frames.matrices[frame], parent, frame)
                stream.log(entity, pose, static=True)
            is_tool = any(tool.endswith(f"_from_{frame}") for tool in tools)
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
            self._log_stops(stream, flange)
        if self.calibration is not None:
            self._log_things(stream, self.calibration)
        for drawn in (self.uncertainty, self.charts, self.arm):
            if drawn is not None:
                drawn.log_static(stream)

    def _log_things(self, stream: rr.RecordingStream, calibration: Calibration) -> None:
        """Draws image planes, boards, and the network of a cell."""
        for frame, camera in result_parts.cameras(calibration).items():
            log_image_plane(stream, camera.camera, self.size_m, frame or paths.CAM_FRAME)
        for frame, target in self._boards.items():
            sheet = board.sheet(target)
            stream.log(
                f"{paths.entity_of(frame)}/sheet", rr.CoordinateFrame(frame), sheet, static=True
            )
        if calibration.cell is not None:
            axes = rr.TransformAxes3D(2.0 * _AXIS * self.size_m, show_frame=False)
            stream.log(paths.CELL, rr.CoordinateFrame(paths.CELL_FRAME), axes, static=True)
            log_network(stream, calibration)

    def log_views(self, stream: rr.RecordingStream, seen: Sequence[ViewEvidence]) -> None:
        """Logs the poses in each view, in the order of the session."""
        for flange in self.frames.robots:
            states = [self.states[flange].get(view.view) for view in seen]
            poses = [None if state is None else state.pose for state in states]
            _log_poses(stream, self.frames.parents[flange], flange, poses)
            self._log_arm(stream, flange, states)
        if self.calibration is None:
            return
        self._log_seen_targets(stream, seen)
        self._log_sights(stream)
        rows = {view.view: row for row, view in enumerate(seen)}
        if self.uncertainty is not None:
            self.uncertainty.log_views(stream, list(rows))
        if self.charts is not None:
            self.charts.log_marks(stream, rows)
        if self.arm is not None:
            self.arm.log_views(stream, rows)

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
        if self.calibration is None or self.calibration.cell is None:
            return []
        states = {robot: self.states[name].get(view) for name, robot in self.frames.robots.items()}
        return [robot for robot, state in states.items() if state is None or state.is_past]

    @cached_property
    def _boards(self) -> Mapping[str, Target]:
        """Targets by frame, where the calibration places them."""
        named = result_parts.stated_boards(self.session).items()
        frames = {frame_name("target", name): target for name, target in named}
        return {frame: target for frame, target in frames.items() if frame in self.frames.parents}

    @cached_property
    def _rejected(self) -> frozenset[int]:
        views = () if self.calibration is None else self.calibration.views
        return frozenset(view.view for view in views if not view.used)

    def _radius(self, share: float) -> float:
        return share * self.size_m

    def _carried_by(self, flange: str) -> list[str]:
        return [name for name, parent in self.frames.parents.items() if parent == flange]

    def _log_stops(self, stream: rr.RecordingStream, flange: str) -> None:
        """All positions of a flange; those of unused views in another colour."""
        stops = paths.part_of(paths.STOPS, self.frames.robots[flange])
        frame = rr.CoordinateFrame(self.frames.parents[flange])
        for name, colour in ((paths.USED, colours.USED), (paths.REJECTED, colours.REJECTED)):
            poses = [
                state.pose
                for view, state in self.states[flange].items()
                if not state.is_past and (view in self._rejected) is (name == paths.REJECTED)
            ]
            if not poses:
                continue
            points = rr.Points3D(
                [pose[:3, 3] for pose in poses], colors=colour, radii=self._radius(_POINT)
            )
            stream.log(f"{stops}/{name}", frame, points, static=True)
            shapes = self._shapes_on(flange)
            strips = [apply(pose, shape) for pose in poses for shape in shapes]
            if strips:
                lines = rr.LineStrips3D(strips, colors=colour, radii=self._radius(0.3 * _LINE))
                stream.log(f"{stops}/{name}/carried", frame, lines, static=True)

    def _shapes_on(self, flange: str) -> list[FloatArray]:
        """What a single robot's flange carries, as (k, 3) lines in its frame."""
        # The shapes of several robots would hide each other.
        if self.calibration is None or self.calibration.cell is not None:
            return []
        cameras = result_parts.cameras(self.calibration)
        shapes = {
            frame or paths.CAM_FRAME: frustum(camera.camera, SMALL_FRUSTUM * self.size_m)
            for frame, camera in cameras.items()
        }
        shapes |= {frame: [board.closed_outline(target)] for frame, target in self._boards.items()}
        return [
            apply(matrix, shape)
            for child in self._carried_by(flange)
            for matrix in [self.frames.matrices[child]]
            for shape in shapes.get(child, ())
        ]

    def _log_arm(
        self, stream: rr.RecordingStream, flange: str, states: Sequence[RobotState | None]
    ) -> None:
        """Draws a robot, or a line to its flange if its posture is unknown."""
        name = self.frames.robots[flange]
        models = (
            {} if self.calibration is None else result_parts.calibrated_robots(self.calibration)
        )
        robot, entity = models.get(name), paths.named(paths.ROBOT, name)
        arms = [None if state is None else state.link_frames(robot) for state in states]
        strips = [
            [np.array([np.zeros(3), state.pose[:3, 3]])] if state and links is None else []
            for state, links in zip(states, arms, strict=True)
        ]
        log_arms(stream, arms, entity)
        style = rr.LineStrips3D.from_fields(colors=colours.JOINT, radii=self._radius(2 * _LINE))
        stream.log(f"{entity}/reach", style, static=True)
        _send_strips(stream, f"{entity}/reach", dict(enumerate(strips)))

    def _log_seen_targets(self, stream: rr.RecordingStream, seen: Sequence[ViewEvidence]) -> None:
        """Draws the target's outline as each view alone places it."""
        # A part without strips clears those of the previous view.
        strips: dict[int, list[FloatArray]] = {}
        boards = (
            self.session.boards if any(view.cam_from_target is not None for view in seen) else {}
        )
        outlines = {name: board.closed_outline(target) for name, target in boards.items()}
        views = () if self.calibration is None else self.calibration.views
        seers = {view.view: view.seer or paths.CAM_FRAME for view in views}
        cameras = frames_of_kind(seers.values(), "camera")
        for row, (view, view_seen) in enumerate(zip(self.session.views, seen, strict=True)):
            if (name := self.session.board_of(view)) not in boards:
                continue
            strips[row] = []
            if view_seen.cam_from_target is None or seers.get(view_seen.view) not in cameras:
                continue
            cell_from_cam = self.in_cell(seers[view_seen.view], view_seen.view)
            if cell_from_cam is not None:
                pose = cell_from_cam @ view_seen.cam_from_target
                strips[row] = [outlines[name] @ pose[:3, :3].T + pose[:3, 3]]
        rejected = {row: seen[row].view in self._rejected for row in strips}
        self._send_lines(stream, paths.SEEN_TARGET, strips, rejected, _LINE)

    def _log_sights(self, stream: rr.RecordingStream) -> None:
        """Draws a line from seer to seen in each view of a cell."""
        if self.calibration is None or self.calibration.cell is None:
            return
        sights = {view.view: view for view in self.calibration.views}
        strips: dict[int, list[FloatArray]] = {}
        rejected: dict[int, bool] = {}
        for row, view in enumerate(self.session.views):
            sight, strips[row] = sights.get(view.number), []
            rejected[row] = sight is None or not sight.used
            if sight is None:
                continue
            ends = [self.in_cell(name, view.number) for name in (sight.seer, sight.seen)]
            if ends[0] is not None and ends[1] is not None:
                target = self._boards.get(sight.seen)
                middle = np.zeros(3) if target is None else board.outline(target).mean(axis=0)
                strips[row] = [np.array([ends[0][:3, 3], apply(ends[1], middle[None])[0]])]
        self._send_lines(stream, paths.SIGHT_LINE, strips, rejected, 2.0 * _LINE)
        log_image_frames(stream, paths.IMAGE, image_frames(self.session, self.calibration))

    def _send_lines(
        self,
        stream: rr.RecordingStream,
        entity: str,
        strips: Mapping[int, Sequence[FloatArray]],
        rejected: Mapping[int, bool],
        width: float,
    ) -> None:
        """Draws lines in the cell by row, coloured by whether the view was used."""
        if not strips:
            return
        frame = rr.CoordinateFrame(paths.CELL_FRAME)
        style = rr.LineStrips3D.from_fields(radii=self._radius(width))
        stream.log(entity, frame, style, static=True)
        colour = [colours.REJECTED if rejected[strip] else colours.DETECTED for strip in strips]
        _send_strips(stream, entity, strips, rr.LineStrips3D.columns(colors=colour))


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


def log_image_plane(
    stream: rr.RecordingStream, camera: Camera, size_m: float, frame: str = paths.CAM_FRAME
) -> None:
    """Places the image in a camera's frame, scaled to a cell's size [m]."""
    image = paths.image_frame(frame)
    matrix = matrix_3x3(camera)
    # Rerun's origin is the image's corner, not the first pixel's centre.
    matrix[:2, 2] += 0.5
    plane = rr.Pinhole(
        image_from_camera=matrix,
        resolution=camera.resolution,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_FRUSTUM * size_m,
        parent_frame=frame,
        child_frame=image,
    )
    entity = f"{paths.entity_of(frame)}/image"
    stream.log(entity, rr.CoordinateFrame(image), plane, static=True)


def frustum(camera: Camera, depth_m: float) -> list[FloatArray]:
    """Edges of a camera's field of view to a depth [m], as lines in its frame."""
    width, height = camera.resolution
    fx, fy, cx, cy = camera.matrix
    corners_px = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]]) - 0.5
    plane = (corners_px - [cx, cy]) / [fx, fy]
    rim = depth_m * np.column_stack([plane, np.ones(5)])
    return [rim, *(np.stack([np.zeros(3), corner]) for corner in rim[:4])]


def _log_poses(
    stream: rr.RecordingStream, parent: str, frame: str, poses: Sequence[FloatArray | None]
) -> None:
    """Places a frame on its parent in each view; an unknown pose clears that of the view before."""
    entity = paths.entity_of(frame)
    known = {row: pose for row, pose in enumerate(poses) if pose is not None}
    for row in (index for index in range(len(poses)) if index not in known):
        stream.set_time(paths.TIMELINE, sequence=row)
        stream.log(entity, rr.Clear(recursive=False))
    if known:
        matrices, count = np.array(list(known.values())), len(known)
        columns = rr.Transform3D.columns(
            translation=matrices[:, :3, 3],
            mat3x3=matrices[:, :3, :3],
            parent_frame=[parent] * count,
            child_frame=[frame] * count,
        )
        send_rows(stream, entity, known, columns)


def _send_strips(
    stream: rr.RecordingStream,
    entity: str,
    strips: Mapping[int, Sequence[FloatArray]],
    more: Iterable[rr.ComponentColumn] = (),
) -> None:
    """Draws lines by row; an empty list clears those of the previous view."""
    lines = rr.LineStrips3D.columns(
        strips=[array for lines_of_view in strips.values() for array in lines_of_view]
    )
    parts = lines.partition([len(strip) for strip in strips.values()])
    send_rows(stream, entity, strips, [*parts, *more])


def log_network(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Draws the network as a graph: frames with their sigmas, and who saw whom."""
    tree = calibration.tree
    spans, places = layout(tree)
    nodes = {body: (0.5 * sum(span), _BODY_HEIGHT) for body, span in spans.items()} | places
    captions = {flange: f"robot {robot}" for flange, robot in tree.flanges.items()}
    captions[paths.CELL_FRAME] = f"the frame of {tree.reference}"
    labels = [f"{node}\n{captions.get(node) or sigma_words(tree, node)}" for node in nodes]
    bodies = {paths.CELL_FRAME, *tree.flanges}
    seen = [(pair.seer, pair.seen) for pair in pairs(calibration.views) if pair.used]
    hangs = [(tree.parents[node], node) for node in nodes if node != paths.CELL_FRAME]
    stream.log(
        paths.NETWORK,
        rr.GraphNodes(
            list(nodes),
            positions=[(_ACROSS_PX * x, -_DOWN_PX * y) for x, y in nodes.values()],
            labels=labels,
            colors=[colours.LINK if node in bodies else colours.USED for node in nodes],
        ),
        rr.GraphEdges([*hangs, *seen], graph_type="undirected"),
        static=True,
    )
