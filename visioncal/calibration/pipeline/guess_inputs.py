"""Input of the search for misread poses: the camera's poses by images, the robot's numbers."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.stages.image_checks import because, unseen_cause
from visioncal.calibration.stages.init_frames import init_frames
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.errors import VisioncalError
from visioncal.core.types import FloatArray
from visioncal.estimation.chain import chain
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE

# Stages that the camera's poses need; none uses the robot, whose poses may be misread.
_SEEING = ("detect", "intrinsics", "pnp")


def guess_from_camera_poses(
    run: RunState,
    robot: PoseNumbers | None = None,
    camera: PoseNumbers | None = None,
    *,
    knows_mount: bool = True,
) -> Guess:
    """Tries every plausible reading of a session's poses, with all alternatives of the camera's.

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
        joint_poses = chain_poses(run.session, None if matched is None else matched.robot)
    if robot is None:
        poses = numbers_in(run.session, POSE)
        robot = robot_numbers(run) if run.clocks else poses
        if joint_poses is not None and not robot.present.any():
            robot = PoseNumbers.of_poses(joint_poses, robot.places)
    is_measured, mount = bool(run.corners), run.session.mount if knows_mount else None
    choices = camera_pose_choices(run, robot) if camera is None else (camera,)
    for poses in choices:
        guess = guess_reading(robot, poses, mount, chain=joint_poses, is_measured=is_measured)
        if not guess.stands_out and guess.declared.fit.closes:
            break
    return guess


def chain_poses(session: Session, robot: Robot | None = None) -> FloatArray | None:
    """(n, 4, 4) `base_from_flange` of every view [m], through a model or the one that is stated.

    NaN where there are no joint angles; None without a known robot, or angles for its joints.
    """
    if robot is None and session.robot_document is not None:
        robot = Robot.from_document(session.robot_document)
    if robot is None:
        return None
    poses = np.full((len(session.views), 4, 4), np.nan)
    for at, view in enumerate(session.views):
        joints = view.joints_rad
        if joints is not None and len(joints) == robot.joint_count:
            poses[at] = robot.base_from_flange(joints[None])[0]
    return poses if np.isfinite(poses).any() else None


def numbers_in(session: Session, columns: tuple[str, ...]) -> PoseNumbers:
    """The numbers of a group of pose columns, one row a view; NaN where they are empty."""
    cells = [[view.numbers.get(name, np.nan) for name in columns] for view in session.views]
    numbers = np.array(cells, dtype=float)
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places_of(session))


def robot_numbers(run: RunState) -> PoseNumbers:
    """The robot's poses at the views, also from its stream, as numbers; NaN where it has none."""
    numbers = np.full((len(run.session.views), 7), np.nan)
    for at, view in enumerate(run.session.views):
        if view.number in run.base_from_flange:
            pose = RigidTransform.from_matrix(run.base_from_flange[view.number])
            numbers[at] = [*pose.translation, *pose.rotation.as_quat()]
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places_of(run.session))


def with_camera_poses(run: RunState) -> RunState:
    """Runs the stages that the camera's poses need, whatever the robot's poses are."""
    # The offset of a stream's clock is found by rotation angles, which no reading changes.
    names = (*_SEEING, "robot", "clock") if waits_for_clock(run.session) else _SEEING
    for stage in STAGES:
        if stage.name in names:
            try:
                run = stage.run(run)
            except VisioncalError as error:
                cause = unseen_cause(run)
                if cause is None:
                    raise
                raise because(error, cause) from error
    return run


def camera_pose_choices(run: RunState, robot: PoseNumbers) -> Iterator[PoseNumbers]:
    """The camera's poses chosen by the declared robot poses, and then by the images alone."""
    run = replace(run, poses=run.poses_of_one_board)
    # They differ where an image allows several poses: misread robot poses would choose wrong ones.
    if any(len(pose.cam_from_target) > 1 for pose in run.poses.values()):
        # Where the declared robot poses do not allow a choice, the images alone remain.
        with suppress(VisioncalError):
            yield camera_numbers(_chosen(run, robot))
    yield camera_numbers(run)


def _chosen(run: RunState, robot: PoseNumbers) -> RunState:
    """Chooses among the poses that an image allows by the declared robot poses."""
    numbers = (view.number for view in run.session.views)
    base_from_flange = dict(zip(numbers, robot.poses(), strict=True))
    both = [pose for pose in run.poses.values() if np.isfinite(base_from_flange[pose.view]).all()]
    problem = chain(
        run.session.mount,
        np.array([base_from_flange[view.view] for view in both]).reshape(-1, 4, 4),
        np.array([view.cam_from_target[0] for view in both]).reshape(-1, 4, 4),
    )
    boards = [*run.session.boards.values()]
    targets = {name: boards[both[0].board] for name in problem.observations.observed if boards}
    initial = init_frames(problem, both, targets)
    return replace(run, poses={view.view: view for view in initial.views})


def camera_numbers(run: RunState) -> PoseNumbers:
    """Poses of one board, the best of each view by its image, or as measured in the session."""
    by_view = run.poses_of_one_board
    if not run.corners:
        numbers = numbers_in(run.session, MEASURED_CAM_POSE)
        has_pose = np.array([view.number in by_view for view in run.session.views])[:, None]
        return replace(
            numbers,
            positions=np.where(has_pose, numbers.positions, np.nan),
            rotations=np.where(has_pose, numbers.rotations, np.nan),
        )
    poses = np.full((len(run.session.views), 4, 4), np.nan)
    for at, view in enumerate(run.session.views):
        if view.number in by_view:
            poses[at] = by_view[view.number].cam_from_target[0]
    return PoseNumbers.of_poses(poses, places_of(run.session))


def places_of(session: Session) -> tuple[str, ...]:
    """Names of a session's rows in messages."""
    return tuple(f"view {view.number}" for view in session.views)
