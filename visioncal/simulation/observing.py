"""Simulation of a cell: mounting, robot motion, observations, and recording faults."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import Camera, Corners, FloatArray, Mask, Target
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, arm_named, forward, inverse
from visioncal.simulation.boards import Sheet, corners_m, detectable_in_part
from visioncal.simulation.cell import (
    InstrumentReading,
    SimulatedCell,
    SimulatedRobot,
    SimulatedSight,
)
from visioncal.simulation.heat import Heat, heated_flanges, warm_up
from visioncal.simulation.layout import CellOptions, NetworkOptions, RandomStream
from visioncal.simulation.optics import inaccurate_camera, project, sees
from visioncal.simulation.poses import LEAST_SHARE, MARGIN_PX, Viewpoints, filling_m

# Corners closer to the image's edge are not detected [px].
EDGE_PX = 2.0
# Smallest cosine of the angle between view and board normal.
_LEAST_COSINE = 0.5
# Corresponding sources of randomness in cells with several robots.
_OF_SEVERAL = {RandomStream.ARM: RandomStream.ARMS, RandomStream.ROBOT: RandomStream.ROBOTS}


def board_in_view(camera: Camera, sheet: Sheet, cam_from_target: FloatArray) -> Mask:
    """(s,) mask of stops at which a board is in view and not too oblique."""
    points = corners_m(sheet) @ np.swapaxes(cam_from_target[:, :3, :3], 1, 2)
    points = points + cam_from_target[:, None, :3, 3]
    directions = points / np.linalg.norm(points, axis=2, keepdims=True)
    facing = np.einsum("mni,mi->mn", directions, cam_from_target[:, :3, 2]) > _LEAST_COSINE
    visible = facing.all(axis=1) & (directions[:, :, 2] > _LEAST_COSINE).all(axis=1)
    if not visible.any():
        return np.asarray(visible)
    share = sees(camera, points[visible], MARGIN_PX).mean(axis=1)
    visible[visible] = share >= (LEAST_SHARE if detectable_in_part(sheet.target) else 1.0)
    return np.asarray(visible)


def detected(sheet: Sheet, exact: Corners, sigma_px: float, noise: np.random.Generator) -> Corners:
    """Corners of a view as detected, with noise.

    The numbering of a symmetric board starts at the upper left.
    """
    corners = replace(exact, px=exact.px + sigma_px * noise.standard_normal(exact.px.shape))
    if not is_symmetric(sheet.target) or not len(corners.ids):
        return corners
    if corners.px[0].sum() <= corners.px[-1].sum():
        return corners
    last = sheet.target.columns * sheet.target.rows - 1
    return replace(corners, ids=(last - corners.ids)[::-1], px=corners.px[::-1])


def is_symmetric(target: Target) -> bool:
    """Whether a board is invariant under a half turn."""
    if target.kind == "circles":
        return not target.asymmetric or target.rows % 2 == 0
    return target.kind == "checkerboard" and (target.columns + target.rows) % 2 == 0


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
        joints, wrong_stops = misreported(arm, q, robot.wrong_stops, rng)
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
    lens, points = cell.camera(camera), corners_m(cell.board(board))
    points = points @ pose[:3, :3].T + pose[:3, 3]
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
        poses[push.frame][start:] = poses[push.frame][start:] @ exp(twist.ravel())
    return poses


def _shown(cell: SimulatedCell, camera: str, board: str, pose: FloatArray) -> Mask:
    """(s,) mask of stops at which a camera's image of a board is recorded."""
    layout, options = cell.layout, cell.options
    seen = board_in_view(cell.camera(camera).camera, cell.board(board), pose)
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


def misreported(
    arm: DhArm, moved: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, tuple[int, ...]]:
    """Reported joint angles: the true ones, except for some stops with a wrong report.

    Args:
        arm: Nominal arm.
        moved: (s, n) true joint angles [rad].
        count: Number of stops whose report is off by 5 to 30 mm and 1 to 5 degrees.
        rng: Source of randomness.

    Returns:
        (s, n) reported joint angles [rad], and the wrong stops, ascending.
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
        pool = _pool(pools, 2)
        first, second = pool.pop(), pool.pop()
        sights[first], sights[second] = (
            _showing(cell.sights[first], cell.sights[second]),
            _showing(cell.sights[second], cell.sights[first]),
        )
        wrong += [first, second]
    for _ in range(layout.stray_images):
        rng.shuffle(pools)
        pool = _pool(pools, 2)
        row = pool.pop()
        sights[row] = _showing(cell.sights[row], cell.sights[pool[0]])
        wrong.append(row)
    views = sorted(cell.sights[index].view for index in wrong)
    return replace(cell, sights=tuple(sights), wrong_views=tuple(views))


def _pool(pools: list[list[int]], least: int) -> list[int]:
    for pool in pools:
        if len(pool) >= least:
            return pool
    raise DataError("simulation: there are too few rows of one camera and board for such faults.")


def _showing(row: SimulatedSight, image: SimulatedSight) -> SimulatedSight:
    """A row with the image of another stop."""
    return replace(image.numbered(row.view), stop=row.stop)
