"""Input of the search for misread poses: the camera's by images, the robot's numbers, chains."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.guess.fit import Fit, robust_fits
from visioncal.calibration.guess.readings import SideReading
from visioncal.calibration.guess.recording import FEWEST_ROWS, Recording
from visioncal.calibration.guess.search import in_one_turn, turns_alike
from visioncal.calibration.guess.unwrapping import in_one_place
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.observed import CameraObservations
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.calibration.stages.robots import CameraTargetPair, pairs_of
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import compose, robot_part
from visioncal.core.types import MOUNTS, FloatArray, IntArray, Mount
from visioncal.core.verdict import Finding
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE
from visioncal.session.frames import object_name
from visioncal.vision.pnp import ViewPoses
from visioncal.vision.targets import first_numbers


def guess_from_camera_poses(
    run: RunState,
    robot: PoseNumbers | None = None,
    camera: PoseNumbers | None = None,
    *,
    knows_mount: bool = True,
) -> Guess:
    """Tries every plausible reading of a session's poses, with the camera's by each image alone.

    An instrument sees its probe on the flange as a fixed camera does a board.

    Args:
        run: The run, with the camera's poses.
        robot: The robot's original numbers, one row a view; those of the session where None.
        camera: The original numbers of measured poses; those of the session where None.
        knows_mount: Whether the session's mount is stated; else both are tried.

    Raises:
        DataError: There is nothing to read.
        DegenerateError: Too few views have both poses.
    """
    matched = run.reported.matched
    # Misread joints say nothing about the poses.
    joint_poses = None
    if matched is None or not matched.misread:
        joint_poses = chain_poses(run.timed, None if matched is None else matched.robot)
    if robot is None:
        robot = numbers_in(run.timed, POSE)
        if joint_poses is not None and not robot.present.any():
            robot = PoseNumbers.of_poses(joint_poses, robot.places)
    return guess_reading(
        robot,
        _camera_numbers(run, robot) if camera is None else camera,
        _seen_as(run.session.mount) if knows_mount else None,
        chain=joint_poses,
        is_measured=bool(run.corners),
    )


def may_agree(run: RunState, robot: PoseNumbers) -> bool:
    """Whether the robot's numbers turn as the boards in a run's images do, under any reading."""
    camera, mount = _camera_numbers(run, robot), _seen_as(run.session.mount)
    return turns_alike(Recording(robot, camera, mount, is_measured=bool(run.corners)))


def _seen_as(mount: Mount) -> Mount:
    return "eye-to-hand" if mount == "instrument" else mount


def alike_turning(
    robot: Mapping[int, FloatArray], seen: Mapping[int, ViewPoses], mount: Mount
) -> dict[int, FloatArray]:
    """`cam_from_target` by view with a (4, 4) pose of the robot: the rival that agrees with it.

    By the turns of both, or by the robot's positions where no turns agree.
    """
    views = [at for at in sorted(seen) if at in robot and np.isfinite(robot[at]).all()]
    if not views:
        return {}
    most = max(len(seen[view].cam_from_target) for view in views)
    each = np.arange(most)
    rivals = np.array(
        [seen[view].cam_from_target[np.minimum(each, len(seen[view].cam_from_target) - 1)]
         for view in views]
    )  # fmt: skip
    poses = np.array([robot[view] for view in views])
    chosen = in_one_turn(poses[:, :3, :3], rivals[..., :3, :3])
    for name in sorted(MOUNTS, key=mount.__ne__) if chosen is None and most > 1 else ():
        # The mount may be mistaken, too.
        chosen = in_one_place(poses[:, :3, 3], rivals, name) if chosen is None else chosen
    chosen = np.zeros(len(views), dtype=np.int64) if chosen is None else chosen
    return {view: rivals[at, chosen[at]] for at, view in enumerate(views)}


def chain_poses(session: Session, robot: Robot | None = None) -> FloatArray | None:
    """(n, 4, 4) `base_from_flange` of every view [m], through a model or the one that is stated.

    NaN where there are no joint angles; None without a known robot, or angles for its joints.
    """
    if robot is None and session.robot_document is not None:
        robot = Robot.from_document(session.robot_document)
    if robot is None:
        return None
    joints = [view.joints_rad for view in session.views]
    rows = [at for at, q in enumerate(joints) if q is not None and len(q) == robot.joint_count]
    if not rows:
        return None
    poses = np.full((len(joints), 4, 4), np.nan)
    poses[rows] = robot.base_from_flange(np.array([joints[at] for at in rows]))
    return poses


def numbers_in(session: Session, columns: tuple[str, ...]) -> PoseNumbers:
    """The numbers of a group of pose columns, one row a view; NaN where they are empty."""
    cells = [[view.numbers.get(name, np.nan) for name in columns] for view in session.views]
    numbers = np.array(cells, dtype=float)
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), _places_of(session))


def _camera_numbers(run: RunState, robot: PoseNumbers) -> PoseNumbers:
    """Poses of one board, of each view by its image that which turns as the robot, or measured."""
    by_view, views = run.poses_of_one_board, run.session.views
    poses = np.full((len(views), 4, 4), np.nan)
    taken = compose(SideReading(robot.reading.rotation).rotations(robot), robot.positions)
    by_robot = {view.number: pose for view, pose in zip(views, taken, strict=True)}
    seen = alike_turning(by_robot, by_view, run.session.mount)
    for at, view in enumerate(views):
        if view.number in by_view:
            poses[at] = seen.get(view.number, by_view[view.number].cam_from_target[0])
    if run.corners:
        return PoseNumbers.of_poses(poses, _places_of(run.session))
    numbers = numbers_in(run.session, MEASURED_CAM_POSE)
    numbers.positions[np.isnan(poses[:, 0, 0])] = np.nan
    return numbers


def _places_of(session: Session) -> tuple[str, ...]:
    """Names of a session's rows in messages."""
    return tuple(f"view {view.number}" for view in session.views)


def open_pairs(
    run: RunState, robot: str, base_from_flange: Mapping[int, FloatArray]
) -> tuple[list[CameraTargetPair], list[CameraTargetPair]]:
    """The pairs of a camera and a target whose chain does not close through a robot, and others.

    Those of most views first; the robot's (4, 4) poses are given by view.
    """
    every = [pair for pair in pairs_of(run, robot) if len(pair.poses) >= FEWEST_ROWS]
    wrong = [pair for pair in every if not closes(base_from_flange, pair.poses, pair.mount)]
    return wrong, [pair for pair in every if pair not in wrong]


def of_pair(run: RunState, robot: str, pair: CameraTargetPair) -> RunState:
    """A cell's run as that of one robot, camera and target alone."""
    session = run.session.of(pair.camera, robot, pair.target)
    views = {view.number for view in session.views}
    first = first_numbers(run.session.boards).get(object_name(pair.target, "target"), 0)
    cameras = dict[str, CameraObservations]()
    # Of poses that are given there are no corners.
    if (look := run.cameras.get(pair.camera)) is not None:
        # Corners of other targets are no corners of this one, which has numbers of its own.
        corners = {
            view: replace(seen, ids=seen.ids - first)
            for view, seen in look.corners.items()
            if view in views
        }
        cameras[pair.camera] = replace(look, corners=corners)
    return replace(
        run,
        session=session,
        robots={name: report for name, report in run.robots.items() if name == robot},
        cameras=cameras,
        poses=pair.poses,
    )


def closes(
    base_from_flange: Mapping[int, FloatArray], seen: Mapping[int, ViewPoses], mount: Mount
) -> bool:
    """Whether the chain of one robot closes as declared; true with too few views to show it."""
    fit = chain_fit(base_from_flange, seen, mount)
    return fit is None or fit.closes


def chain_fit(
    base_from_flange: Mapping[int, FloatArray], seen: Mapping[int, ViewPoses], mount: Mount
) -> Fit | None:
    """The robust fit of the chain of one robot; None of too few views."""
    _, pairs = both_sides(base_from_flange, seen, mount)
    if len(pairs) < FEWEST_ROWS:
        return None
    return robust_fits(robot_part(pairs[:, 0], mount)[None], pairs[:, 1][None])[0]


def both_sides(
    base_from_flange: Mapping[int, FloatArray], seen: Mapping[int, ViewPoses], mount: Mount
) -> tuple[IntArray, FloatArray]:
    """(m,) views, and (m, 2, 4, 4) poses of the robot and of the target by each image alone."""
    alike = alike_turning(base_from_flange, seen, mount)
    pairs = [(base_from_flange[view], pose) for view, pose in alike.items()]
    return np.array([*alike], dtype=int), np.array(pairs).reshape(-1, 2, 4, 4)


def board_shown(fault: VisioncalError | None) -> Finding | None:
    """The board that images show in place of the stated one, where that kept them from use."""
    found = fault.finding if isinstance(fault, OtherBoardError) else None
    return found if found is not None and found.kind == "other_board" else None
