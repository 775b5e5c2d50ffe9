"""Poses of the components of simulated cells, and postures of the robots that show boards."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.session import frame_name
from visioncal.simulation.arms import (
    DhArm,
    arm_named,
    drawn_postures,
    forward,
    inverse,
    link_frames,
    reach_m,
)
from visioncal.simulation.boards import Sheet, centre_m
from visioncal.simulation.layout import (
    CELL,
    MIDDLE_M,
    CellOptions,
    NetworkOptions,
    RandomStream,
    RobotAt,
)
from visioncal.simulation.poses import Viewpoints, filling_m, looking_at

# Smallest dexterity at which a posture is far enough from a singularity.
LEAST_DEXTERITY = 0.04
# Bounds of the smallest and of the largest distance of a fixed camera [m].
_NEAR_M, _FAR_M = (0.7, 1.0), (1.0, 1.2)
# Number of tries before another camera or board is chosen.
_CHANGE = 6
# Range of a held board's distance from a fixed camera's aim [m].
_DEPTH_M = 0.15


def home_posture(arm: DhArm, base_from_flange: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n,) most dexterous posture at one pose (1, 4, 4), from which all views start.

    Raises:
        DataError: The arm cannot reach the pose.
    """
    starts = rng.uniform(-np.pi, np.pi, size=(64, arm.a.size))
    reach = inverse(arm, np.tile(base_from_flange, (64, 1, 1)), starts)
    elbow_up = link_frames(arm, reach.joints)[:, 2, 2, 3] > arm.d[0]
    merit = np.where(reach.solved & elbow_up, reach.dexterity, 0.0)
    if not merit.any():
        raise DataError(
            f"simulation: the {arm.name} cannot reach the middle of the views.",
            next_step="Take another working distance, board or robot.",
        )
    best = reach.joints[np.argmax(merit)]
    # All joints within half a turn.
    return np.asarray((best + np.pi) % (2.0 * np.pi) - np.pi)


def _reachable(
    arm: DhArm, base_from_flange: FloatArray, starts: FloatArray, floor_m: float
) -> tuple[FloatArray, Mask]:
    """(m, n) postures [rad] at (m, 4, 4) poses, and (m,) mask of acceptable ones."""
    reach = inverse(arm, base_from_flange, starts)
    good = reach.solved & (reach.dexterity > LEAST_DEXTERITY)
    return reach.joints, np.asarray(good & (lowest_m(arm, reach.joints) > floor_m))


def lowest_m(arm: DhArm, joints: FloatArray) -> FloatArray:
    """(m,) height of the lowest of elbow, wrists and flange over the base [m]."""
    return np.asarray(link_frames(arm, joints)[:, 2:, 2, 3].min(axis=1))


def mounted_single(options: CellOptions) -> dict[str, FloatArray]:
    """(4, 4) poses of camera and boards on their parents, plausible for the arm's size."""
    rng, reach = options.stream(RandomStream.MOUNTING), reach_m(arm_named(options.robot))
    first, *further = options.layout.boards
    front, spin = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4)
    skewed = _skew(rng, 0.05)
    straight = _viewpoints(options, first).mean()
    ahead = 0.6 * reach * np.array([np.cos(front), np.sin(front), 1.0])
    if options.mount == "eye-in-hand":
        aside = rng.uniform([0.05, -0.02, 0.03], [0.09, 0.02, 0.07])
        cam = compose((Rotation.from_euler("z", 0.5 * np.pi) * skewed).as_matrix(), aside)
        # The target's z points into the table.
        rotation = Rotation.from_euler("ZX", [front + spin, np.pi]).as_matrix()
        # The table is low enough to view the board from a comfortable height.
        middle = np.array([*ahead[:2], min(0.0, 0.4 * reach - float(straight[2, 3]))])
    else:
        rotation = (Rotation.from_euler("ZX", [spin, np.pi]) * skewed).as_matrix()
        middle = np.array([0.0, 0.0, 0.06]) + rng.normal(0.0, 0.005, 3)
        direction = np.array([np.cos(front + spin), np.sin(front + spin), 0.35])
        if arm_named(options.robot).is_planar:
            # Its flange points downwards.
            direction = np.array([0.1, 0.0, -1.0])
        distance_m = float(np.linalg.norm(straight[:3, 3]))
        cam = looking_at(ahead, direction / np.linalg.norm(direction), distance_m)
    target = compose(rotation, middle - rotation @ centre_m(first))
    placed = {"cam": cam, frame_name("target", first.name): target}
    if (second := options.second) is not None:
        middle = target[:3, :3] @ centre_m(first) + target[:3, 3]
        rotation_z = Rotation.from_euler("z", second.turn_rad).as_matrix()
        if options.mount == "eye-in-hand":
            position = rotation_z @ middle
            lean = np.cross([0.0, 0.0, 1.0], position / np.linalg.norm(position))
            # The print faces the base, as the arm comes from there.
            leant = Rotation.from_rotvec(-second.tilt_rad * lean).as_matrix() @ rotation_z
        else:
            aside = rotation_z @ np.array([1.0, 0.0, 0.0])
            # Beside the first board [m].
            position = middle + 0.10 * aside
            lean = np.cross([0.0, 0.0, 1.0], aside)
            leant = Rotation.from_rotvec(second.tilt_rad * lean).as_matrix()
        rotation = leant @ target[:3, :3]
        placed[frame_name("target", further[0].name)] = compose(
            rotation, position - rotation @ centre_m(second)
        )
    return placed


def postures_single(options: CellOptions, placed: Mapping[str, FloatArray]) -> FloatArray:
    """(s, n) postures of the nominal arm, aimed at the boards in turn [rad]; raises DataError."""
    arm, boards, cam = arm_named(options.robot), options.layout.boards, placed["cam"]
    in_hand = options.mount == "eye-in-hand"
    joints = np.zeros((options.views, arm.a.size))
    for index, board in enumerate(boards):
        stops = np.arange(index, options.views, len(boards))
        target = placed[frame_name("target", board.name)]
        rng = options.stream(RandomStream.POSES, *([index] if index else []))

        def flange(cam_from_target: FloatArray, target: FloatArray = target) -> FloatArray:
            """(m, 4, 4) `base_from_flange` for board poses in the camera frame."""
            if in_hand:
                return target @ invert(cam_from_target) @ invert(cam)
            return cam @ cam_from_target @ invert(target)

        if arm.is_planar:
            # It reaches no pose that is drawn for it, and so its joints are drawn.
            views = _viewpoints(options, board)
            joints[stops] = _showing(arm, views, cam, target, stops, rng, in_hand=in_hand)
            continue
        # The arm must stay 50 mm above the table under the board, and above the robot's own.
        floor_m = min(0.0, float(target[2, 3]) if in_hand else 0.0) + 0.05
        views = _viewpoints(options, board)
        home = home_posture(arm, flange(views.mean()[None]), rng)
        kept: list[FloatArray] = []
        for _ in range(50):
            drawn = views.draw(4 * len(stops), rng)
            if not len(drawn):
                continue
            starts = np.tile(home, (len(drawn), 1))
            if options.branches:
                starts = rng.uniform(-np.pi, np.pi, starts.shape)
            reached, good = _reachable(arm, flange(drawn), starts, floor_m)
            kept.extend(reached[good])
            if len(kept) >= len(stops):
                break
        else:
            raise DataError(
                f"simulation: {len(kept)} of {len(stops)} views found in which the {arm.name} "
                "reaches its pose and the camera sees the board.",
                next_step="Take another working distance, board, tilt or robot.",
            )
        joints[stops] = kept[: len(stops)]
    return joints


def _showing(
    arm: DhArm,
    views: Viewpoints,
    cam: FloatArray,
    target: FloatArray,
    stops: IntArray,
    rng: np.random.Generator,
    *,
    in_hand: bool = True,
) -> FloatArray:
    """(s, n) postures of an arm that cannot tilt, in which the camera sees all of the board."""
    kept = np.zeros((0, arm.a.size))
    for _ in range(100):
        drawn = drawn_postures(arm, 2000, rng)
        flange = forward(arm, drawn)
        placed = invert(flange @ cam) @ target if in_hand else invert(cam) @ flange @ target
        kept = np.concatenate([kept, drawn[views.shows(placed)]])
        if len(kept) >= len(stops):
            return kept[: len(stops)]
    raise DataError(
        f"simulation: {len(kept)} of {len(stops)} views found in which the {arm.name} shows the "
        "board.",
        next_step="Take another working distance, board or robot.",
    )


def _viewpoints(options: CellOptions, board: Sheet) -> Viewpoints:
    """Range of viewpoints towards a board of a single camera's cell."""
    distance_m = options.distance_m
    if distance_m is None:
        near, far = filling_m(options.camera, board)
        if options.mount == "eye-to-hand":
            near, far = min(max(near, _NEAR_M[0]), _NEAR_M[1]), min(max(far, _FAR_M[0]), _FAR_M[1])
        distance_m = near, far
    return Viewpoints(
        camera=options.camera,
        board=board,
        distance_m=distance_m,
        tilt_rad=options.tilt_rad,
        roll_rad=options.roll_rad,
        motion=options.motion,
        cut_views=options.cut_views,
    )


def _skew(rng: np.random.Generator, sigma_rad: float) -> Rotation:
    return Rotation.from_rotvec(rng.normal(0.0, sigma_rad, 3))


def mounted(options: NetworkOptions) -> dict[str, FloatArray]:
    """(4, 4) poses of a whole cell's frames on their parents, before any push."""
    rng, placed = options.stream(RandomStream.MOUNTINGS), {}
    for robot in options.robots:
        place = np.array(robot.place_m)
        ahead = np.array(MIDDLE_M) - place
        rotation = Rotation.from_euler("z", np.arctan2(ahead[1], ahead[0])) * _skew(rng, 0.01)
        place = place + rng.normal(0.0, 0.01, 3)
        placed[frame_name("base", robot.name)] = compose(rotation.as_matrix(), place)
    for camera in options.cameras:
        name = frame_name("camera", camera.name)
        if camera.on != CELL:
            aside = rng.uniform([0.05, -0.02, 0.03], [0.09, 0.02, 0.07])
            rotation = Rotation.from_euler("z", 0.5 * np.pi) * _skew(rng, 0.05)
            placed[name] = compose(rotation.as_matrix(), aside)
            continue
        goal = np.array(camera.looks_at_m) + rng.normal(0.0, 0.01, 3)
        away = np.array(camera.place_m) - goal
        # For a camera looking straight down, the cell's y counts as upright.
        away[1] -= 1e-6
        distance = float(np.linalg.norm(away))
        placed[name] = looking_at(goal, away / distance, distance)
    for board in options.boards:
        # The board's z points into its plate.
        rotation = Rotation.from_euler("ZX", [rng.uniform(-0.5, 0.5), np.pi])
        if board.on != CELL:
            rotation = rotation * _skew(rng, 0.05)
            place = np.array([0.0, 0.0, 0.06]) + rng.normal(0.0, 0.005, 3)
        else:
            place = np.array(board.place_m)
            ahead = np.array([*(np.array(MIDDLE_M) - place)[:2], 0.0])
            lean = np.cross([0.0, 0.0, 1.0], ahead / max(float(np.linalg.norm(ahead)), 1e-9))
            rotation = Rotation.from_rotvec(board.tilt_rad * lean) * rotation * _skew(rng, 0.01)
        matrix = rotation.as_matrix()
        placed[frame_name("target", board.name)] = compose(matrix, place - matrix @ centre_m(board))
    for point in options.points:
        placed[frame_name("point", point.name)] = compose(np.eye(3), np.array(point.place_m))
    for instrument in options.instruments:
        turn = Rotation.from_euler("z", instrument.turn_rad).as_matrix()
        name = frame_name("instrument", instrument.name)
        placed[name] = compose(turn, np.array(instrument.place_m))
    return placed


@dataclass(frozen=True, eq=False)
class _Aim:
    """A possible aim of a robot: a camera that sees a board, one of which it carries."""

    base_from_cell: FloatArray  # (4, 4) of the robot.
    cam: FloatArray  # (4, 4) pose of the camera on its parent.
    target: FloatArray  # (4, 4) pose of the board on its parent.
    carries_camera: bool  # Whether the robot carries the camera.
    # (s, 4, 4) poses in the cell of what carries the other of the two; None for the cell itself.
    cell_from_other: FloatArray | None
    views: Viewpoints  # Viewpoints of this camera towards this board.

    def flanges(self, stops: IntArray, cam_from_target: FloatArray) -> FloatArray:
        """(k, 4, 4) `base_from_flange` at k stops for board poses in the camera frame."""
        other = np.eye(4) if self.cell_from_other is None else self.cell_from_other[stops]
        if self.carries_camera:
            cell_from_cam = other @ self.target @ invert(cam_from_target)
            return np.asarray(self.base_from_cell @ cell_from_cam @ invert(self.cam))
        return np.asarray(
            self.base_from_cell @ other @ self.cam @ cam_from_target @ invert(self.target)
        )

    def home(self, arm: DhArm, rng: np.random.Generator, stops: int) -> FloatArray | None:
        """(n,) a central posture; None if the arm cannot reach it."""
        straight = self.views.mean()[None]
        for stop in range(min(stops, 1 if self.cell_from_other is None else 6)):
            try:
                return home_posture(arm, self.flanges(np.array([stop]), straight), rng)
            except DataError:
                continue
        return None


def postures_of(options: NetworkOptions, placed: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """(s, n) postures of each robot's nominal arm with a board in a camera's view [rad].

    Raises:
        DataError: A robot cannot reach enough poses at which it shows a board to a camera.
    """
    joints_by_robot: dict[str, FloatArray] = {}
    # Poses of what carries a camera or a board; robots that are not placed yet carry none.
    carriers: dict[str, FloatArray | None] = {CELL: None}
    for index, robot in enumerate(options.robots):
        arm, rng = arm_named(robot.robot), options.stream(RandomStream.POSTURES, index)
        cell_from_base = placed[frame_name("base", robot.name)]
        aims = []
        for camera in options.cameras:
            for board in options.boards:
                carries_camera = camera.on == robot.name
                other = board.on if carries_camera else camera.on
                if carries_camera == (board.on == robot.name) or other not in carriers:
                    continue
                distance_m = filling_m(camera.camera, board)
                if camera.on == CELL:
                    far = float(np.linalg.norm(np.array(camera.place_m) - camera.looks_at_m))
                    distance_m = far - _DEPTH_M, far + _DEPTH_M
                aims.append(
                    _Aim(
                        invert(cell_from_base),
                        placed[frame_name("camera", camera.name)],
                        placed[frame_name("target", board.name)],
                        carries_camera,
                        carriers[other],
                        Viewpoints(camera=camera.camera, board=board, distance_m=distance_m),
                    )
                )
        if aims:
            joints = _aimed(robot, arm, aims, options.stops, rng)
        else:
            # Robots without an aim move at random.
            joints = rng.uniform(-1.0, 1.0, (options.stops, arm.a.size))
        joints_by_robot[robot.name] = joints
        carriers[robot.name] = cell_from_base @ forward(arm, joints)
    return joints_by_robot


def _aimed(
    robot: RobotAt, arm: DhArm, aims: Sequence[_Aim], count: int, rng: np.random.Generator
) -> FloatArray:
    """(count, n) one posture per stop, for the aims in turn."""
    candidates = [aim.home(arm, rng, count) for aim in aims]
    homes = {index: home for index, home in enumerate(candidates) if home is not None}
    reachable = list(homes)
    chosen = rng.permutation(np.resize(np.array(reachable, dtype=np.int64), count))
    joints = np.zeros((count, arm.a.size))
    pending = np.ones(count, dtype=bool)
    for attempt in range(60 if reachable else 0):
        if attempt % _CHANGE == _CHANGE - 1:
            # The robot may be unable to reach the other component's pose.
            chosen[pending] = rng.choice(reachable, int(pending.sum()))
        for index in np.unique(chosen[pending]):
            aim, stops = aims[index], np.flatnonzero(pending & (chosen == index))
            views = aim.views.draw(4 * len(stops), rng)
            if not len(views):
                continue
            stops = stops[: len(views)]
            goals = aim.flanges(stops, views[: len(stops)])
            starts = np.tile(homes[index], (len(stops), 1))
            # Links stay 20 mm above the base.
            moved, good = _reachable(arm, goals, starts, 0.02)
            joints[stops[good]] = moved[good]
            pending[stops[good]] = False
        if not pending.any():
            return joints
    raise DataError(
        f"simulation: robot {robot.name} reaches {count - int(pending.sum())} of {count} poses at "
        "which a camera sees a board.",
        next_step="Place it, the cameras or the boards elsewhere.",
    )
