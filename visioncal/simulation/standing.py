"""Where things hang in a simulated cell of several robots, and the postures that they move to."""

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
from visioncal.simulation.reach import home_posture, reached

# No link comes lower over its own base than this [m].
_LEAST_HEIGHT_M = 0.02
_TRIES = 60
# After so many tries another camera or board is aimed at.
_CHANGE = 6
# How many stops are looked at to find whether a moving board is in reach.
_STOPS_TRIED = 6
# A board on a flange is looked at from as near or as far as this from the middle [m].
_DEPTH_M = 0.15


def parents_of(options: NetworkOptions) -> dict[str, str]:
    """What each frame but the flanges hangs on, by its name in a session."""
    parents = {frame_name("base", robot.name): CELL for robot in options.robots if robot.name}
    root = CELL if parents else "base"
    for kind, things in (
        ("camera", options.cameras),
        ("target", options.boards),
        ("point", options.points),
    ):
        for thing in things:
            on = root if thing.on == CELL else frame_name("flange", thing.on)
            parents[frame_name(kind, thing.name)] = on
    return parents | {
        frame_name("instrument", instrument.name): root for instrument in options.instruments
    }


def mounted(options: NetworkOptions) -> dict[str, FloatArray]:
    """(4, 4) where each frame hangs in its parent, before anything is pushed."""
    rng = options.stream(RandomStream.MOUNTINGS)
    placed = {frame_name("base", robot.name): _base(robot, rng) for robot in options.robots}
    placed |= {
        frame_name("camera", camera.name): _camera(camera, rng) for camera in options.cameras
    }
    placed |= {frame_name("target", board.name): _board(board, rng) for board in options.boards}
    for point in options.points:
        placed[frame_name("point", point.name)] = compose(np.eye(3), np.array(point.place_m))
    for instrument in options.instruments:
        turn = Rotation.from_euler("z", instrument.turn_rad).as_matrix()
        placed[frame_name("instrument", instrument.name)] = compose(
            turn, np.array(instrument.place_m)
        )
    return placed


def _skew(rng: np.random.Generator, sigma_rad: float) -> Rotation:
    return Rotation.from_rotvec(rng.normal(0.0, sigma_rad, 3))


def _base(robot: RobotAt, rng: np.random.Generator) -> FloatArray:
    place = np.array(robot.place_m)
    ahead = np.array(MIDDLE_M) - place
    turn = Rotation.from_euler("z", np.arctan2(ahead[1], ahead[0])) * _skew(rng, 0.01)
    return compose(turn.as_matrix(), place + rng.normal(0.0, 0.01, 3))


def _camera(camera: CameraAt, rng: np.random.Generator) -> FloatArray:
    if camera.on != CELL:
        aside = rng.uniform([0.05, -0.02, 0.03], [0.09, 0.02, 0.07])
        return compose(
            (Rotation.from_euler("z", 0.5 * np.pi) * _skew(rng, 0.05)).as_matrix(), aside
        )
    goal = np.array(camera.looks_at_m) + rng.normal(0.0, 0.01, 3)
    away = np.array(camera.place_m) - goal
    # A camera above all has no upright; it takes the cell's y for that.
    away[1] -= 1e-6
    distance = float(np.linalg.norm(away))
    return looking_at(goal, away / distance, distance)


def _board(board: BoardAt, rng: np.random.Generator) -> FloatArray:
    centre = centre_m(board)
    # The board's z points into its plate.
    turn = Rotation.from_euler("ZX", [rng.uniform(-0.5, 0.5), np.pi])
    if board.on != CELL:
        turned = (turn * _skew(rng, 0.05)).as_matrix()
        held = np.array([0.0, 0.0, 0.06]) + rng.normal(0.0, 0.005, 3)
        return compose(turned, held - turned @ centre)
    place = np.array(board.place_m)
    ahead = np.array([*(np.array(MIDDLE_M) - place)[:2], 0.0])
    lean = np.cross([0.0, 0.0, 1.0], ahead / max(float(np.linalg.norm(ahead)), 1e-9))
    turned = (Rotation.from_rotvec(board.tilt_rad * lean) * turn * _skew(rng, 0.01)).as_matrix()
    return compose(turned, place - turned @ centre)


@dataclass(frozen=True, eq=False)
class _Aim:
    """What a robot can move for: a camera that sees a board, one of which is on its flange.

    Attributes:
        camera: The camera.
        board: The board.
        carries_camera: Whether it is the camera that the robot carries.
        other: The robot that carries the other of the two; `cell` for none.
        views: From where this camera is to look at this board.
    """

    camera: CameraAt
    board: BoardAt
    carries_camera: bool
    other: str
    views: Viewpoints


def _aims(options: NetworkOptions, robot: RobotAt, stand: Sequence[str]) -> list[_Aim]:
    """What a robot can move for, while those robots stand already."""
    found = []
    for camera in options.cameras:
        for board in options.boards:
            if (camera.on == robot.name) == (board.on == robot.name):
                continue
            carries_camera = camera.on == robot.name
            other = board.on if carries_camera else camera.on
            if other == CELL or other in stand:
                views = _viewpoints(camera, board)
                found.append(_Aim(camera, board, carries_camera, other, views))
    return found


def _viewpoints(camera: CameraAt, board: BoardAt) -> Viewpoints:
    """From where a camera is to look at a board."""
    distance_m = filling_m(camera.camera, board)
    if camera.on == CELL:
        far = float(np.linalg.norm(np.array(camera.place_m) - camera.looks_at_m))
        distance_m = far - _DEPTH_M, far + _DEPTH_M
    return Viewpoints(camera=camera.camera, board=board, distance_m=distance_m)


def postures(options: NetworkOptions, placed: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """(s, n) postures of each robot's nominal arm, at which cameras see boards [rad].

    Raises:
        DataError: A robot cannot reach enough poses at which it shows a board to a camera.
    """
    found: dict[str, FloatArray] = {}
    flanges: dict[str, FloatArray] = {}
    for at, robot in enumerate(options.robots):
        aims = _aims(options, robot, list(found))
        arm, rng = arm_named(robot.robot), options.stream(RandomStream.POSTURES, at)
        if aims:
            joints = _reached(options, robot, arm, aims, placed, flanges, rng)
        else:
            # What sees nothing moves all the same.
            joints = rng.uniform(-1.0, 1.0, (options.stops, arm.a.size))
        found[robot.name] = joints
        base = placed[frame_name("base", robot.name)]
        flanges[robot.name] = base @ forward(arm, joints)
    return found


def _reached(
    options: NetworkOptions,
    robot: RobotAt,
    arm: DhArm,
    aims: Sequence[_Aim],
    placed: Mapping[str, FloatArray],
    flanges: Mapping[str, FloatArray],
    rng: np.random.Generator,
) -> FloatArray:
    """(s, n) one posture a stop, for its aims in turn."""
    count = options.stops
    found = [_home(robot, arm, aim, placed, flanges, rng, count) for aim in aims]
    homes = {at: home for at, home in enumerate(found) if home is not None}
    reachable = list(homes)
    chosen = rng.permutation(np.resize(np.array(reachable, dtype=np.int64), count))
    joints = np.zeros((count, arm.a.size))
    left = np.ones(count, dtype=bool)
    for turn in range(_TRIES if reachable else 0):
        if turn % _CHANGE == _CHANGE - 1:
            # Where the other of the two is, this robot may not reach it.
            chosen[left] = rng.choice(reachable, int(left.sum()))
        for at in np.unique(chosen[left]):
            aim, stops = aims[at], np.flatnonzero(left & (chosen == at))
            views = aim.views.draw(4 * len(stops), rng)
            if not len(views):
                continue
            stops = stops[: len(views)]
            goals = _flanges(robot, aim, placed, flanges, stops, views[: len(stops)])
            starts = np.tile(homes[at], (len(stops), 1))
            moved, good = reached(arm, goals, starts, _LEAST_HEIGHT_M)
            joints[stops[good]] = moved[good]
            left[stops[good]] = False
        if not left.any():
            return joints
    raise DataError(
        f"simulation: robot {robot.name} reaches {count - int(left.sum())} of {count} poses at "
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
    """(n,) a posture in the middle of an aim's; None where the robot does not reach that."""
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
    """(k, 4, 4) `base_from_flange` of a robot at which the camera sees the board so."""
    base_from_cell = invert(placed[frame_name("base", robot.name)])
    before = np.eye(4) if aim.other == CELL else flanges[aim.other][stops]
    cam, target = (
        placed[frame_name("camera", aim.camera.name)],
        placed[frame_name("target", aim.board.name)],
    )
    if aim.carries_camera:
        cell_from_cam = before @ target @ invert(cam_from_target)
        return np.asarray(base_from_cell @ cell_from_cam @ invert(cam))
    return np.asarray(base_from_cell @ before @ cam @ cam_from_target @ invert(target))
