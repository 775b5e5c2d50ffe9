"""Previews of plans: stops and motions before they are driven."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.blueprint import BlueprintLike

from visioncal.core.files import replacing_file
from visioncal.core.transforms import apply, invert
from visioncal.core.types import FloatArray
from visioncal.dynamics.model import JointMotion
from visioncal.present.cell_poses import states_of
from visioncal.present.recording import colours, paths
from visioncal.present.recording.arm import log_obstacles
from visioncal.present.recording.notes import markdown
from visioncal.present.recording.recorder import Recorder, send_rows
from visioncal.present.recording.scene import Scene, Seen
from visioncal.robot import Robot
from visioncal.robot.collision import Body
from visioncal.vision.camera import project
from visioncal.vision.targets import closed_outline, corner_positions

# Width of the way, as a share of the cell's size.
_LINE = 0.002


@dataclass(frozen=True, eq=False)
class PreviewStop:
    """A stop: view number, joint angles (n,), and those of via points before it (j, n) [rad]."""

    view: int
    q: FloatArray
    via: FloatArray
    note: str


@dataclass(frozen=True, eq=False)
class Preview(Seen):
    """Content of a plan's preview."""

    name: str  # Name of the recording.
    robot: Robot  # The arm.
    stops: Sequence[PreviewStop]  # Stops in driving order.
    obstacles: Sequence[Body]  # Obstacles in the cell.
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
    """Writes the preview of a plan as a recording, whole or not at all; raises DataError.

    It has two timelines: one step per stop, and the arm's path in small steps. The blueprint is the
    viewer's layout of it.
    """
    first = preview.stops[0]
    # Postures on the path [rad], and the indices of the stops among them.
    postures, reached = [[*first.via, first.q][0]], list[int]()
    for stop in preview.stops:
        for begin, end in pairwise([postures[-1], *stop.via, stop.q]):
            # Postures in between turn joints by 0.05 rad at most.
            count = int(np.ceil(np.abs(end - begin).max() / 0.05))
            shares = np.arange(1, count + 1) / count
            postures += [begin + share * (end - begin) for share in shares]
        reached.append(len(postures) - 1)
    states = states_of(preview.robot, np.array(postures))
    way = Scene.planned(preview.robot, states, preview.size_m, preview)
    steps = dict(zip((stop.view for stop in preview.stops), reached, strict=True))
    stops = {view: states[step] for view, step in steps.items()}
    scene = Scene.planned(preview.robot, stops, preview.size_m, preview)
    with replacing_file(path) as aside, Recorder(aside) as recorder:
        stream = recorder.stream
        stream.send_recording_name(preview.name)
        recorder.lay_out(blueprint)
        scene.log_static(stream)
        scene.log_stops(stream, labelled=True)
        width, height = preview.camera.resolution
        border = rr.Boxes2D(mins=[[0.0, 0.0]], sizes=[[width, height]], colors=colours.GRID)
        in_image = rr.CoordinateFrame(paths.IMAGE_FRAME)
        stream.log(f"{paths.IMAGE}/border", in_image, border, static=True)
        log_obstacles(stream, preview.obstacles, preview.floor_m, preview.size_m)
        stream.log(paths.PLAN_NOTE, markdown(preview.note), static=True)
        flange_m = np.array([state.pose[:3, 3] for state in states.values()])
        line = rr.LineStrips3D([flange_m], colors=colours.WAY, radii=0.7 * _LINE * preview.size_m)
        stream.log(paths.WAY, rr.CoordinateFrame(paths.BASE_FRAME), line, static=True)
        scene.log_views(stream, {view: row for row, view in enumerate(steps)})
        way.log_views(stream, {step: step for step in states}, paths.WAY_TIMELINE)
        _log_stops(stream, preview, reached)
        recorder.keep()


def _log_stops(stream: rr.RecordingStream, preview: Preview, steps: Sequence[int]) -> None:
    """Draws the image of each stop, on both timelines; `steps` are its steps on the way."""
    sides = closed_outline(preview.target, 8)
    px, rims = [], []
    for flange in preview.base_from_flange:
        base_from_cam, base_from_target = preview.placed(flange)
        cam_from_target = invert(base_from_cam) @ base_from_target
        corners = apply(cam_from_target, corner_positions(preview.target))
        px.append(project(preview.camera, corners))
        rims.append(project(preview.camera, apply(cam_from_target, sides)))
    in_image = rr.CoordinateFrame(paths.IMAGE_FRAME)
    style = rr.Points2D.from_fields(colors=colours.PREDICTED, radii=rr.Radius.ui_points(2.5))
    stream.log(paths.PREDICTED, in_image, style, static=True)
    rim_style = rr.LineStrips2D.from_fields(colors=colours.DETECTED)
    stream.log(f"{paths.IMAGE}/board", in_image, rim_style, static=True)
    notes = [stop.note for stop in preview.stops]
    # Rerun's origin is the image's corner, not the first pixel's centre.
    places = rr.Points2D.columns(positions=np.vstack(px) + 0.5)
    columns = {
        paths.PREDICTED: places.partition([*map(len, px)]),
        f"{paths.IMAGE}/board": rr.LineStrips2D.columns(strips=[rim + 0.5 for rim in rims]),
        paths.STOP_NOTE: rr.TextDocument.columns(
            text=notes, media_type=["text/markdown"] * len(notes)
        ),
    }
    for timeline, rows in ((paths.TIMELINE, range(len(steps))), (paths.WAY_TIMELINE, steps)):
        for entity, column in columns.items():
            send_rows(stream, entity, rows, column, timeline)


@dataclass(frozen=True, eq=False)
class MotionPreview:
    """Content of a preview of planned motions."""

    name: str  # Name of the recording.
    robot: Robot  # The arm.
    motions: Mapping[str, JointMotion]  # By name, one after the other on the timeline.
    obstacles: Sequence[Body]  # Obstacles in the cell.
    floor_m: float | None  # Height of the floor in the base [m]; None without a floor.
    note: str  # Text of the plan in Markdown.

    @property
    def places_m(self) -> FloatArray:
        """(k, 3) positions of the base and of the flange along all motions [m]."""
        ways = [self.robot.base_from_flange(motion.q)[:, :3, 3] for motion in self.motions.values()]
        return np.vstack([np.zeros(3), *ways])


def write_motion_preview(
    path: Path, preview: MotionPreview, blueprint: BlueprintLike | None
) -> None:
    """Writes the preview of motions on a timeline of seconds; see `write_preview`."""
    places_m, robot, start_s = preview.places_m, preview.robot, 0.0
    size_m = float(np.median(np.linalg.norm(places_m[1:], axis=1)))
    with replacing_file(path) as aside, Recorder(aside) as recorder:
        stream = recorder.stream
        stream.send_recording_name(preview.name)
        recorder.lay_out(blueprint)
        log_obstacles(stream, preview.obstacles, preview.floor_m, size_m)
        stream.log(paths.PLAN_NOTE, markdown(preview.note), static=True)
        line = rr.LineStrips3D([places_m[1:]], colors=colours.WAY, radii=_LINE * size_m)
        stream.log(paths.WAY, rr.CoordinateFrame(paths.BASE_FRAME), line, static=True)
        Scene.planned(robot, {}, size_m).log_static(stream)
        for motion in preview.motions.values():
            times = np.round(1e9 * (start_s + motion.times_s)).astype("timedelta64[ns]")
            scene = Scene.planned(robot, states_of(robot, motion.q), size_m)
            scene.log_views(stream, dict(enumerate(times)), paths.MOTION_TIMELINE)
            start_s += float(motion.times_s[-1])
            recorder.keep()
