"""Input of the search for misread poses: the camera's poses by images, the robot's numbers."""

from collections.abc import Mapping

import numpy as np

from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.guess.readings import SideReading
from visioncal.calibration.guess.recording import Recording
from visioncal.calibration.guess.search import in_one_turn, turns_alike
from visioncal.calibration.guess.unwrapping import in_one_place
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.transforms import compose
from visioncal.core.types import MOUNTS, FloatArray, Mount
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE


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
