"""A picture of the cell: its arms, and where cameras and boards stood in the views."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from visioncal.core.transforms import apply, invert
from visioncal.core.types import FloatArray
from visioncal.present.cell_poses import CellPoses
from visioncal.present.report.plots import LINE_HEIGHT, WIDTH, Drawing
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.vision.camera import matrix_3x3
from visioncal.vision.targets import closed_outline

# Height of the picture [px].
_HEIGHT = 340.0
# It is seen from so far above [rad].
_ELEVATION_RAD = np.deg2rad(25.0)
# Sides that it may be seen from.
_SIDES = 72
_HALO = 'style="paint-order:stroke;stroke:var(--page);stroke-width:4"'
_ROUND = 'style="stroke-linecap:round;stroke-linejoin:round"'


@dataclass(frozen=True, eq=False)
class _Line:
    """A line of the picture."""

    name: str  # Frame whose name is written at the first point.
    colour: str  # One of the page's.
    width: float  # [px]
    points: FloatArray  # (n, 3) in the cell [m].


def cell_picture(
    calibration: Calibration, session: Session | None, evidence: Sequence[ViewEvidence]
) -> Markup:
    """The cell from the side: arms, and the cameras and boards of the used views.

    Args:
        calibration: The result.
        session: Its session, for boards and joint angles; without it there is no picture.
        evidence: Poses of the views, for one camera and robot.
    """
    if session is None or calibration.mount == "instrument":
        return Markup("")
    cell = CellPoses.of(session, calibration, {view.view: view for view in evidence})
    frames = cell.frames
    if not frames.robots:
        return Markup("")
    used = [view for view in calibration.views if view.used]
    used = used[:: max(1, -(-len(used) // 60))]
    arms = [*_arms(cell, used)]
    reach_m = max((float(np.ptp(arm.points, axis=0).max()) for arm in arms), default=1.0)
    lines = [*arms, *_seen(cell, used, 0.1 * reach_m)]
    if len(lines) == len(arms):
        return Markup("")
    # The first robot's base is upright, which the cell's frame may not be.
    upright = invert(frames.matrices[frames.parents[min(frames.robots)]])
    strips = [apply(upright, line.points) for line in lines]
    starts = dict[str, list[FloatArray]]()
    for line, strip in zip(lines, strips, strict=True):
        starts.setdefault(line.name, []).append(strip[0])
    middles = np.array([np.mean(each, axis=0) for each in starts.values()])
    project = _projection(np.vstack(strips), middles)
    drawing, lowest = Drawing(), -LINE_HEIGHT
    for line, strip in zip(lines, strips, strict=True):
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in project(strip))
        drawing.path(line.colour, line.width, f"M{path}", _ROUND)
    named = zip(project(middles).tolist(), starts, strict=True)
    for (x, y), name in sorted(named, key=lambda item: item[0][1]):
        lowest = max(y + 4.0, lowest + LINE_HEIGHT)
        drawing.text(x + 12.0, lowest, name, "start", _HALO)
    return drawing.svg("The cell: its arms, and cameras and boards in the views", _HEIGHT)


def _projection(points: FloatArray, named: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Parallel projection of points (n, 3) [m], from where the named (k, 3) are farthest apart."""
    angles = np.linspace(0.0, 2.0 * np.pi, _SIDES, endpoint=False)
    cos, sin, level = np.cos(angles), np.sin(angles), np.zeros(_SIDES)
    rise = np.sin(_ELEVATION_RAD)
    down = np.stack([rise * sin, -rise * cos, level - np.cos(_ELEVATION_RAD)], axis=1)
    axes = np.stack([np.stack([cos, sin, level], axis=1), down], axis=1)
    places = named @ np.swapaxes(axes, 1, 2)
    first, second = np.triu_indices(len(named), 1)
    between = np.linalg.norm(places[:, first] - places[:, second], axis=2)
    best = axes[int(np.argmax(between.min(axis=1, initial=np.inf)))]
    low, high = (points @ best.T).min(axis=0), (points @ best.T).max(axis=0)
    # Room that remains free at the borders [px].
    room = np.array([WIDTH, _HEIGHT]) - 2.0 * 36.0
    scale = float(np.min(room / np.maximum(high - low, 1e-9)))
    middle = 0.5 * np.array([WIDTH, _HEIGHT]) - scale * 0.5 * (low + high)
    return lambda of: np.asarray(scale * (of @ best.T) + middle)


def _arms(cell: CellPoses, views: Sequence[ViewResult]) -> Iterator[_Line]:
    """Each arm in the middle one of its views; a straight line without joint angles."""
    for flange, name in cell.frames.robots.items():
        states = [cell.states[flange].get(view.view) for view in views]
        known = [state for state in states if state is not None and not state.is_past]
        if not known:
            continue
        state = known[len(known) // 2]
        links = state.link_frames(cell.models.get(name))
        places = state.pose[None, :3, 3] if links is None else links[:, :3, 3]
        base, arm = cell.frames.parents[flange], np.vstack([np.zeros(3), places])
        yield _Line(base, "muted", 6.0, apply(cell.frames.matrices[base], arm))


def _seen(cell: CellPoses, views: Sequence[ViewResult], size_m: float) -> Iterator[_Line]:
    """Boards and cameras in the views, each place once."""
    drawn = set[tuple[str, bytes]]()
    for view in views:
        for frame in (view.seen or "target", view.seer or "cam"):
            pose = cell.in_cell(frame, view.view, past=False)
            if pose is None or (place := (frame, pose.round(4).tobytes())) in drawn:
                continue
            drawn.add(place)
            camera, board = cell.cameras.get(frame), cell.boards.get(frame)
            if camera is not None:
                width, height = camera.resolution
                px = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
                rays = size_m * px @ np.linalg.inv(matrix_3x3(camera)).T
                # The pyramid in one line; 0 is the camera's centre.
                ends = np.vstack([np.zeros(3), rays])[[0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2]]
                yield _Line(frame, "accent", 1.0, apply(pose, ends))
            elif board is not None:
                yield _Line(frame, "good", 1.0, apply(pose, closed_outline(board)))
