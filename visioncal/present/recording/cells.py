"""A whole cell of several robots as it is drawn: frames, arms, and who saw whom, stop by stop.

Frames are rerun's named frames under our own names; what moves is placed anew with every view.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr

from visioncal.core.errors import DataError
from visioncal.core.files import sha256
from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray, Target
from visioncal.present.cellmap import pairs, places, spans
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.arm import log_arm, placed
from visioncal.present.recording.frames import Frame, scan
from visioncal.present.recording.markdown import sight_markdown, verdict_markdown
from visioncal.present.recording.notes import log_verdict, markdown
from visioncal.present.recording.reader import chunks
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.scene import image_plane
from visioncal.results import Alignment, Calibration, Sight
from visioncal.robot import Robot
from visioncal.session import Session, View, frame_name
from visioncal.session.observations import standing

_RESULT = "visioncal.Alignment"
# Sizes of what is drawn, as shares of the cell's size.
_AXIS, _LINE = 0.08, 0.0015
# The network: the height of the bodies' names, and the drawing's units [px].
_BODY_HEIGHT, _ACROSS_PX, _DOWN_PX = 3.6, 110.0, 120.0


@dataclass(frozen=True, eq=False)
class CellScene:
    """What is drawn of an aligned cell.

    Attributes:
        session: The session.
        found: Its result.
    """

    session: Session
    found: Alignment

    @cached_property
    def robots(self) -> Mapping[str, Robot]:
        """The robots' models by their flanges' frames, as far as they are known."""
        documents = self.session.robot_documents.items()
        return {frame_name("flange", it): Robot.from_document(one) for it, one in documents}

    @cached_property
    def robot_rows(self) -> Mapping[int, Mapping[str, View]]:
        """By view and by flange, the row with the robot's pose."""
        rows = standing(self.session.declaration, self.session.views)
        return {
            view: {frame_name("flange", name): row for name, row in them.items()}
            for view, them in rows.items()
        }

    @cached_property
    def targets(self) -> Mapping[str, Target]:
        """The printed targets by frame, as far as the result places them."""
        plates = self.session.plates.items()
        named = {frame_name("target", name): target for name, target in plates}
        return {frame: it for frame, it in named.items() if frame in self.found.frames}

    @cached_property
    def size_m(self) -> float:
        """How far apart what stands in the cell is [m]."""
        places = [
            self.found.edge_of(it).matrix[:3, 3]
            for it, on in self.found.frames.items()
            if on == paths.CELL_FRAME
        ]
        extent = np.ptp(np.array([np.zeros(3), *places]), axis=0)
        return max(float(np.linalg.norm(extent)), 0.5)

    def flange(self, frame: str, view: int) -> FloatArray | None:
        """(4, 4) `base_from_flange` at the stop of a view; None where it is unknown."""
        return self._flanges.get(view, {}).get(frame)

    @cached_property
    def _flanges(self) -> Mapping[int, Mapping[str, FloatArray | None]]:
        """By view and by flange, its pose."""
        return {
            view: {frame: self._pose(frame, row) for frame, row in them.items()}
            for view, them in self.robot_rows.items()
        }

    def _pose(self, frame: str, row: View) -> FloatArray | None:
        pose, q, robot = row.base_from_flange(), row.joints_rad, self.robots.get(frame)
        if pose is not None:
            return np.asarray(pose.as_matrix())
        if q is None or robot is None or len(q) != robot.joint_count:
            return None
        return np.asarray(robot.base_from_flange(q[None])[0])

    @cached_property
    def shown(self) -> Mapping[int, Mapping[str, int]]:
        """By view and by flange, the view by which it is drawn: its own stop's, or the last before.

        A robot without a pose yet is drawn at its first one.
        """
        drawn: dict[int, dict[str, int]] = {}
        last: dict[str, int] = {}
        for view in reversed(self.session.views):
            last |= self._posed(view.number)
        for view in self.session.views:
            last |= self._posed(view.number)
            drawn[view.number] = dict(last)
        return drawn

    def _posed(self, view: int) -> dict[str, int]:
        return {it: view for it in self.found.robots if self.flange(it, view) is not None}

    def unposed(self, view: int) -> list[str]:
        """The robots without a pose at the stop of a view."""
        return [it for flange, it in self.found.robots.items() if self.flange(flange, view) is None]

    def in_cell(self, frame: str, view: int) -> FloatArray | None:
        """(4, 4) where a frame is in the cell at the stop of a view; None where that is unknown."""
        matrix = np.eye(4)
        while frame != paths.CELL_FRAME:
            if frame in self.found.robots:
                edge = self.flange(frame, view)
            elif frame in self.found.frames:
                edge = self.found.edge_of(frame).matrix
            else:
                edge = None
            if edge is None:
                return None
            matrix, frame = edge @ matrix, self.found.frames[frame]
        return matrix


def log_cell(recorder: Recorder, session: Session, found: Alignment) -> None:
    """Logs an aligned cell: first what is drawn of it, then the result itself.

    Raises:
        OSError: The file cannot be written.
    """
    scene = CellScene(session, found)
    stream = recorder.stream
    _log_static(stream, scene)
    sights = {it.view: it for it in found.sights}
    for row, view in enumerate(session.views):
        recorder.at(row)
        _log_view(stream, scene, view, sights.get(view.number))
    recorder.keep()
    text = Calibration.whole(found).text
    components = {"seal": pa.array([sha256(text.encode())], pa.string())}
    stream.log(
        paths.ALIGNMENT,
        rr.TextDocument(text, media_type="application/json"),
        rr.DynamicArchetype(_RESULT, components=components),
        static=True,
    )
    recorder.keep()


def read_alignment(path: Path) -> Alignment | None:
    """Reads the alignment that a recording holds; None where it holds none.

    Raises:
        DataError: The file cannot be read, or the result is damaged.
    """
    damaged: list[Frame] = []
    text = ""
    try:
        for _, _, batch in chunks(scan(path), (paths.ALIGNMENT,), damaged):
            text = batch.column("TextDocument:text")[0].as_py()[0]
            if sha256(text.encode()) != batch.column(f"{_RESULT}:seal")[0].as_py()[0]:
                raise _damaged(path)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise _damaged(path) from error
    if damaged:
        raise _damaged(path)
    return Calibration.from_json(text, str(path)).cell if text else None


def _damaged(path: Path) -> DataError:
    return DataError(
        f"{path} is damaged: the alignment in it was changed after it was written.",
        culprits=[str(path)],
        next_step="Align the session in it again.",
    )


def _log_static(stream: rr.RecordingStream, scene: CellScene) -> None:
    found = scene.found
    axes = rr.TransformAxes3D(2.0 * _AXIS * scene.size_m, show_frame=False)
    stream.log(paths.CELL, rr.CoordinateFrame(paths.CELL_FRAME), axes, static=True)
    former = {it.before for it in found.moved}
    for frame, on in found.frames.items():
        if frame not in found.robots and frame not in former:
            _log_frame(stream, scene, frame, on)
    for frame in found.robots:
        entity = _frame_entity(frame)
        shown = rr.TransformAxes3D(_AXIS * scene.size_m, show_frame=True)
        stream.log(entity, rr.CoordinateFrame(frame), shown, static=True)
        for part in ("links", "joints", "reach"):
            base = rr.CoordinateFrame(found.frames[frame])
            stream.log(f"{_arm_entity(frame)}/{part}", base, static=True)
    _log_network(stream, found)
    log_verdict(stream, found.verdict, verdict_markdown(found))
    for seer in dict.fromkeys(it.seer for it in found.sights):
        for name, colour in ((paths.USED, colours.USED), (paths.REJECTED, colours.REJECTED)):
            points = rr.SeriesPoints(colors=colour, marker_sizes=4.0, names=f"{seer}, {name}")
            stream.log(residual_entity(seer, name), points, static=True)


def _frame_entity(frame: str) -> str:
    """The entity of a frame of the cell."""
    return f"{paths.CELL}/{rr.escape_entity_path_part(frame)}"


def _arm_entity(flange: str) -> str:
    """The entity of the arm that moves a flange."""
    return f"{paths.ROBOTS}/{flange}"


def residual_entity(seer: str, name: str) -> str:
    """The entity of the residuals of what one frame saw, used or not."""
    return f"{paths.POSITION_MM}/{rr.escape_entity_path_part(seer)}/{name}"


def _log_frame(stream: rr.RecordingStream, scene: CellScene, frame: str, on: str) -> None:
    """Places a frame on what it hangs on, and draws what it is."""
    entity, matrix = _frame_entity(frame), scene.found.edge_of(frame).matrix
    stream.log(
        entity,
        placed(matrix, on, frame),
        rr.CoordinateFrame(frame),
        rr.TransformAxes3D(_AXIS * scene.size_m, show_frame=True),
        static=True,
    )
    if on in scene.found.robots:
        line = [[np.zeros(3), matrix[:3, 3]]]
        _log_lines(stream, f"{entity}/mount", on, line, colours.JOINT, 3.0 * scene.size_m)
    if frame in scene.targets:
        sheet = board.sheet(scene.targets[frame])
        stream.log(f"{entity}/sheet", rr.CoordinateFrame(frame), sheet, static=True)
    if frame in scene.found.cameras:
        image = _image_frame(frame)
        plane = image_plane(scene.found.cameras[frame].camera, 0.5 * scene.size_m, (frame, image))
        stream.log(f"{entity}/image", rr.CoordinateFrame(image), plane, static=True)


def _image_frame(camera: str) -> str:
    """The frame of a camera's images; the entity of all images goes from one to the other."""
    return f"{paths.IMAGE_FRAME}_of_{camera}"


def _log_lines(
    stream: rr.RecordingStream,
    entity: str,
    frame: str,
    strips: Sequence[FloatArray | Sequence[FloatArray]],
    colour: tuple[int, int, int],
    size_m: float,
    *,
    static: bool = True,
) -> None:
    lines = rr.LineStrips3D(strips, colors=colour, radii=_LINE * size_m)
    stream.log(entity, rr.CoordinateFrame(frame), lines, static=static)


def _log_network(stream: rr.RecordingStream, found: Alignment) -> None:
    """Draws the network as a graph: frames with their sigmas, and who saw whom."""
    nodes: dict[str, tuple[float, float]] = {}
    for body, (left, right) in spans(found).items():
        nodes[body] = (0.5 * (left + right), _BODY_HEIGHT)
    nodes |= places(found)
    labels = [f"{it}\n{_sigma(found, it)}" for it in nodes]
    bodies = {paths.CELL_FRAME, *found.robots}
    seen = [(it.seer, it.seen) for it in pairs(found) if it.used]
    hangs = [(found.frames[it], it) for it in nodes if it != paths.CELL_FRAME]
    stream.log(
        paths.NETWORK,
        rr.GraphNodes(
            list(nodes),
            positions=[(_ACROSS_PX * x, -_DOWN_PX * y) for x, y in nodes.values()],
            labels=labels,
            colors=[colours.LINK if it in bodies else colours.USED for it in nodes],
        ),
        rr.GraphEdges([*hangs, *seen], graph_type="undirected"),
        static=True,
    )


def _sigma(found: Alignment, frame: str) -> str:
    if frame in found.robots:
        return f"robot {found.robots[frame]}"
    if frame in (paths.CELL_FRAME, found.reference):
        return "the reference"
    return f"{significant(found.edge_of(frame).sigma_mm)} mm"


def _log_view(
    stream: rr.RecordingStream, scene: CellScene, view: View, sight: Sight | None
) -> None:
    """Places what moves, and draws what was seen, at the stream's current time."""
    for flange in scene.found.robots:
        _log_robot(stream, scene, flange, view)
    strips, used = [], sight is not None and sight.used
    if sight is not None:
        ends = [scene.in_cell(it, view.number) for it in (sight.seer, sight.seen)]
        if ends[0] is not None and ends[1] is not None:
            strips = [np.array([ends[0][:3, 3], _middle(scene, sight.seen, ends[1])])]
        if sight.seer in scene.found.cameras:
            stream.log(paths.IMAGE, rr.CoordinateFrame(_image_frame(sight.seer)))
        if sight.residual_mm is not None:
            name = paths.USED if used else paths.REJECTED
            stream.log(residual_entity(sight.seer, name), rr.Scalars(sight.residual_mm))
    colour = colours.DETECTED if used else colours.REJECTED
    # Without a strip, this takes that of the view before off the screen.
    size_m = 2.0 * scene.size_m
    _log_lines(stream, paths.SIGHT_LINE, paths.CELL_FRAME, strips, colour, size_m, static=False)
    note = sight_markdown(view, sight, scene.unposed(view.number))
    stream.log(paths.VIEW_NOTE, markdown(note))


def _middle(scene: CellScene, frame: str, cell_from_frame: FloatArray) -> FloatArray:
    """The middle of what was seen, in the cell."""
    target = scene.targets.get(frame)
    middle = np.zeros(3) if target is None else board.outline(target).mean(axis=0)
    return np.asarray(cell_from_frame[:3, :3] @ middle + cell_from_frame[:3, 3])


def _log_robot(stream: rr.RecordingStream, scene: CellScene, flange: str, view: View) -> None:
    """Places a flange and draws its arm, as of its stop, or of the last one with its pose."""
    by = scene.shown[view.number].get(flange, view.number)
    pose, base = scene.flange(flange, by), scene.found.frames[flange]
    if pose is None:
        stream.log(_frame_entity(flange), rr.Clear(recursive=False))
        stream.log(_arm_entity(flange), rr.Clear(recursive=True))
        return
    stream.log(_frame_entity(flange), placed(pose, base, flange))
    robot, q = scene.robots.get(flange), scene.robot_rows[by][flange].joints_rad
    if robot is not None and q is not None and len(q) == robot.joint_count:
        log_arm(stream, robot.link_frames(q), _arm_entity(flange))
        return
    line = rr.LineStrips3D(
        [[np.zeros(3), pose[:3, 3]]], colors=colours.JOINT, radii=2.0 * _LINE * scene.size_m
    )
    stream.log(f"{_arm_entity(flange)}/reach", line)
