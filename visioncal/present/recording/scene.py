"""A cell in 3D, view by view: robots, cameras and targets on the tree of frames."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.core.number_format import significant
from visioncal.core.transforms import apply
from visioncal.core.types import Camera, FloatArray, Mount, Target
from visioncal.present import result_parts
from visioncal.present.cell_poses import CellPoses, RobotState
from visioncal.present.facts import DEGREE, pairs
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.arm import log_arms, placed
from visioncal.present.recording.recorder import Row, send_rows
from visioncal.present.result_parts import FrameHierarchy
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.frames import frames_of_kind
from visioncal.vision.camera import matrix_3x3
from visioncal.vision.targets import closed_outline

# Sizes as shares of the cell's size, which is the distance of flanges from their bases.
_AXIS, _FRUSTUM, _LINE, _POINT = 0.12, 0.18, 0.002, 0.004
# Lengths of axes relative to the flange's; those of tools and of other frames are shorter.
_AXES = {paths.BASE_FRAME: 2.0, paths.FLANGE_FRAME: 1.0}


@dataclass(frozen=True, eq=False)
class Seen:
    """A camera and a board before there is a result."""

    mount: Mount  # Where the camera is.
    target: Target  # The board.
    camera: Camera  # Its intrinsics.
    x: FloatArray  # (4, 4) estimated pose of the camera, on the flange or in the base [m].
    z: FloatArray  # (4, 4) estimated pose of the board, in the base or on the flange [m].


@dataclass(frozen=True, eq=False)
class Scene(CellPoses):
    """A cell that is drawn."""

    @classmethod
    def planned(
        cls,
        robot: Robot,
        states: Mapping[int, RobotState],
        size_m: float,
        seen: "Seen | None" = None,
    ) -> "Scene":
        """A robot in given states, with what a camera on it or beside it is to see."""
        frames = result_parts.frames(None)
        if seen is not None:
            in_hand = seen.mount == "eye-in-hand"
            parents = {
                paths.CAM_FRAME: "flange" if in_hand else "base",
                paths.TARGET_FRAME: "base" if in_hand else "flange",
            }
            matrices = {paths.CAM_FRAME: seen.x, paths.TARGET_FRAME: seen.z}
            frames = FrameHierarchy(
                {**frames.parents, **parents}, {**frames.matrices, **matrices}, frames.robots
            )
        return cls(
            frames,
            {"flange": states},
            {"": robot},
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
            share = 0.5 if is_tool else _AXES.get(frame.partition("_")[0], 0.7)
            axes = rr.TransformAxes3D(share * _AXIS * self.size_m, show_frame=True)
            stream.log(entity, rr.CoordinateFrame(frame), axes, static=True)
        for flange, name in self.frames.robots.items():
            base = rr.CoordinateFrame(self.frames.parents[flange])
            for part in ("links", "joints", "reach"):
                stream.log(f"{paths.named(paths.ROBOT, name)}/{part}", base, static=True)
            # Lines from the flange to what it carries.
            for child in [name for name, parent in self.frames.parents.items() if parent == flange]:
                line = rr.LineStrips3D(
                    [[np.zeros(3), self.frames.matrices[child][:3, 3]]],
                    colors=colours.JOINT,
                    radii=2 * _LINE * self.size_m,
                )
                entity = f"{paths.entity_of(flange)}/{flange}_from_{child}"
                stream.log(entity, rr.CoordinateFrame(flange), line, static=True)
        for frame, camera in self.cameras.items():
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
                    radii=_POINT * self.size_m,
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
            placed_at = zip(rows.values(), states, strict=True)
            poses = {row: state.pose for row, state in placed_at if state is not None}
            # An unknown pose clears that of the view before.
            for row in (row for row in rows.values() if row not in poses):
                stream.set_time(paths.TIMELINE, sequence=int(row))
                stream.log(paths.entity_of(flange), rr.Clear(recursive=False))
            if poses:
                matrices, count = np.array(list(poses.values())), len(poses)
                columns = rr.Transform3D.columns(
                    translation=matrices[:, :3, 3],
                    mat3x3=matrices[:, :3, :3],
                    parent_frame=[self.frames.parents[flange]] * count,
                    child_frame=[flange] * count,
                )
                send_rows(stream, paths.entity_of(flange), poses, columns, timeline)
            robot, entity = self.models.get(name), paths.named(paths.ROBOT, name)
            arms = [None if state is None else state.link_frames(robot) for state in states]
            log_arms(stream, arms, rows.values(), entity, timeline)
            # A line to the flange of a robot whose posture is unknown.
            lines = [
                [np.array([np.zeros(3), state.pose[:3, 3]])] if state and links is None else []
                for state, links in zip(states, arms, strict=True)
            ]
            style = rr.LineStrips3D.from_fields(colors=colours.JOINT, radii=2 * _LINE * self.size_m)
            stream.log(f"{entity}/reach", style, static=True)
            _send_strips(stream, f"{entity}/reach", rows.values(), lines, timeline)

    def log_network(self, stream: rr.RecordingStream, calibration: Calibration) -> None:
        """Draws a cell's frame, and its network as a graph: frames, sigmas, and who saw whom."""
        axes = rr.TransformAxes3D(2.0 * _AXIS * self.size_m, show_frame=False)
        stream.log(paths.CELL, rr.CoordinateFrame(paths.CELL_FRAME), axes, static=True)
        tree = calibration.tree
        nodes = [paths.CELL_FRAME, *(frame for frame in tree.last if frame != paths.CELL_FRAME)]
        captions = {flange: f"robot {robot}" for flange, robot in tree.flanges.items()}
        captions[paths.CELL_FRAME] = f"the frame of {tree.reference}"
        labels = []
        for node in nodes:
            words = captions.get(node, "the reference")
            if node not in captions and node != tree.reference:
                edge = tree.edge_of(node)
                turned = f", {significant(edge.sigma_deg)}{DEGREE}" if edge.oriented else ""
                words = f"{significant(edge.sigma_mm)} mm{turned}"
            labels.append(f"{node}\n{words}")
        seen = [(pair.seer, pair.seen) for pair in pairs(calibration.views) if pair.used]
        hangs = [(tree.parents[node], node) for node in nodes if node != paths.CELL_FRAME]
        colour = [colours.LINK if node in captions else colours.USED for node in nodes]
        edges = rr.GraphEdges([*hangs, *seen], graph_type="undirected")
        graph = rr.GraphNodes(nodes, labels=labels, colors=colour)
        stream.log(paths.NETWORK, graph, edges, static=True)

    def log_seen_targets(
        self,
        stream: rr.RecordingStream,
        session: Session,
        calibration: Calibration,
        seen: Sequence[ViewEvidence],
    ) -> None:
        """Draws the target's outline as each view alone places it, in the order of the session."""
        # A part without strips clears those of the previous view.
        strips: dict[int, list[FloatArray]] = {}
        boards = session.boards if any(view.cam_from_target is not None for view in seen) else {}
        seers = {view.view: view.seer or paths.CAM_FRAME for view in calibration.views}
        cameras = frames_of_kind(seers.values(), "camera")
        for row, (view, view_seen) in enumerate(zip(session.views, seen, strict=True)):
            if (name := session.board_of(view)) not in boards:
                continue
            strips[row] = []
            if view_seen.cam_from_target is None or seers.get(view_seen.view) not in cameras:
                continue
            cell_from_cam = self.in_cell(seers[view_seen.view], view_seen.view)
            if cell_from_cam is not None:
                pose = cell_from_cam @ view_seen.cam_from_target
                strips[row] = [apply(pose, closed_outline(boards[name]))]
        if not strips:
            return
        frame, entity = rr.CoordinateFrame(paths.CELL_FRAME), paths.SEEN_TARGET
        style = rr.LineStrips3D.from_fields(radii=_LINE * self.size_m)
        stream.log(entity, frame, style, static=True)
        unused = [seen[row].view in self.rejected for row in strips]
        colour = [colours.REJECTED if is_unused else colours.DETECTED for is_unused in unused]
        _send_strips(
            stream, entity, strips, [*strips.values()], more=rr.LineStrips3D.columns(colors=colour)
        )


def _send_strips(
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
