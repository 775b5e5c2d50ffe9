"""Live drawing of a session while it is recorded."""

from dataclasses import dataclass, field

import rerun as rr

from visioncal.core.transforms import apply
from visioncal.core.types import Camera, FloatArray, Image, Mount, Target
from visioncal.present.coverage import corners_chart
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.arm import log_arm, log_frames, log_pose
from visioncal.present.recording.charts import Charts
from visioncal.present.recording.notes import markdown
from visioncal.present.recording.scene import SMALL_FRUSTUM, frustum, log_image_plane
from visioncal.robot import Robot

# Sizes of axes, lines and points [m].
_AXIS_M, _LINE_M, _POINT_M = 0.08, 0.001, 0.003
# JPEG quality: pictures are for display only, and the arm waits for their transfer.
_JPEG = 80


@dataclass(frozen=True, eq=False)
class LiveCell:
    """Content of a live drawing that is the same for all views."""

    mount: Mount  # Where the camera is.
    target: Target  # The board.
    resolution: tuple[int, int]  # (width, height) of the images [px].
    robot: Robot | None  # Model of the arm; None where unknown.
    camera: Camera | None  # Intrinsics; None where unknown.
    # (4, 4) estimated pose of the camera, on the flange or in the base [m]; None where unknown, and
    # neither camera nor board are drawn.
    x: FloatArray | None
    z: FloatArray | None  # (4, 4) estimated pose of the board, in the base or on the flange [m].


@dataclass(frozen=True, eq=False)
class LiveView:
    """Content of a live drawing for one view."""

    view: int  # Its number.
    image: Image  # (h, w) or (h, w, 3) blue, green, red.
    px: FloatArray  # (n, 2) detected corners [px].
    base_from_flange: FloatArray  # (4, 4) [m].
    q: FloatArray | None  # (n,) joint angles [rad]; None where unknown.
    sigma_mm: float | None  # Sigma predicted from the views so far [mm]; None where undetermined.
    note: str  # Text in Markdown.


@dataclass(eq=False)
class LiveDrawing:
    """Draws a session into a rerun stream while it is recorded."""

    stream: rr.RecordingStream
    cell: LiveCell
    _px: dict[int, FloatArray] = field(default_factory=dict)
    _flange_poses: list[FloatArray] = field(default_factory=list)

    def begin(self) -> None:
        """Draws the static part."""
        stream, cell = self.stream, self.cell
        more: list[tuple[str, str, float]] = []
        if cell.x is not None:
            more = [(paths.CAMERA, paths.CAM_FRAME, 1.0), (paths.TARGET, paths.TARGET_FRAME, 1.0)]
            on_target = rr.CoordinateFrame(paths.TARGET_FRAME)
            stream.log(f"{paths.TARGET}/sheet", on_target, board.sheet(cell.target), static=True)
        log_frames(stream, _AXIS_M, more)
        if cell.camera is not None:
            log_image_plane(stream, cell.camera, 1.0)

    def draw(self, view: LiveView) -> None:
        """Draws a view, and the charts of all views so far."""
        stream = self.stream
        stream.set_time(paths.TIMELINE, sequence=view.view)
        in_image = rr.CoordinateFrame(paths.IMAGE_FRAME)
        model = rr.ColorModel.L if view.image.ndim == 2 else rr.ColorModel.BGR
        picture = rr.Image(view.image, color_model=model).compress(jpeg_quality=_JPEG)
        stream.log(paths.IMAGE, in_image, picture)
        # Rerun's origin is the image's corner, not the first pixel's centre.
        points = rr.Points2D(view.px + 0.5, colors=colours.DETECTED, radii=rr.Radius.ui_points(2.5))
        stream.log(paths.DETECTED, in_image, points)
        self._draw_cell(view)
        self._px[view.view] = view.px
        chart = corners_chart(self.cell.resolution, self._px)
        charts = Charts((chart,), (), frozenset(self._px))
        charts.log_static(stream)
        charts.log_view(stream, view.view)
        if view.sigma_mm is not None:
            stream.log(paths.LIVE_SIGMA, rr.Scalars(view.sigma_mm))
        stream.log(paths.LIVE_NOTE, markdown(view.note))

    def _draw_cell(self, view: LiveView) -> None:
        cell, stream, flange = self.cell, self.stream, view.base_from_flange
        log_pose(stream, paths.FLANGE, paths.FLANGE_FRAME, flange)
        if cell.robot is not None and view.q is not None:
            log_arm(stream, cell.robot.link_frames(view.q))
        self._flange_poses.append(flange)
        in_base = rr.CoordinateFrame(paths.BASE_FRAME)
        points = rr.Points3D(
            [pose[:3, 3] for pose in self._flange_poses], colors=colours.USED, radii=_POINT_M
        )
        stream.log(f"{paths.STOPS}/{paths.USED}", in_base, points)
        if cell.x is None or cell.z is None:
            return
        if cell.mount == "eye-in-hand":
            base_from_cam, base_from_target, flange_from_carried = flange @ cell.x, cell.z, cell.x
            shapes = [] if cell.camera is None else frustum(cell.camera, SMALL_FRUSTUM)
        else:
            base_from_cam, base_from_target, flange_from_carried = cell.x, flange @ cell.z, cell.z
            shapes = [board.closed_outline(cell.target)]
        log_pose(stream, paths.CAMERA, paths.CAM_FRAME, base_from_cam)
        log_pose(stream, paths.TARGET, paths.TARGET_FRAME, base_from_target)
        strips = [
            apply(pose @ flange_from_carried, shape)
            for pose in self._flange_poses
            for shape in shapes
        ]
        if strips:
            lines = rr.LineStrips3D(strips, colors=colours.USED, radii=_LINE_M)
            stream.log(f"{paths.STOPS}/{paths.USED}/carried", in_base, lines)
