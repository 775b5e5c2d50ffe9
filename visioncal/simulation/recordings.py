"""Recordings of a simulated cell: at stops, in a sweep, or while its arm warms up.

Camera and controller have separate clocks. In a sweep the joints have continuous acceleration; the
camera takes frames at its own rate, and the controller reports joints and poses at a higher one.
Faults of mounting, motion and rows are planted while a cell is observed.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.transforms import apply, compose, exp, invert
from visioncal.core.types import Corners, FloatArray, Mask
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, arm_named, forward, inverse
from visioncal.simulation.boards import EDGE_PX, LEAST_COSINE, corners_m, detected
from visioncal.simulation.cell import (
    InstrumentReading,
    SimulatedCell,
    SimulatedRobot,
    SimulatedSight,
)
from visioncal.simulation.heat import Heat, Warming, heated_flanges, warm_up
from visioncal.simulation.layout import CellOptions, NetworkOptions, RandomStream, SweepOptions
from visioncal.simulation.optics import inaccurate_camera, project, sees
from visioncal.simulation.passages import Passage, with_sweep
from visioncal.simulation.poses import LEAST_SHARE, MARGIN_PX, Viewpoints, filling_m
from visioncal.simulation.postures import mounted, mounted_single, postures_of, postures_single
from visioncal.vision.targets import is_seen_in_part

# Corresponding sources of randomness in cells with several robots.
_OF_SEVERAL = {RandomStream.ARM: RandomStream.ARMS, RandomStream.ROBOT: RandomStream.ROBOTS}


def moved_cell(
    options: CellOptions | NetworkOptions,
    mountings: Mapping[str, FloatArray],
    joints_by_robot: Mapping[str, FloatArray],
) -> SimulatedCell:
    """A cell whose robots moved to (s, n) joint angles each [rad], before observations."""
    layout = options.layout
    stamps_s = np.arange(layout.stops, dtype=np.float64) * layout.pace_s
    robots, heat = {}, {}
    for index, robot in enumerate(layout.robots):
        arm, q = arm_named(robot.robot), joints_by_robot[robot.name]
        true_arm = robot.built(_stream(options, RandomStream.ARM, index))
        loads, approach = robot.loads(layout.stops), robot.approach(layout.stops)
        flange_poses = robot.flange_at(true_arm, q, loads, approach)
        if robot.warms_up:
            heats, hours = Heat.drawn(options.seed + index), stamps_s[-1] / 3600.0
            warming = warm_up(heats, hours, seed=options.seed + index)
            flange_poses = heated_flanges(true_arm, heats, q, warming.at(stamps_s), flange_poses)
            heat[f"{robot.name}_heat"] = warming.recorded(temperatures=True)
        jitter = robot.jitter(layout.stops, _stream(options, RandomStream.ROBOT, index))
        rng = _stream(options, RandomStream.WRONG, index)
        joints, wrong_stops = _misreported(arm, q, robot.wrong_stops, rng)
        robots[robot.name] = SimulatedRobot(
            options=robot,
            arm=arm,
            true_arm=true_arm,
            joints=joints,
            base_from_flange=forward(arm, joints),
            true_base_from_flange=flange_poses @ jitter,
            wrong_stops=wrong_stops,
            loads=loads,
            approach=approach,
        )
    return SimulatedCell(
        options=options,
        parents=layout.parents,
        mountings=mountings,
        robots=robots,
        stated={
            camera.name: inaccurate_camera(
                camera.camera, camera.lens_mismatch_px, _stream(options, RandomStream.LENS, index)
            )
            for index, camera in enumerate(layout.cameras)
        },
        stamps_s=stamps_s if layout.pace_s else None,
        streams=heat,
    )


def _stream(
    options: CellOptions | NetworkOptions, purpose: RandomStream, index: int
) -> np.random.Generator:
    """Randomness of a component by its index; that of a single robot's cell has no index."""
    if isinstance(options, CellOptions):
        return options.stream(purpose)
    return options.stream(_OF_SEVERAL.get(purpose, purpose), index)


def observed(cell: SimulatedCell) -> SimulatedCell:
    """Adds the observations of cameras and instruments, stop by stop, and numbers the rows."""
    # (s, 4, 4) true poses of the frames in the cell at each stop.
    layout, frames = cell.layout, parent_poses(cell)
    flanges = {frame_name("flange", name): name for name in cell.robots}
    for flange, name in flanges.items():
        base = frames.get(frame_name("base", name), np.eye(4))
        frames[flange] = base @ cell.robots[name].true_base_from_flange
    for frame, parent in cell.parents.items():
        if parent in flanges:
            frames[frame] = frames[parent] @ frames[frame]
    poses = {
        (camera.name, board.name): invert(frames[frame_name("camera", camera.name)])
        @ frames[frame_name("target", board.name)]
        for camera in layout.cameras
        for board in layout.boards
        if camera.at_stops
    }
    shown = {key: _shown(cell, *key, pose) for key, pose in poses.items()}
    sights: list[SimulatedSight] = []
    readings: list[InstrumentReading] = []
    pose_rows: list[tuple[int, int, str]] = []
    view = 0
    for stop in range(layout.stops):
        needed: dict[str, bool] = {}
        for (camera, board), pose in poses.items():
            if shown[camera, board][stop]:
                sights.append(_sight(cell, view, stop, camera, board, pose[stop]))
                _need(cell, needed, frame_name("camera", camera), frame_name("target", board))
                view += 1
        for reading in _read(cell, frames, stop, view):
            readings.append(reading)
            _need(cell, needed, frame_name("point", reading.point), "")
            view += 1
        for robot in [name for name, is_given in needed.items() if not is_given]:
            pose_rows.append((view, stop, robot))
            view += 1
    sights += _lens_sights(cell, view)
    cell = replace(cell, readings=tuple(readings), pose_rows=tuple(pose_rows))
    return with_detections(replace(cell, sights=tuple(sights)))


def _sight(
    cell: SimulatedCell, view: int, stop: int, camera: str, board: str, pose: FloatArray
) -> SimulatedSight:
    """A camera's image of a board, with the exact corners inside it."""
    lens, points = cell.camera(camera), apply(pose, corners_m(cell.board(board)))
    ids = np.flatnonzero(sees(lens.camera, points, EDGE_PX)).astype(np.int64)
    exact = Corners(view, ids, project(lens.camera, points[ids]), lens.blur_px)
    return SimulatedSight(view, stop, camera, board, pose, exact, exact)


def with_detections(cell: SimulatedCell) -> SimulatedCell:
    """The cell with detected corners in all its images."""
    options, sights = cell.options, []
    # With one camera, all noise is from one stream.
    common = options.stream(RandomStream.PIXELS)
    for sight in cell.sights:
        is_single = isinstance(options, CellOptions)
        rng = common if is_single else options.stream(RandomStream.CORNERS, sight.view)
        corners = detected(cell.board(sight.board), sight.exact, options.pixel_sigma_px, rng)
        sights.append(replace(sight, corners=corners))
    return replace(cell, sights=tuple(sights))


def _need(cell: SimulatedCell, needed: dict[str, bool], first: str, second: str) -> None:
    """Marks robots between two frames as needed; the row states the pose of the first one."""
    carried = (cell.robot_of(frame) for frame in (first, second) if frame)
    robots = [robot for robot in carried if robot is not None]
    if len(set(robots)) < len(robots):
        return
    for position, robot in enumerate(robots):
        needed[robot] = needed.get(robot, False) or position == 0


def parent_poses(cell: SimulatedCell) -> dict[str, FloatArray]:
    """(s, 4, 4) poses of the frames on their parents at each stop."""
    layout = cell.layout
    poses = {
        name: np.tile(mounting, (layout.stops, 1, 1)) for name, mounting in cell.mountings.items()
    }
    for index, push in enumerate(layout.moved):
        if push.frame not in poses:
            raise DataError(
                f"simulation: {push.frame!r} cannot be pushed; there are {', '.join(poses)}."
            )
        start = layout.first_pushed(push)
        twist = cell.options.stream(RandomStream.FAULTS, 10 + index).standard_normal((2, 3))
        twist *= np.array([[push.turn_rad], [push.shift_m]]) / np.linalg.norm(
            twist, axis=1, keepdims=True
        )
        share = np.repeat([0.0, 1.0], [start, layout.stops - start])
        if push.creeps:
            share = np.linspace(1.0, 0.0, layout.stops)
        poses[push.frame] = poses[push.frame] @ exp(share[:, None] * twist.ravel())
    return poses


def _shown(cell: SimulatedCell, camera: str, board: str, pose: FloatArray) -> Mask:
    """(s,) mask of stops at which a camera's image of a board is recorded."""
    layout, options, sheet = cell.layout, cell.options, cell.board(board)
    # In view, and not too oblique.
    points = apply(pose, corners_m(sheet))
    directions = points / np.linalg.norm(points, axis=2, keepdims=True)
    facing = np.einsum("mni,mi->mn", directions, pose[:, :3, 2]) > LEAST_COSINE
    seen = np.asarray(facing.all(axis=1) & (directions[:, :, 2] > LEAST_COSINE).all(axis=1))
    if seen.any():
        share = sees(cell.camera(camera).camera, points[seen], MARGIN_PX).mean(axis=1)
        seen[seen] = share >= (LEAST_SHARE if is_seen_in_part(sheet.target) else 1.0)
    at_board = [board_at.name for board_at in layout.boards].index(board)
    if isinstance(options, CellOptions):
        # The board that a stop aims at is in view.
        aimed = np.arange(layout.stops) % len(layout.boards) == at_board
        return np.asarray(seen | aimed)
    at_camera = [camera_at.name for camera_at in layout.cameras].index(camera)
    share = options.stream(RandomStream.SHARE, at_camera, at_board).random(options.stops)
    return np.asarray(seen & (share < options.share_seen))


def _lens_sights(cell: SimulatedCell, first_view: int) -> list[SimulatedSight]:
    """Images of a hand-held board before each camera, for its intrinsics only."""
    layout = cell.layout
    sights: list[SimulatedSight] = []
    for index, camera in enumerate(layout.cameras if layout.lens_views else ()):
        board = layout.boards[0]
        distance_m = filling_m(camera.camera, board)
        drawn = Viewpoints(camera=camera.camera, board=board, distance_m=distance_m, cut_views=0.0)
        rng, views = cell.options.stream(RandomStream.LENS_VIEWS, index), np.empty((0, 4, 4))
        while len(views) < layout.lens_views:
            views = np.concatenate([views, drawn.draw(4 * layout.lens_views, rng)])
        for pose in views[: layout.lens_views]:
            view = first_view + len(sights)
            sights.append(_sight(cell, view, -1, camera.name, board.name, pose))
    return sights


def _read(
    cell: SimulatedCell, frames: Mapping[str, FloatArray], stop: int, first_view: int
) -> list[InstrumentReading]:
    readings: list[InstrumentReading] = []
    for instrument in cell.layout.instruments:
        instrument_from_cell = invert(frames[frame_name("instrument", instrument.name)][stop])
        for point in cell.layout.points:
            view = first_view + len(readings)
            rng = cell.options.stream(RandomStream.READINGS, view)
            read = instrument_from_cell @ frames[frame_name("point", point.name)][stop]
            read[:3, 3] += instrument.sigma_m * rng.standard_normal(3)
            rotvec = instrument.sigma_rad * rng.standard_normal(3)
            read[:3, :3] = read[:3, :3] @ Rotation.from_rotvec(rotvec).as_matrix()
            readings.append(InstrumentReading(view, stop, instrument.name, point.name, read))
    return readings


def _misreported(
    arm: DhArm, moved: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, tuple[int, ...]]:
    """Reported angles (s, n) [rad] for the true ones, `moved`, and the wrong stops, ascending.

    At `count` stops the report is off by 5 to 30 mm and 1 to 5 degrees of the nominal arm's flange.
    """
    chosen = np.sort(rng.permutation(len(moved))[:count])
    joints = moved.copy()
    for stop in chosen:
        for _ in range(20):
            rotvec, shift = rng.normal(size=(2, 3))
            rotvec *= np.deg2rad(rng.uniform(1.0, 5.0)) / np.linalg.norm(rotvec)
            shift *= rng.uniform(0.005, 0.030) / np.linalg.norm(shift)
            error = compose(Rotation.from_rotvec(rotvec).as_matrix(), shift)
            reach = inverse(arm, forward(arm, moved[stop, None]) @ error, moved[stop, None])
            if reach.solved[0]:
                joints[stop] = reach.joints[0]
                break
        else:
            raise DataError(f"simulation: no wrong report is in the arm's reach at stop {stop}.")
    return joints, tuple(chosen.tolist())


def with_faults(cell: SimulatedCell) -> SimulatedCell:
    """Exchanges the images of some rows, and takes some from other stops."""
    layout, rng = cell.layout, cell.options.stream(RandomStream.FAULTS)
    sights = list(cell.sights)
    groups: dict[tuple[str, str], list[int]] = {}
    for at, sight in enumerate(sights):
        camera, target = frame_name("camera", sight.camera), frame_name("target", sight.board)
        if sight.stop >= 0 and cell.parents[camera] != cell.parents[target]:
            groups.setdefault((sight.camera, sight.board), []).append(at)
    pools = [rng.permutation(group).tolist() for group in groups.values() if len(group) > 1]
    wrong: list[int] = []
    for _ in range(layout.swapped_rows):
        pool = _pool(pools)
        first, second = pool.pop(), pool.pop()
        sights[first], sights[second] = (
            _showing(cell.sights[first], cell.sights[second]),
            _showing(cell.sights[second], cell.sights[first]),
        )
        wrong += [first, second]
    for _ in range(layout.stray_images):
        rng.shuffle(pools)
        pool = _pool(pools)
        row = pool.pop()
        sights[row] = _showing(cell.sights[row], cell.sights[pool[0]])
        wrong.append(row)
    views = sorted(cell.sights[index].view for index in wrong)
    return replace(cell, sights=tuple(sights), wrong_views=tuple(views))


def _pool(pools: list[list[int]]) -> list[int]:
    for pool in pools:
        if len(pool) >= 2:
            return pool
    raise DataError("simulation: there are too few rows of one camera and board for such faults.")


def _showing(row: SimulatedSight, image: SimulatedSight) -> SimulatedSight:
    """A row with the image of another stop."""
    return replace(image.numbered(row.view), stop=row.stop)


def sweep(options: CellOptions, how: SweepOptions | None = None) -> SimulatedCell:
    """Simulates a sweep of a cell's robot.

    Args:
        options: The cell; `views` is set by the sweep.
        how: Options of the sweep.

    Returns:
        The cell at the frames, each of which is a view with a time; the controller's stream, with
        its own clock, is `robot`.

    Raises:
        DataError: As `simulate`; or fewer than two frames show the board.
    """
    how = how or SweepOptions()
    stops = simulate(replace(options, views=how.stops, wrong_views=0)).robot.joints
    passage = Passage.through(stops, how)
    options = replace(options, views=len(passage.taken_s), wrong_views=0)
    frames = simulate(options, passage.path(passage.taken_s))
    if how.readout_s:
        frames = _rolling_shutter(frames, passage)
    seen = [sight.view for sight in frames.sights if len(sight.exact.ids) >= 8]
    if len(seen) < 2:
        raise DataError(f"simulation: {len(seen)} frames of the sweep show the board.")
    taken_s = passage.taken_s[[frames.sights[view].stop for view in seen]]
    rng = options.stream(RandomStream.SWEEP)
    recorded = passage.reported(frames.robot.arm, rng)
    offsets_s = how.camera_minus_robot_s + how.jitter_s * rng.standard_normal(len(taken_s))
    kept = frames.only(seen)
    sights = zip(kept.sights, (taken_s + offsets_s).tolist(), strict=True)
    return replace(
        kept,
        options=replace(options, views=len(seen)),
        sights=tuple(replace(sight, stamp_s=stamp_s) for sight, stamp_s in sights),
        streams={"robot": recorded},
        facts={"camera_minus_robot_s": how.camera_minus_robot_s, "readout_s": how.readout_s},
    )


def _rolling_shutter(frames: SimulatedCell, passage: Passage) -> SimulatedCell:
    """The frames of a rolling shutter, with every corner at the time of its row."""
    robot = frames.robot
    jitter = invert(robot.flange_at(robot.joints)) @ robot.true_base_from_flange

    def rolled(sight: SimulatedSight) -> SimulatedSight:
        seen_from = frames.seen_from("", sight.camera, sight.board)
        exact = passage.frame(
            float(passage.taken_s[sight.stop]),
            lambda q: seen_from(robot.flange_at(q) @ jitter[sight.stop]),
            frames.camera(),
            frames.board(sight.board),
            sight.view,
        )
        return replace(sight, exact=exact, at_once=False)

    return with_detections(replace(frames, sights=tuple(rolled(sight) for sight in frames.sights)))


@typed
def simulate(
    options: CellOptions | NetworkOptions, postures: FloatArray | None = None
) -> SimulatedCell:
    """Builds a cell, moves its robots and observes its boards.

    Args:
        options: Options of the cell. The same options give the same cell.
        postures: (m, n) joint angles of the robot of `CellOptions`, one row per stop, whether or
            not the camera sees the board there [rad]; None draws postures with a board in the
            image.

    Returns:
        The cell with true and reported values.

    Raises:
        DataError: An arm is unknown, a camera's coefficients do not fit its model, or a robot
            cannot reach enough poses with a board in view.
    """
    if isinstance(options, CellOptions):
        placed = mounted_single(options)
        if postures is None:
            joints = postures_single(options, placed)
        else:
            joints = np.array(postures, dtype=float)
            options = replace(options, views=len(joints))
        # The camera is displaced in a random direction.
        shift = options.stream(RandomStream.BUMP).standard_normal(3)
        shift *= options.camera_moved_m / np.linalg.norm(shift)
        placed["cam"] = placed["cam"] @ compose(np.eye(3), shift)
        cell = observed(moved_cell(options, placed, {"": joints}))
        wrong = [sight.view for sight in cell.sights if sight.stop in cell.robot.wrong_stops]
        return replace(cell, wrong_views=tuple(wrong))
    if postures is not None:
        raise DataError("simulation: postures are taken by a cell of one robot alone.")
    placed = mounted(options)
    cell = with_faults(observed(moved_cell(options, placed, postures_of(options, placed))))
    pushed = replace(
        cell, mountings={name: array[-1] for name, array in parent_poses(cell).items()}
    )
    for swept in options.sweeps:
        cell = with_sweep(cell, swept, pushed)
    return cell


@dataclass(frozen=True, eq=False)
class Round:
    """Schedule of views during a warm-up."""

    first: int = 24  # Number of different views at the start, before the arm is warm.
    references: int = 6  # Number of them that are repeated.
    every_s: float = 300.0  # Time between repetitions [s].
    minutes: float = 100.0  # Duration of the repetitions [min].
    pace_s: float = 5.0  # Time between views [s].


@dataclass(frozen=True, eq=False)
class WarmUpOptions:
    """Options of a cell whose arm warms up."""

    cell: CellOptions = field(default_factory=CellOptions)  # The cell.
    heat: Heat | None = None  # Thermal parameters of the arm; None draws them by the cell's seed.
    round: Round = field(default_factory=Round)  # Schedule of views.
    hours: float = 5.0  # Duration of the temperature record [h].
    temperatures: bool = True  # Whether the controller reports temperatures; otherwise currents.

    @property
    def heats(self) -> Heat:
        """Thermal parameters of the arm."""
        return self.heat or Heat.drawn(self.cell.seed)

    def warming(self) -> Warming:
        """Temperatures over the whole duration."""
        return warm_up(self.heats, self.hours, seed=self.cell.seed)


def simulate_warm_up(options: WarmUpOptions) -> SimulatedCell:
    """Observes a cell's board while its arm warms up.

    Returns:
        The views, each with the arm's temperature at its time; temperatures or currents until the
        last view are in the stream `heat`.

    Raises:
        DataError: As `simulate`.
    """
    heat, warming = options.heats, options.warming()
    times = options.round
    stamps, shown = [times.pace_s * np.arange(times.first)], [*range(times.first)]
    for begin in np.arange(times.every_s, 60.0 * times.minutes, times.every_s):
        stamps.append(begin + times.pace_s * np.arange(times.references))
        shown += np.linspace(0, times.first - 1, times.references).astype(int).tolist()
    stamps_s = np.concatenate(stamps)
    postures = simulate(replace(options.cell, views=times.first)).robot.joints
    cold = simulate(options.cell, postures[shown])
    robot, links_c = cold.robot, warming.at(stamps_s)
    warm_poses = heated_flanges(
        robot.true_arm, heat, robot.joints, links_c, robot.true_base_from_flange
    )
    warm = replace(cold, robots={"": replace(robot, true_base_from_flange=warm_poses)})
    return replace(
        observed(warm),
        stamps_s=stamps_s,
        streams={
            "heat": warming.recorded(temperatures=options.temperatures, until_s=float(stamps_s[-1]))
        },
        facts={"heat": asdict(heat)},
    )
