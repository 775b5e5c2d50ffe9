"""The preview of motions that nobody has driven yet: the arm on its way, and its joints' curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import rerun as rr
from rerun.blueprint import BlueprintLike

from visioncal.core.files import written_beside
from visioncal.core.types import FloatArray
from visioncal.dynamics.motion import JointMotion
from visioncal.present.recording import colours, paths
from visioncal.present.recording.arm import log_arm, log_frames
from visioncal.present.recording.markdown import markdown
from visioncal.present.recording.obstacles import Obstacle, log_obstacles
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.scene import log_pose
from visioncal.robot import Robot

# Sizes of what is drawn, as shares of the cell's size.
_AXIS, _LINE = 0.12, 0.002


@dataclass(frozen=True, eq=False)
class MotionPart:
    """One motion.

    Attributes:
        name: What it is.
        motion: From zero on.
        torques_nm: (m, n) that the nominal arm needs [N m]; None where that is not known.
    """

    name: str
    motion: JointMotion
    torques_nm: FloatArray | None


@dataclass(frozen=True, eq=False)
class MotionPreview:
    """What is drawn of planned motions.

    Attributes:
        name: What to call the recording.
        robot: The arm.
        parts: In their order, one after the other on the timeline.
        obstacles: What is in the way.
        floor_m: Height of the floor in the base [m]; None for none.
        note: The plan in Markdown.
    """

    name: str
    robot: Robot
    parts: Sequence[MotionPart]
    obstacles: Sequence[Obstacle]
    floor_m: float | None
    note: str

    @property
    def places_m(self) -> FloatArray:
        """(k, 3) where the flange comes by, and the base [m]."""
        ways = [self.robot.base_from_flange(part.motion.q)[:, :3, 3] for part in self.parts]
        return np.vstack([np.zeros(3), *ways])


def write_motion_preview(
    path: Path, preview: MotionPreview, blueprint: BlueprintLike | None
) -> None:
    """Writes the preview of motions as a recording, on a timeline of seconds.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        preview: What is drawn.
        blueprint: The layout to open it in.

    Raises:
        DataError: The file cannot be written.
    """
    with written_beside(path) as aside, Recorder(aside) as recorder:
        recorder.stream.send_recording_name(preview.name)
        recorder.lay_out(blueprint)
        _log_static(recorder.stream, preview)
        begin_s = 0.0
        for part in preview.parts:
            _log_curves(recorder.stream, part, begin_s)
            _log_way(recorder.stream, preview, part, begin_s)
            begin_s += float(part.motion.times_s[-1])
            recorder.keep()


def _log_static(stream: rr.RecordingStream, preview: MotionPreview) -> None:
    places = preview.places_m
    size_m = float(np.median(np.linalg.norm(places[1:], axis=1)))
    log_frames(stream, _AXIS * size_m)
    in_base = rr.CoordinateFrame(paths.BASE_FRAME)
    log_obstacles(stream, preview.obstacles, preview.floor_m, size_m)
    rest = 1
    for at, part in enumerate(preview.parts):
        way = places[rest : rest + len(part.motion)]
        rest += len(part.motion)
        colour = colours.THIS_VIEW if at == 0 else colours.USED
        drawn = rr.LineStrips3D([way], colors=colour, radii=_LINE * size_m)
        stream.log(f"{paths.WAY}/{part.name}", in_base, drawn, static=True)
    names = list(preview.robot.joint_names)
    # A joint has the same colour in all curves.
    tints = [colours.SCALE[place % len(colours.SCALE)] for place in range(len(names))]
    for kind in paths.MOTION_KINDS:
        lines = rr.SeriesLines(names=names, colors=tints)
        stream.log(f"{paths.MOTION}/{kind}", lines, static=True)
    stream.log(paths.PLAN_NOTE, markdown(preview.note), static=True)


def _log_curves(stream: rr.RecordingStream, part: MotionPart, begin_s: float) -> None:
    """Draws the joints' curves."""
    motion = part.motion
    curves = [np.rad2deg(array) for array in (motion.q, motion.dq, motion.ddq)]
    if part.torques_nm is not None:
        curves.append(part.torques_nm)
    times = rr.TimeColumn(paths.MOTION_TIMELINE, duration=_durations(begin_s + motion.times_s))
    for kind, values in zip(paths.MOTION_KINDS, curves, strict=False):
        columns = rr.Scalars.columns(scalars=values)
        stream.send_columns(f"{paths.MOTION}/{kind}", indexes=[times], columns=columns)


def _log_way(
    stream: rr.RecordingStream, preview: MotionPreview, part: MotionPart, begin_s: float
) -> None:
    """Moves the arm."""
    motion = part.motion
    for duration, q in zip(_durations(begin_s + motion.times_s), motion.q, strict=True):
        stream.set_time(paths.MOTION_TIMELINE, duration=duration)
        links = preview.robot.link_frames(q)
        log_arm(stream, links)
        log_pose(stream, paths.FLANGE, paths.FLANGE_FRAME, links[-1])
    stream.reset_time()


def _durations(times_s: FloatArray) -> npt.NDArray[np.timedelta64]:
    """Times as the recording counts them, so that curves and arm have the same to the last bit."""
    return np.round(1e9 * times_s).astype("timedelta64[ns]")
