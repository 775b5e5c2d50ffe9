"""Previews of plans: stops and motions before they are driven."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.blueprint import BlueprintLike

from visioncal.core.files import replacing_file
from visioncal.core.transforms import apply, invert
from visioncal.core.types import Camera, FloatArray, Mount, Target
from visioncal.dynamics.model import JointMotion
from visioncal.present.coverage import corners_chart, directions_chart, rotation_axes_chart
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.arm import (
    Obstacle,
    log_arm,
    log_arm_motion,
    log_frames,
    log_obstacles,
    log_pose,
)
from visioncal.present.recording.charts import Charts
from visioncal.present.recording.notes import markdown
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.scene import SMALL_FRUSTUM, frustum, log_image_plane
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.vision.camera import project
from visioncal.vision.targets import corner_positions

# Sizes as shares of the cell's size.
_AXIS, _LINE, _POINT = 0.12, 0.002, 0.004
# Largest joint rotation between drawn postures of the path [rad].
_STEP_RAD = 0.05
# Points per side of the board, which the lens bends.
_SIDE_POINTS = 9


@dataclass(frozen=True, eq=False)
class PreviewStop:
    """A stop: view number, joint angles (n,), and those of via points before it (j, n) [rad]."""

    view: int
    q: FloatArray
    via: FloatArray
    note: str


@dataclass(frozen=True, eq=False)
class Preview:
    """Content of a plan's preview."""

    name: str  # Name of the recording.
    mount: Mount  # Where the camera is.
    robot: Robot  # The arm.
    camera: Camera  # The camera's intrinsics.
    target: Target  # The board.
    x: FloatArray  # (4, 4) estimated pose of the camera, on the flange or in the base [m].
    z: FloatArray  # (4, 4) estimated pose of the board, in the base or on the flange [m].
    stops: Sequence[PreviewStop]  # Stops in driving order.
    # Predicted sigma by number of stops; NaN where something is undetermined [mm].
    sigmas_mm: FloatArray
    obstacles: Sequence[Obstacle]  # Obstacles in the cell.
    floor_m: float | None  # Height of the floor in the base [m]; None without a floor.
    note: str  # Text of the plan in Markdown.

    @property
    def base_from_flange(self) -> FloatArray:
        """(k, 4, 4) flange poses at the stops [m]."""
        return self.robot.base_from_flange(np.array([stop.q for stop in self.stops]))

    @property
    def size_m(self) -> float:
        """Typical distance of the flange from the base [m]."""
        return float(np.median(np.linalg.norm(self.base_from_flange[:, :3, 3], axis=1)))

    def placed(self, base_from_flange: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Poses of camera and board in the base, (4, 4) each, for a flange pose [m]."""
        if self.mount == "eye-in-hand":
            return base_from_flange @ self.x, self.z
        return self.x, base_from_flange @ self.z


def write_preview(path: Path, preview: Preview, blueprint: BlueprintLike | None) -> None:
    """Writes the preview of a plan as a recording.

    It has two timelines: one step per stop, and the arm's path in small steps.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        preview: The plan.
        blueprint: Viewer layout of the recording.

    Raises:
        DataError: The file cannot be written.
    """
    with replacing_file(path) as aside, Recorder(aside) as recorder:
        stream = recorder.stream
        stream.send_recording_name(preview.name)
        recorder.lay_out(blueprint)
        charts = _charts(preview)
        _log_static(stream, preview, charts)
        _log_stops(recorder, preview, charts)


def _charts(preview: Preview) -> Charts:
    evidence, px = {}, {}
    for stop, flange in zip(preview.stops, preview.base_from_flange, strict=True):
        base_from_cam, base_from_target = preview.placed(flange)
        cam_from_target = invert(base_from_cam) @ base_from_target
        evidence[stop.view] = ViewEvidence(
            stop.view, base_from_flange=flange, cam_from_target=cam_from_target
        )
        px[stop.view] = _corners_px(preview, cam_from_target)
    charts = (
        corners_chart(preview.camera.resolution, px),
        directions_chart(evidence),
        rotation_axes_chart(list(evidence.values())),
    )
    return Charts(tuple(chart for chart in charts if chart is not None), (), frozenset(evidence))


def _corners_px(preview: Preview, cam_from_target: FloatArray) -> FloatArray:
    points = apply(cam_from_target, corner_positions(preview.target))
    return project(preview.camera, points)


def _log_static(stream: rr.RecordingStream, preview: Preview, charts: Charts) -> None:
    size_m = preview.size_m
    carried = ((paths.CAMERA, paths.CAM_FRAME, 0.7), (paths.TARGET, paths.TARGET_FRAME, 0.7))
    log_frames(stream, _AXIS * size_m, carried)
    log_image_plane(stream, preview.camera, size_m)
    width, height = preview.camera.resolution
    border = rr.Boxes2D(mins=[[0.0, 0.0]], sizes=[[width, height]], colors=colours.GRID)
    in_image = rr.CoordinateFrame(paths.IMAGE_FRAME)
    stream.log(f"{paths.IMAGE}/border", in_image, border, static=True)
    sheet = board.sheet(preview.target)
    on_target = rr.CoordinateFrame(paths.TARGET_FRAME)
    stream.log(f"{paths.TARGET}/sheet", on_target, sheet, static=True)
    log_obstacles(stream, preview.obstacles, preview.floor_m, size_m)
    _log_carried(stream, preview, size_m)
    charts.log_static(stream)
    stream.log(paths.PLAN_NOTE, markdown(preview.note), static=True)
    finite = np.isfinite(preview.sigmas_mm)
    if finite.any():
        bars = rr.BarChart(
            preview.sigmas_mm[finite],
            abscissa=np.flatnonzero(finite).astype(float),
            color=colours.USED,
        )
        stream.log(paths.PREDICTED_SIGMA, bars, static=True)


def _log_carried(stream: rr.RecordingStream, preview: Preview, size_m: float) -> None:
    """Draws what the flange carries at all stops, and its path between them."""
    frame = rr.CoordinateFrame(paths.BASE_FRAME)
    flange_from_carried, shapes = preview.z, [board.closed_outline(preview.target)]
    if preview.mount == "eye-in-hand":
        flange_from_carried = preview.x
        shapes = frustum(preview.camera, SMALL_FRUSTUM * size_m)
    base_from_carried = preview.base_from_flange @ flange_from_carried
    strips = [apply(pose, shape) for pose in base_from_carried for shape in shapes]
    lines = rr.LineStrips3D(strips, colors=colours.USED, radii=0.5 * _LINE * size_m)
    stream.log(f"{paths.STOPS}/{paths.USED}/carried", frame, lines, static=True)
    points = rr.Points3D(
        base_from_carried[:, :3, 3],
        colors=colours.USED,
        radii=_POINT * size_m,
        labels=[str(stop.view) for stop in preview.stops],
        show_labels=True,
    )
    stream.log(f"{paths.STOPS}/{paths.USED}", frame, points, static=True)
    path = np.array([q for _, steps in _path(preview) for q in steps])
    positions = (preview.robot.base_from_flange(path) @ flange_from_carried)[:, :3, 3]
    line = rr.LineStrips3D([positions], colors=colours.THIS_VIEW, radii=0.7 * _LINE * size_m)
    stream.log(paths.WAY, frame, line, static=True)


def _path(preview: Preview) -> Iterator[tuple[PreviewStop, list[FloatArray]]]:
    """Each stop with the postures (n,) on the path to it, its own last."""
    previous: FloatArray | None = None
    for stop in preview.stops:
        waypoints = [*([] if previous is None else [previous]), *stop.via, stop.q]
        steps = [] if previous is not None else [waypoints[0]]
        for begin, end in pairwise(waypoints):
            count = max(int(np.ceil(np.abs(end - begin).max() / _STEP_RAD)), 1)
            steps += [begin + share * (end - begin) for share in np.arange(1, count + 1) / count]
        previous = stop.q
        yield stop, steps


def _log_stops(recorder: Recorder, preview: Preview, charts: Charts) -> None:
    stream, step, in_image = recorder.stream, 0, rr.CoordinateFrame(paths.IMAGE_FRAME)
    outline = board.closed_outline(preview.target)
    shares = np.linspace(0.0, 1.0, _SIDE_POINTS)[:, None]
    sides = np.concatenate([begin + shares * (end - begin) for begin, end in pairwise(outline)])
    for index, (stop, steps) in enumerate(_path(preview)):
        for q in steps[:-1]:
            stream.reset_time()
            stream.set_time(paths.WAY_TIMELINE, sequence=step)
            _log_cell(stream, preview, q)
            step += 1
        recorder.at(index)
        stream.set_time(paths.WAY_TIMELINE, sequence=step)
        step += 1
        cam_from_target = _log_cell(stream, preview, stop.q)
        charts.log_view(stream, stop.view)
        seen = apply(cam_from_target, sides)
        # Rerun's origin is the image's corner, not the first pixel's centre.
        rim = rr.LineStrips2D([project(preview.camera, seen) + 0.5], colors=colours.DETECTED)
        stream.log(f"{paths.IMAGE}/board", in_image, rim)
        px = _corners_px(preview, cam_from_target) + 0.5
        points = rr.Points2D(px, colors=colours.PREDICTED, radii=rr.Radius.ui_points(2.5))
        stream.log(paths.PREDICTED, in_image, points)
        stream.log(paths.STOP_NOTE, markdown(stop.note))
    recorder.keep()


def _log_cell(stream: rr.RecordingStream, preview: Preview, q: FloatArray) -> FloatArray:
    """Draws the arm and what it carries; returns `cam_from_target` (4, 4)."""
    links = preview.robot.link_frames(q)
    base_from_cam, base_from_target = preview.placed(links[-1])
    log_arm(stream, links)
    log_pose(stream, paths.FLANGE, paths.FLANGE_FRAME, links[-1])
    log_pose(stream, paths.CAMERA, paths.CAM_FRAME, base_from_cam)
    log_pose(stream, paths.TARGET, paths.TARGET_FRAME, base_from_target)
    return invert(base_from_cam) @ base_from_target


@dataclass(frozen=True, eq=False)
class MotionPart:
    """One motion of a plan."""

    name: str  # Its name.
    motion: JointMotion  # Joint motion, from time zero.
    torques_nm: FloatArray | None  # (m, n) torques of the nominal arm [N m]; None where unknown.


@dataclass(frozen=True, eq=False)
class MotionPreview:
    """Content of a preview of planned motions."""

    name: str  # Name of the recording.
    robot: Robot  # The arm.
    parts: Sequence[MotionPart]  # Motions in their order, one after the other on the timeline.
    obstacles: Sequence[Obstacle]  # Obstacles in the cell.
    floor_m: float | None  # Height of the floor in the base [m]; None without a floor.
    note: str  # Text of the plan in Markdown.

    @property
    def places_m(self) -> FloatArray:
        """(k, 3) positions of the base and of the flange along all motions [m]."""
        paths = [self.robot.base_from_flange(part.motion.q)[:, :3, 3] for part in self.parts]
        return np.vstack([np.zeros(3), *paths])


def write_motion_preview(
    path: Path, preview: MotionPreview, blueprint: BlueprintLike | None
) -> None:
    """Writes the preview of motions as a recording, on a timeline of seconds.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        preview: The motions.
        blueprint: Viewer layout of the recording.

    Raises:
        DataError: The file cannot be written.
    """
    with replacing_file(path) as aside, Recorder(aside) as recorder:
        recorder.stream.send_recording_name(preview.name)
        recorder.lay_out(blueprint)
        _log_motions(recorder.stream, preview)
        start_s = 0.0
        for part in preview.parts:
            motion = part.motion
            # In the recording's resolution, so that curves and arm agree to the last bit.
            times = np.round(1e9 * (start_s + motion.times_s)).astype("timedelta64[ns]")
            curves = [np.rad2deg(array) for array in (motion.q, motion.dq, motion.ddq)]
            curves += [] if part.torques_nm is None else [part.torques_nm]
            index = rr.TimeColumn(paths.MOTION_TIMELINE, duration=times)
            for kind, values in zip(paths.MOTION_KINDS, curves, strict=False):
                columns = rr.Scalars.columns(scalars=values)
                recorder.stream.send_columns(f"{paths.MOTION}/{kind}", [index], columns)
            log_arm_motion(recorder.stream, preview.robot, motion.q, times)
            start_s += float(motion.times_s[-1])
            recorder.keep()


def _log_motions(stream: rr.RecordingStream, preview: MotionPreview) -> None:
    places = preview.places_m
    size_m = float(np.median(np.linalg.norm(places[1:], axis=1)))
    log_frames(stream, _AXIS * size_m)
    in_base = rr.CoordinateFrame(paths.BASE_FRAME)
    log_obstacles(stream, preview.obstacles, preview.floor_m, size_m)
    start = 1
    for index, part in enumerate(preview.parts):
        path = places[start : start + len(part.motion)]
        start += len(part.motion)
        colour = colours.THIS_VIEW if index == 0 else colours.USED
        line = rr.LineStrips3D([path], colors=colour, radii=_LINE * size_m)
        stream.log(f"{paths.WAY}/{part.name}", in_base, line, static=True)
    names = list(preview.robot.joint_names)
    # A joint has the same colour in all curves.
    tints = [colours.SCALE[joint % len(colours.SCALE)] for joint in range(len(names))]
    for kind in paths.MOTION_KINDS:
        lines = rr.SeriesLines(names=names, colors=tints)
        stream.log(f"{paths.MOTION}/{kind}", lines, static=True)
    stream.log(paths.PLAN_NOTE, markdown(preview.note), static=True)
