"""Live drawing of a session while it is recorded."""

from dataclasses import dataclass, field

import rerun as rr

from visioncal.core.types import Camera, FloatArray, Image, Mount, Target
from visioncal.present.coverage import corners_chart
from visioncal.present.recording import colours, paths
from visioncal.present.recording.charts import Charts
from visioncal.present.recording.notes import markdown
from visioncal.present.recording.scene import RobotState, Scene, Seen
from visioncal.robot import Robot

# Size of the cell [m], by which axes and points are drawn.
_SIZE_M = 0.7
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
    _states: dict[int, RobotState] = field(default_factory=dict)

    def begin(self) -> None:
        """Draws the static part."""
        self._scene.log_static(self.stream)

    def draw(self, view: LiveView) -> None:
        """Draws a view, and the charts of all views so far."""
        stream, row = self.stream, {view.view: view.view}
        stream.set_time(paths.TIMELINE, sequence=view.view)
        in_image = rr.CoordinateFrame(paths.IMAGE_FRAME)
        model = rr.ColorModel.L if view.image.ndim == 2 else rr.ColorModel.BGR
        picture = rr.Image(view.image, color_model=model).compress(jpeg_quality=_JPEG)
        stream.log(paths.IMAGE, in_image, picture)
        # Rerun's origin is the image's corner, not the first pixel's centre.
        points = rr.Points2D(view.px + 0.5, colors=colours.DETECTED, radii=rr.Radius.ui_points(2.5))
        stream.log(paths.DETECTED, in_image, points)
        self._states[view.view] = RobotState(view.base_from_flange, view.q)
        self._scene.log_stops(stream)
        self._scene.log_views(stream, row)
        self._px[view.view] = view.px
        chart = corners_chart(self.cell.resolution, self._px)
        charts = Charts((chart,), frozenset(self._px))
        charts.log_static(stream)
        charts.log_views(stream, row)
        if view.sigma_mm is not None:
            stream.log(paths.LIVE_SIGMA, rr.Scalars(view.sigma_mm))
        stream.log(paths.LIVE_NOTE, markdown(view.note))

    @property
    def _scene(self) -> Scene:
        cell, seen = self.cell, None
        if cell.x is not None and cell.z is not None:
            seen = Seen(cell.mount, cell.target, cell.camera, cell.x, cell.z)
        return Scene.planned(cell.robot, self._states, _SIZE_M, seen)
