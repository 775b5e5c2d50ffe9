"""Poses of the components of a cell of several robots, and the robots' postures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, arm_named, forward
from visioncal.simulation.boards import centre_m
from visioncal.simulation.draws import RandomStream
from visioncal.simulation.layout import CELL, MIDDLE_M, BoardAt, CameraAt, NetworkOptions, RobotAt
from visioncal.simulation.poses import Viewpoints, filling_m, looking_at
from visioncal.simulation.reach import home_posture, reachable_postures

# Minimum height of links over their own base [m].
_LEAST_HEIGHT_M = 0.02
_TRIES = 60
# Number of tries before another camera or board is chosen.
_CHANGE = 6
# Number of stops tried to decide whether a moving board is within reach.
_STOPS_TRIED = 6
# Range of a held board's distance from a fixed camera's aim [m].
_DEPTH_M = 0.15


def parents_of(options: NetworkOptions) -> dict[str, str]:
    """Parent of each frame but the flanges, by its name in a session."""
    parents = {frame_name("base", robot.name): CELL for robot in options.robots if robot.name}
    root = CELL if parents else "base"
    for kind, things in (
        ("camera", options.cameras),
        ("target", options.boards),
        ("point", options.points),
    ):
        for thing in things:
            parent = root if thing.on == CELL else frame_name("flange", thing.on)
            parents[frame_name(kind, thing.name)] = parent
    return parents | {
        frame_name("instrument", instrument.name): root for instrument in options.instruments
    }


def mounted(options: NetworkOptions) -> dict[str, FloatArray]:
    """(4, 4) poses of the frames on their parents, before any push."""
    rng = options.stream(RandomStream.MOUNTINGS)
    placed = {frame_name("base", robot.name): _base(robot, rng) for robot in options.robots}
    placed |= {
        frame_name("camera", camera.name): _camera(camera, rng) for camera in options.cameras
    }
    placed |= {frame_name("target", board.name): _board(board, rng) for board in options.boards}
    for point in options.points:
        placed[frame_name("point", point.name)] = compose(np.eye(3), np.array(point.place_m))
    for instrument in options.instruments:
        rotation = Rotation.from_euler("z", instrument.turn_rad).as_matrix()
        placed[frame_name("instrument", instrument.name)] = compose(
            rotation, np.array(instrument.place_m)
        )
    return placed


def _skew(rng: np.random.Generator, sigma_rad: float) -> Rotation:
    return Rotation.from_rotvec(rng.normal(0.0, sigma_rad, 3))


def _base(robot: RobotAt, rng: np.random.Generator) -> FloatArray:
    place = np.array(robot.place_m)
    ahead = np.array(MIDDLE_M) - place
    rotation = Rotation.from_euler("z", np.arctan2(ahead[1], ahead[0])) * _skew(rng, 0.01)
    return compose(rotation.as_matrix(), place + rng.normal(0.0, 0.01, 3))


def _camera(camera: CameraAt, rng: np.random.Generator) -> FloatArray:
    if camera.on != CELL:
        aside = rng.uniform([0.05, -0.02, 0.03], [0.09, 0.02, 0.07])
        return compose(
            (Rotation.from_euler("z", 0.5 * np.pi) * _skew(rng, 0.05)).as_matrix(), aside
        )
    goal = np.array(camera.looks_at_m) + rng.normal(0.0, 0.01, 3)
    away = np.array(camera.place_m) - goal
    # For a camera looking straight down, the cell's y counts as upright.
    away[1] -= 1e-6
    distance = float(np.linalg.norm(away))
    return looking_at(goal, away / distance, distance)


def _board(board: BoardAt, rng: np.random.Generator) -> FloatArray:
    centre = centre_m(board)
    # The board's z points into its plate.
    rotation = Rotation.from_euler("ZX", [rng.uniform(-0.5, 0.5), np.pi])
    if board.on != CELL:
        matrix = (rotation * _skew(rng, 0.05)).as_matrix()
        held = np.array([0.0, 0.0, 0.06]) + rng.normal(0.0, 0.005, 3)
        return compose(matrix, held - matrix @ centre)
    place = np.array(board.place_m)
    ahead = np.array([*(np.array(MIDDLE_M) - place)[:2], 0.0])
    lean = np.cross([0.0, 0.0, 1.0], ahead / max(float(np.linalg.norm(ahead)), 1e-9))
    matrix = (Rotation.from_rotvec(board.tilt_rad * lean) * rotation * _skew(rng, 0.01)).as_matrix()
    return compose(matrix, place - matrix @ centre)


@dataclass(frozen=True, eq=False)
class _Aim:
    """A possible aim of a robot: a camera that sees a board, one of which it carries."""

    camera: CameraAt  # The camera.
    board: BoardAt  # The board.
    carries_camera: bool  # Whether the robot carries the camera.
    other: str  # Robot that carries the other of the two; `cell` for none.
    views: Viewpoints  # Viewpoints of this camera towards this board.


def _aims(options: NetworkOptions, robot: RobotAt, stand: Sequence[str]) -> list[_Aim]:
    """Possible aims of a robot, given the robots that are already placed."""
    aims = []
    for camera in options.cameras:
        for board in options.boards:
            if (camera.on == robot.name) == (board.on == robot.name):
                continue
            carries_camera = camera.on == robot.name
            other = board.on if carries_camera else camera.on
            if other == CELL or other in stand:
                views = _viewpoints(camera, board)
                aims.append(_Aim(camera, board, carries_camera, other, views))
    return aims


def _viewpoints(camera: CameraAt, board: BoardAt) -> Viewpoints:
    """Range of viewpoints of a camera towards a board."""
    distance_m = filling_m(camera.camera, board)
    if camera.on == CELL:
        far = float(np.linalg.norm(np.array(camera.place_m) - camera.looks_at_m))
        distance_m = far - _DEPTH_M, far + _DEPTH_M
    return Viewpoints(camera=camera.camera, board=board, distance_m=distance_m)


def postures(options: NetworkOptions, placed: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """(s, n) postures of each robot's nominal arm with a board in a camera's view [rad].

    Raises:
        DataError: A robot cannot reach enough poses at which it shows a board to a camera.
    """
    joints_by_robot: dict[str, FloatArray] = {}
    flanges: dict[str, FloatArray] = {}
    for index, robot in enumerate(options.robots):
        aims = _aims(options, robot, list(joints_by_robot))
        arm, rng = arm_named(robot.robot), options.stream(RandomStream.POSTURES, index)
        if aims:
            joints = _aimed_postures(options, robot, arm, aims, placed, flanges, rng)
        else:
            # Robots without an aim move at random.
            joints = rng.uniform(-1.0, 1.0, (options.stops, arm.a.size))
        joints_by_robot[robot.name] = joints
        base = placed[frame_name("base", robot.name)]
        flanges[robot.name] = base @ forward(arm, joints)
    return joints_by_robot


def _aimed_postures(
    options: NetworkOptions,
    robot: RobotAt,
    arm: DhArm,
    aims: Sequence[_Aim],
    placed: Mapping[str, FloatArray],
    flanges: Mapping[str, FloatArray],
    rng: np.random.Generator,
) -> FloatArray:
    """(s, n) one posture per stop, for the aims in turn."""
    count = options.stops
    candidates = [_home(robot, arm, aim, placed, flanges, rng, count) for aim in aims]
    homes = {index: home for index, home in enumerate(candidates) if home is not None}
    reachable = list(homes)
    chosen = rng.permutation(np.resize(np.array(reachable, dtype=np.int64), count))
    joints = np.zeros((count, arm.a.size))
    pending = np.ones(count, dtype=bool)
    for attempt in range(_TRIES if reachable else 0):
        if attempt % _CHANGE == _CHANGE - 1:
            # The robot may be unable to reach the other component's pose.
            chosen[pending] = rng.choice(reachable, int(pending.sum()))
        for index in np.unique(chosen[pending]):
            aim, stops = aims[index], np.flatnonzero(pending & (chosen == index))
            views = aim.views.draw(4 * len(stops), rng)
            if not len(views):
                continue
            stops = stops[: len(views)]
            goals = _flanges(robot, aim, placed, flanges, stops, views[: len(stops)])
            starts = np.tile(homes[index], (len(stops), 1))
            moved, good = reachable_postures(arm, goals, starts, _LEAST_HEIGHT_M)
            joints[stops[good]] = moved[good]
            pending[stops[good]] = False
        if not pending.any():
            return joints
    raise DataError(
        f"simulation: robot {robot.name} reaches {count - int(pending.sum())} of {count} poses at "
        "which a camera sees a board.",
        next_step="Place it, the cameras or the boards elsewhere.",
    )


def _home(
    robot: RobotAt,
    arm: DhArm,
    aim: _Aim,
    placed: Mapping[str, FloatArray],
    flanges: Mapping[str, FloatArray],
    rng: np.random.Generator,
    stops: int,
) -> FloatArray | None:
    """(n,) a central posture for an aim; None if the robot cannot reach it."""
    straight = aim.views.mean()[None]
    for stop in range(min(stops, 1 if aim.other == CELL else _STOPS_TRIED)):
        middle = _flanges(robot, aim, placed, flanges, np.array([stop]), straight)
        try:
            return home_posture(arm, middle, rng)
        except DataError:
            continue
    return None


def _flanges(
    robot: RobotAt,
    aim: _Aim,
    placed: Mapping[str, FloatArray],
    flanges: Mapping[str, FloatArray],
    stops: IntArray,
    cam_from_target: FloatArray,
) -> FloatArray:
    """(k, 4, 4) `base_from_flange` of a robot for board poses in the camera frame."""
    base_from_cell = invert(placed[frame_name("base", robot.name)])
    cell_from_other = np.eye(4) if aim.other == CELL else flanges[aim.other][stops]
    cam, target = (
        placed[frame_name("camera", aim.camera.name)],
        placed[frame_name("target", aim.board.name)],
    )
    if aim.carries_camera:
        cell_from_cam = cell_from_other @ target @ invert(cam_from_target)
        return np.asarray(base_from_cell @ cell_from_cam @ invert(cam))
    return np.asarray(base_from_cell @ cell_from_other @ cam @ cam_from_target @ invert(target))
