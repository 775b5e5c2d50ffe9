"""The cell in 3D: robot, camera and target, as the calibration puts them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import rerun as rr

from visioncal.core.types import Camera, FloatArray, Target
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.arm import log_arms, log_frames, placed
from visioncal.present.recording.charts import Charts
from visioncal.present.recording.recorder import send_rows
from visioncal.present.recording.uncertainty import Uncertainty
from visioncal.present.recording.workspace import ArmPicture
from visioncal.present.target_frames import target_frames
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.table import reported_matrices
from visioncal.vision.camera import matrix_3x3

# Sizes of what is drawn, as shares of the cell's size: how far the flange is from the base.
_AXIS, _FRUSTUM, _LINE, _POINT = 0.12, 0.18, 0.002, 0.004
# The views that are not the current one, drawn as small frusta or boards.
SMALL_FRUSTUM = 0.05


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn of the cell. All poses are logged in the base frame.

    Attributes:
        session: The session.
        calibration: Its result, if there is one; without it only the flange is drawn.
        base_from_flange: (4, 4) by the view's number, where known.
        size_m: Typical distance of the flange from the base [m].
        uncertainty: What is drawn of the result's uncertainty.
        charts: The charts over all views.
        arm: What is drawn of a calibrated arm.
    """

    session: Session
    calibration: Calibration | None
    base_from_flange: Mapping[int, FloatArray]
    size_m: float
    uncertainty: Uncertainty | None
    charts: Charts | None
    arm: ArmPicture | None

    @classmethod
    def of(
        cls,
        session: Session,
        calibration: Calibration | None,
        evidence: Mapping[int, ViewEvidence],
    ) -> "Scene":
        """Collects the poses of the flange, from the evidence or else as they were recorded."""
        # Of several robots, each pose is in a base of its own, which nothing places.
        reported = {} if session.is_network else reported_matrices(session.views)
        poses: dict[int, FloatArray] = {}
        for number in (it.number for it in session.views):
            seen = evidence.get(number)
            if seen is not None and seen.base_from_flange is not None:
                poses[number] = seen.base_from_flange
            elif number in reported:
                poses[number] = reported[number]
        distances = [float(np.linalg.norm(pose[:3, 3])) for pose in poses.values()]
        size_m = float(np.median(distances)) if distances else 1.0
        if calibration is None:
            return cls(session, None, poses, size_m, None, None, None)
        return cls(
            session,
            calibration,
            poses,
            size_m,
            Uncertainty.of(calibration, evidence, size_m, target_frames(calibration, session)),
            Charts.of(session, calibration, evidence),
            ArmPicture.of(session, calibration, size_m),
        )

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Logs what does not change from view to view."""
        # The edge to the cell keeps the base known in views that know no other frame.
        log_frames(stream, _AXIS * self.size_m)
        in_base = rr.CoordinateFrame(paths.BASE_FRAME)
        stream.log(f"{paths.ROBOT}/reach", in_base, static=True)
        if self.calibration is None:
            self._log_stops(stream)
            return
        for end in self._ends:
            self._log_axes(stream, paths.entity_of(end), end, 0.7)
        if self.calibration.camera is not None:
            log_image_plane(stream, self.calibration.camera.camera, self.size_m)
        for end, target in self._boards.items():
            frame, sheet = rr.CoordinateFrame(end), board.sheet(target)
            stream.log(f"{paths.entity_of(end)}/sheet", frame, sheet, static=True)
        self._log_mount(stream)
        self._log_frames(stream, self.calibration)
        self._log_stops(stream)
        if self.uncertainty is not None:
            self.uncertainty.log_static(stream)
        if self.charts is not None:
            self.charts.log_static(stream)
        if self.arm is not None:
            self.arm.log_static(stream)

    def log_views(self, stream: rr.RecordingStream, seen: Sequence[ViewEvidence]) -> None:
        """Logs where everything is in each view.

        Args:
            stream: Where to.
            seen: What was seen in each, in the order of the session.
        """
        flanges = [self.base_from_flange.get(it.view) for it in seen]
        _log_poses(stream, paths.FLANGE, paths.FLANGE_FRAME, flanges)
        self._log_arms(stream)
        if self.calibration is None:
            return
        for end in self._ends:
            poses = [self._base_from(end, it) for it in flanges]
            _log_poses(stream, paths.entity_of(end), end, poses)
        self._log_seen_targets(stream, flanges, seen)
        rows = {it.view: row for row, it in enumerate(seen)}
        if self.uncertainty is not None:
            self.uncertainty.log_views(stream, list(rows))
        if self.charts is not None:
            self.charts.log_marks(stream, rows)
        if self.arm is not None:
            self.arm.log_views(stream, rows)

    @property
    def _ends(self) -> list[str]:
        """The frames that the calibration places: camera and targets, or instrument and probe."""
        edges = {} if self.calibration is None else self.calibration.edges
        return [name.rpartition("_from_")[2] for name in edges]

    @property
    def _boards(self) -> dict[str, Target]:
        """The targets by their frames, as far as the calibration places them."""
        boards = self.session.boards.items()
        frames = {f"target_{name}" if name else paths.TARGET_FRAME: it for name, it in boards}
        return {frame: it for frame, it in frames.items() if frame in self._ends}

    @cached_property
    def _edges(self) -> Mapping[str, FloatArray]:
        """(4, 4) by name, exactly orthonormal."""
        edges = {} if self.calibration is None else self.calibration.transforms
        return {name: edge.as_matrix() for name, edge in edges.items()}

    @cached_property
    def _outlines(self) -> Mapping[str, FloatArray]:
        """(k, 3) of each board."""
        return {name: board.closed_outline(it) for name, it in self.session.boards.items()}

    @cached_property
    def _rejected(self) -> frozenset[int]:
        views = () if self.calibration is None else self.calibration.views
        return frozenset(view.view for view in views if not view.used)

    def _base_from(self, end: str, base_from_flange: FloatArray | None) -> FloatArray | None:
        """Where the calibration puts `cam` or `target` in one view; None where it is unknown."""
        if f"base_from_{end}" in self._edges:
            return self._edges[f"base_from_{end}"]
        if base_from_flange is not None and f"flange_from_{end}" in self._edges:
            return np.asarray(base_from_flange @ self._edges[f"flange_from_{end}"])
        return None

    def _radius(self, share: float) -> float:
        return share * self.size_m

    def _log_axes(self, stream: rr.RecordingStream, entity: str, frame: str, times: float) -> None:
        """Draws a frame's axes with its name."""
        axes = rr.TransformAxes3D(times * _AXIS * self.size_m, show_frame=True)
        stream.log(entity, rr.CoordinateFrame(frame), axes, static=True)

    def _log_frames(self, stream: rr.RecordingStream, calibration: Calibration) -> None:
        """Draws tools, which the flange takes along, and fixtures, which stand in the base."""
        for name, frame in calibration.frames.items():
            parent, _, child = name.partition("_from_")
            pose = placed(frame.edge.matrix, parent, child)
            stream.log(paths.entity_of(child), pose, static=True)
            self._log_axes(stream, paths.entity_of(child), child, 0.5)

    def _log_mount(self, stream: rr.RecordingStream) -> None:
        """Draws the edges that hang on the flange, as lines."""
        for name, edge in self._edges.items():
            if name.startswith("flange_from_"):
                line = rr.LineStrips3D(
                    [[np.zeros(3), edge[:3, 3]]],
                    colors=colours.JOINT,
                    radii=self._radius(2 * _LINE),
                )
                frame = rr.CoordinateFrame(paths.FLANGE_FRAME)
                stream.log(f"{paths.FLANGE}/{name}", frame, line, static=True)

    def _log_stops(self, stream: rr.RecordingStream) -> None:
        """All places of the flange; those of views that were not used in another colour."""
        for name, colour in ((paths.USED, colours.USED), (paths.REJECTED, colours.REJECTED)):
            poses = [
                pose
                for view, pose in self.base_from_flange.items()
                if (view in self._rejected) is (name == paths.REJECTED)
            ]
            if not poses:
                continue
            frame = rr.CoordinateFrame(paths.BASE_FRAME)
            points = rr.Points3D(
                [pose[:3, 3] for pose in poses], colors=colour, radii=self._radius(_POINT)
            )
            stream.log(f"{paths.STOPS}/{name}", frame, points, static=True)
            strips = [strip for pose in poses for strip in self._carried(pose)]
            if strips:
                lines = rr.LineStrips3D(strips, colors=colour, radii=self._radius(0.3 * _LINE))
                stream.log(f"{paths.STOPS}/{name}/carried", frame, lines, static=True)

    @cached_property
    def _shapes(self) -> Sequence[tuple[str, FloatArray]]:
        """What the flange carries, camera or boards, as (k, 3) lines in their frames."""
        if self.calibration is None:
            return []
        if self.calibration.mount == "eye-in-hand":
            camera = self.calibration.camera
            rim = [] if camera is None else frustum(camera.camera, SMALL_FRUSTUM * self.size_m)
            return [("cam", it) for it in rim]
        return [(end, board.closed_outline(it)) for end, it in self._boards.items()]

    def _carried(self, base_from_flange: FloatArray) -> list[FloatArray]:
        """The same at one stop, in the base."""
        return [
            shape @ base_from_end[:3, :3].T + base_from_end[:3, 3]
            for end, shape in self._shapes
            if (base_from_end := self._base_from(end, base_from_flange)) is not None
        ]

    def _log_arms(self, stream: rr.RecordingStream) -> None:
        """Draws the robot, or only a line to its flange where its joints are not known."""
        robot = None if self.calibration is None else self.calibration.calibrated_robot
        arms: list[FloatArray | None] = []
        strips: list[list[FloatArray]] = []
        for view in self.session.views:
            arm, line, q = None, [], view.joints_rad
            base_from_flange = self.base_from_flange.get(view.number)
            if robot is not None and q is not None and len(q) == robot.joint_count:
                arm = robot.link_frames(q)
            elif base_from_flange is not None:
                line = [np.array([np.zeros(3), base_from_flange[:3, 3]])]
            arms.append(arm)
            strips.append(line)
        log_arms(stream, arms)
        reach = f"{paths.ROBOT}/reach"
        style = rr.LineStrips3D.from_fields(colors=colours.JOINT, radii=self._radius(2 * _LINE))
        stream.log(reach, style, static=True)
        _send_strips(stream, reach, dict(enumerate(strips)))

    def _log_seen_targets(
        self,
        stream: rr.RecordingStream,
        flanges: Sequence[FloatArray | None],
        seen: Sequence[ViewEvidence],
    ) -> None:
        """Draws the target's outline where each view alone sees it."""
        # A part without strips takes those of the view before off the screen.
        strips: dict[int, list[FloatArray]] = {}
        for row, (view, flange, it) in enumerate(
            zip(self.session.views, flanges, seen, strict=True)
        ):
            if (name := self.session.board_of(view)) not in self.session.boards:
                continue
            strips[row], base_from_cam = [], self._base_from("cam", flange)
            if it.cam_from_target is not None and base_from_cam is not None:
                base_from_target = base_from_cam @ it.cam_from_target
                corners = self._outlines[name]
                strips[row] = [corners @ base_from_target[:3, :3].T + base_from_target[:3, 3]]
        if not strips:
            return
        frame, width = rr.CoordinateFrame(paths.BASE_FRAME), self._radius(_LINE)
        style = rr.LineStrips3D.from_fields(radii=width)
        stream.log(paths.SEEN_TARGET, frame, style, static=True)
        rejected = [seen[row].view in self._rejected for row in strips]
        colour = [colours.REJECTED if it else colours.DETECTED for it in rejected]
        _send_strips(stream, paths.SEEN_TARGET, strips, rr.LineStrips3D.columns(colors=colour))


def log_image_plane(stream: rr.RecordingStream, camera: Camera, size_m: float) -> None:
    """Hangs the image into the camera's frame, as large as a cell of some size [m] asks for."""
    plane = image_plane(camera, size_m, (paths.CAM_FRAME, paths.IMAGE_FRAME))
    stream.log(paths.IMAGE, rr.CoordinateFrame(paths.IMAGE_FRAME), plane, static=True)


def image_plane(camera: Camera, size_m: float, frames: tuple[str, str]) -> rr.Pinhole:
    """How an image hangs in a camera's frame.

    Args:
        camera: The lens.
        size_m: Of the cell [m].
        frames: Of the camera, and of its image.
    """
    matrix = matrix_3x3(camera)
    # Rerun puts the image's corner, not the first pixel's centre, at the origin.
    matrix[:2, 2] += 0.5
    return rr.Pinhole(
        image_from_camera=matrix,
        resolution=camera.resolution,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_FRUSTUM * size_m,
        parent_frame=frames[0],
        child_frame=frames[1],
    )


def frustum(camera: Camera, depth_m: float) -> list[FloatArray]:
    """The edges of a camera's field of view down to a depth [m], as lines in its frame."""
    width, height = camera.resolution
    fx, fy, cx, cy = camera.matrix
    corners_px = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]]) - 0.5
    plane = (corners_px - [cx, cy]) / [fx, fy]
    rim = depth_m * np.column_stack([plane, np.ones(5)])
    return [rim, *(np.stack([np.zeros(3), corner]) for corner in rim[:4])]


def log_pose(
    stream: rr.RecordingStream, entity: str, frame: str, base_from_frame: FloatArray | None
) -> None:
    """Places a frame; an unknown one must not keep the place of the view before."""
    if base_from_frame is None:
        stream.log(entity, rr.Clear(recursive=False))
        return
    stream.log(entity, placed(base_from_frame, paths.BASE_FRAME, frame))


def _log_poses(
    stream: rr.RecordingStream, entity: str, frame: str, poses: Sequence[FloatArray | None]
) -> None:
    """Places a frame in each view of a session, as `log_pose` in one."""
    known = {row: pose for row, pose in enumerate(poses) if pose is not None}
    for row in (it for it in range(len(poses)) if it not in known):
        stream.set_time(paths.TIMELINE, sequence=row)
        log_pose(stream, entity, frame, None)
    if known:
        matrices, count = np.array(list(known.values())), len(known)
        columns = rr.Transform3D.columns(
            translation=matrices[:, :3, 3],
            mat3x3=matrices[:, :3, :3],
            parent_frame=[paths.BASE_FRAME] * count,
            child_frame=[frame] * count,
        )
        send_rows(stream, entity, known, columns)


def _send_strips(
    stream: rr.RecordingStream,
    entity: str,
    strips: Mapping[int, Sequence[FloatArray]],
    more: Iterable[rr.ComponentColumn] = (),
) -> None:
    """Draws lines in views, by their places; no line takes those of the view before off."""
    lines = rr.LineStrips3D.columns(strips=[it for some in strips.values() for it in some])
    parts = lines.partition([len(it) for it in strips.values()])
    send_rows(stream, entity, strips, [*parts, *more])
