"""A simulated cell of several robots, cameras and boards: what really is and what is reported."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.session import frame_name
from visioncal.simulation.arms import arm_named, forward
from visioncal.simulation.boards import Sheet
from visioncal.simulation.cell import detected, misreported, seen_in
from visioncal.simulation.draws import Stream
from visioncal.simulation.layout import NetworkOptions
from visioncal.simulation.observed_points import (
    Network,
    Reading,
    Sight,
    board_named,
    camera_named,
    with_faults,
)
from visioncal.simulation.options import CellOptions
from visioncal.simulation.poses import draw_views
from visioncal.simulation.second import looks_at
from visioncal.simulation.standing import mounted, parents_of, postures
from visioncal.simulation.sweep import sweep_network
from visioncal.simulation.warmup import Heat, heated_flanges, warm_up


def simulate_network(options: NetworkOptions) -> Network:
    """Builds a cell of several robots, moves them, and looks at the boards.

    Args:
        options: What the cell is made of. The same options give the same cell.

    Raises:
        DataError: A robot cannot reach enough poses at which it shows a board to a camera.
    """
    parents, transforms = parents_of(options), mounted(options)
    moved = postures(options, transforms)
    arms = {robot.name: arm_named(robot.robot) for robot in options.robots}
    true_arms, flanges, joints, heat = {}, {}, {}, {}
    wrong_stops: dict[str, tuple[int, ...]] = {}
    stamps_s = np.arange(options.stops, dtype=np.float64) * options.pace_s
    for at, robot in enumerate(options.robots):
        name, q = robot.name, moved[robot.name]
        true = robot.built(options.stream(Stream.ARMS, at))
        loads, approach = robot.loads(options.stops), robot.approach(options.stops)
        stood = robot.flange_at(true, q, loads, approach)
        if robot.warms_up:
            heats, hours = Heat.drawn(options.seed + at), stamps_s[-1] / 3600.0
            warming = warm_up(heats, hours, seed=options.seed + at)
            stood = heated_flanges(true, heats, q, warming.at(stamps_s), stood)
            heat[f"{name}_heat"] = warming.recorded(temperatures=True)
        true_arms[name] = true
        flanges[name] = stood @ robot.jitter(options.stops, options.stream(Stream.ROBOTS, at))
        rng = options.stream(Stream.WRONG, at)
        joints[name], wrong_stops[name] = misreported(arms[name], q, robot.wrong_stops, rng)
    cell = Network(
        options=options,
        parents=parents,
        transforms=transforms,
        arms=arms,
        true_arms=true_arms,
        stated={
            camera.name: camera.stated(options.stream(Stream.LENS, at))
            for at, camera in enumerate(options.cameras)
        },
        joints=joints,
        base_from_flange={name: forward(arm, joints[name]) for name, arm in arms.items()},
        true_base_from_flange=flanges,
        sights=(),
        readings=(),
        pose_rows=(),
        wrong_views=(),
        wrong_stops=wrong_stops,
        stamps_s=stamps_s if options.pace_s else None,
        loads={
            robot.name: robot.loads(options.stops) for robot in options.robots if robot.payloads
        },
        approach={
            robot.name: sides
            for robot in options.robots
            if (sides := robot.approach(options.stops)) is not None
        },
        streams=heat,
    )
    cell = with_faults(_observed(cell))
    last = {name: array[-1] for name, array in _hanging(cell).items()}
    for swept in options.sweeps:
        taken = [sight.view for sight in cell.sights] + [reading.view for reading in cell.readings]
        first = 1 + max([*taken, *(row[0] for row in cell.pose_rows)], default=-1)
        sights, recorded = sweep_network(cell, swept, last, first)
        streams = {**cell.streams, swept.robot: recorded}
        cell = replace(cell, sights=(*cell.sights, *sights), streams=streams)
    return cell


def _observed(cell: Network) -> Network:
    """Adds what cameras and instruments see, stop by stop, and numbers the rows."""
    options, where = cell.options, _places(cell)
    poses = {
        (camera.name, board.name): invert(where[frame_name("camera", camera.name)])
        @ where[frame_name("target", board.name)]
        for camera in options.cameras
        for board in options.boards
        if camera.at_stops
    }
    shown = {key: _shown(cell, *key, pose) for key, pose in poses.items()}
    sights: list[Sight] = []
    readings: list[Reading] = []
    pose_rows: list[tuple[int, int, str]] = []
    view = 0
    for stop in range(options.stops):
        needed: dict[str, bool] = {}
        for (camera, board), pose in poses.items():
            if shown[camera, board][stop]:
                sights.append(_sight(cell, view, stop, camera, board, pose[stop]))
                _need(cell, needed, frame_name("camera", camera), frame_name("target", board))
                view += 1
        for reading in _read(cell, where, stop, view):
            readings.append(reading)
            _need(cell, needed, frame_name("point", reading.point), "")
            view += 1
        for robot in [name for name, is_given in needed.items() if not is_given]:
            pose_rows.append((view, stop, robot))
            view += 1
    sights += _of_lenses(cell, view)
    return replace(cell, sights=tuple(sights), readings=tuple(readings), pose_rows=tuple(pose_rows))


def _need(cell: Network, needed: dict[str, bool], first: str, second: str) -> None:
    """Notes the robots between two frames, and that the row has the pose of the first of them."""
    robots = [
        arm for frame in (first, second) if frame and (arm := cell.robot_of(frame)) is not None
    ]
    if len(set(robots)) < len(robots):
        return
    for place, robot in enumerate(robots):
        needed[robot] = needed.get(robot, False) or place == 0


def _hanging(cell: Network) -> dict[str, FloatArray]:
    """(s, 4, 4) where each frame hangs in its parent, stop by stop."""
    stops = cell.options.stops
    hangs = {name: np.tile(transform, (stops, 1, 1)) for name, transform in cell.transforms.items()}
    for at, moved in enumerate(cell.options.moved):
        if moved.frame not in hangs:
            raise DataError(
                f"simulation: {moved.frame!r} cannot be pushed; there are {', '.join(hangs)}."
            )
        start = cell.options.first_pushed(moved)
        twist = cell.options.stream(Stream.FAULTS, 10 + at).standard_normal((2, 3))
        twist *= np.array([[moved.turn_rad], [moved.shift_m]]) / np.linalg.norm(
            twist, axis=1, keepdims=True
        )
        hangs[moved.frame][start:] = hangs[moved.frame][start:] @ exp(twist.ravel())
    return hangs


def _places(cell: Network) -> dict[str, FloatArray]:
    """(s, 4, 4) where each frame really is in the cell, stop by stop."""
    hangs = _hanging(cell)
    for robot in cell.options.robots:
        base = hangs[frame_name("base", robot.name)]
        flange = frame_name("flange", robot.name)
        hangs[flange] = base @ cell.true_base_from_flange[robot.name]
    for frame, parent in cell.parents.items():
        if parent.startswith("flange_"):
            hangs[frame] = hangs[parent] @ hangs[frame]
    return hangs


def _shown(cell: Network, camera: str, board: str, pose: FloatArray) -> FloatArray:
    """(s,) at which stops a camera has a board in its image, and it is recorded."""
    options = cell.options
    seen = looks_at(camera_named(options, camera).camera, board_named(options, board), pose)
    places = (
        [camera_at.name for camera_at in options.cameras].index(camera),
        [board_at.name for board_at in options.boards].index(board),
    )
    kept = options.stream(Stream.SHARE, *places).random(options.stops) < options.share_seen
    return np.asarray(seen & kept)


def _sight(cell: Network, view: int, stop: int, camera: str, board: str, pose: FloatArray) -> Sight:
    """What a camera sees of a board, corner by corner."""
    options = cell.options
    sheet = board_named(options, board)
    exact = seen_in(camera_named(options, camera), sheet, pose, view)
    found = detected(exact, options.pixel_sigma_px, options.stream(Stream.CORNERS, view))
    found = _as_detected(sheet, found)
    draws = options.stream(Stream.MEASURED, view).standard_normal(6)
    return Sight(view, stop, camera, board, pose, exact, found, draws)


def _as_detected(sheet: Sheet, found: Corners) -> Corners:
    """A detector begins a board that looks alike from both ends at the upper left."""
    if not is_symmetric(sheet.target) or found.px[0].sum() <= found.px[-1].sum():
        return found
    last = sheet.target.columns * sheet.target.rows - 1
    return replace(found, ids=(last - found.ids)[::-1], px=found.px[::-1])


def is_symmetric(target: Target) -> bool:
    """Whether a board looks alike when it is turned by half a turn."""
    if target.kind == "circles":
        return not target.asymmetric or target.rows % 2 == 0
    return target.kind == "checkerboard" and (target.columns + target.rows) % 2 == 0


def _of_lenses(cell: Network, first_view: int) -> list[Sight]:
    """Images of a board that is held by hand before each camera, for its lens alone."""
    options = cell.options
    found: list[Sight] = []
    for place, camera in enumerate(options.cameras):
        board, rng = options.boards[0], options.stream(Stream.LENS_VIEWS, place)
        views = np.empty((0, 4, 4))
        drawing = CellOptions(target=board.target, camera=camera.camera, cut_views=0.0)
        while len(views) < options.lens_views:
            more = draw_views(drawing, board, 4 * options.lens_views, rng)
            views = np.concatenate([views, more])
        for pose in views[: options.lens_views]:
            view = first_view + len(found)
            found.append(_sight(cell, view, -1, camera.name, board.name, pose))
    return found


def _read(
    cell: Network, where: Mapping[str, FloatArray], stop: int, first_view: int
) -> list[Reading]:
    """What instruments read at a stop."""
    found: list[Reading] = []
    for instrument in cell.options.instruments:
        instrument_from_cell = invert(where[frame_name("instrument", instrument.name)][stop])
        for point in cell.options.points:
            view = first_view + len(found)
            rng = cell.options.stream(Stream.READINGS, view)
            read = instrument_from_cell @ where[frame_name("point", point.name)][stop]
            read[:3, 3] += instrument.sigma_m * rng.standard_normal(3)
            turn = instrument.sigma_rad * rng.standard_normal(3)
            read[:3, :3] = read[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
            found.append(Reading(view, stop, instrument.name, point.name, read))
    return found
