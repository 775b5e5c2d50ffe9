"""Which reading of a session's poses is right: measured from its images, without its robot."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.stages.init_frames import init_frames
from visioncal.calibration.stages.pictures import because, unseen_cause
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.errors import VisioncalError
from visioncal.core.types import FloatArray, Progress
from visioncal.estimation.chain import chain
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE

# What the camera's poses need; the robot has no part in it, so that it can be wrong.
_SEEING = ("detect", "intrinsics", "pnp")


def guess_session(
    session: Session, robot: PoseNumbers | None = None, *, progress: Progress | None = None
) -> Guess:
    """Tries every plausible reading of a session's poses.

    Args:
        session: The session, with images or measured poses of the target.
        robot: The robot's numbers as they were before the session was made of them, one row a
            view; left out, those of the session are taken.
        progress: Told of long work.

    Returns:
        The readings, and whether one stands out.

    Raises:
        DataError: There is nothing to read, or the target is in no view.
        DegenerateError: Too few views have both poses, or the lens cannot be estimated.
        ConvergenceError: The intrinsics do not come to rest.
    """
    return guess_seen(seen_by_camera(RunState(session, progress)), robot)


def guess_seen(seen: RunState, robot: PoseNumbers | None = None) -> Guess:
    """Does what `guess_session` does once the camera's poses are known.

    Args:
        seen: What is known, the camera's poses with all their rivals.
        robot: The robot's numbers; left out, those of the session are taken.

    Raises:
        DataError: There is nothing to read.
        DegenerateError: Too few views have both poses.
    """
    matched = seen.reported.matched
    # Joints that are misread say nothing about the poses.
    chain = (
        None
        if matched is not None and matched.misread
        else chain_poses(seen.session, None if matched is None else matched.arm)
    )
    if robot is None:
        poses = numbers_in(seen.session, POSE)
        robot = reported_or_chained(at_times(seen) if seen.clocks else poses, chain)
    is_measured, mount = bool(seen.corners), seen.session.mount
    for camera in seen_ways(seen, robot):
        guess = guess_reading(robot, camera, mount, chain=chain, is_measured=is_measured)
        if not guess.stands_out and guess.declared.closes:
            break
    return guess


def seen_poses(session: Session, *, progress: Progress | None = None) -> PoseNumbers:
    """Measures `cam_from_target` of every view, without the robot; NaN where it was not seen.

    Raises:
        DataError: The target is in no view.
        DegenerateError: The lens cannot be estimated.
        ConvergenceError: The intrinsics do not come to rest.
    """
    return camera_numbers(seen_by_camera(RunState(session, progress)))


def chain_poses(session: Session, robot: Robot | None = None) -> FloatArray | None:
    """Computes (n, 4, 4) `base_from_flange` of every view through the robot's model.

    Args:
        session: The session.
        robot: The model; the one that the session names where None.

    Returns:
        The poses, NaN where there are no joint angles; None where the session names no known
        robot, or no view has as many angles as it has joints.
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


def reported_or_chained(read: PoseNumbers, chain: FloatArray | None) -> PoseNumbers:
    """The robot's poses as they were reported; those of its joints where none were."""
    return read if chain is None or read.there.any() else PoseNumbers.of_poses(chain, read.places)


def numbers_in(session: Session, columns: tuple[str, ...]) -> PoseNumbers:
    """The numbers of a group of pose columns, one row a view; NaN where they are empty."""
    cells = [[view.numbers.get(name, np.nan) for name in columns] for view in session.views]
    numbers = np.array(cells, dtype=float)
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places_of(session))


def at_times(seen: RunState) -> PoseNumbers:
    """The robot's numbers out of its stream, at the views' times; NaN where it has none."""
    numbers = np.full((len(seen.session.views), 7), np.nan)
    for at, view in enumerate(seen.session.views):
        if view.number in seen.base_from_flange:
            pose = RigidTransform.from_matrix(seen.base_from_flange[view.number])
            numbers[at] = [*pose.translation, *pose.rotation.as_quat()]
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places_of(seen.session))


def seen_by_camera(known: RunState) -> RunState:
    """What is known once the camera's poses are, whatever the robot's are."""
    # Which moment of a stream a view belongs to is found by how both turned, however they are read.
    names = (*_SEEING, "robot", "clock") if waits_for_clock(known.session) else _SEEING
    for stage in STAGES:
        if stage.name in names:
            try:
                known = stage.run(known)
            except VisioncalError as error:
                cause = unseen_cause(known)
                if cause is None:
                    raise
                raise because(error, cause) from error
    return known


def seen_ways(seen: RunState, robot: PoseNumbers) -> Iterator[PoseNumbers]:
    """The camera's poses as the declared robot would have them, and then by the images alone."""
    seen = replace(seen, poses=seen.poses_of_one_board)
    # They differ where an image allows several poses: the wrong robot would choose wrong ones.
    if any(len(pose.cam_from_target) > 1 for pose in seen.poses.values()):
        # Where the declared robot cannot choose, the images alone are left.
        with suppress(VisioncalError):
            yield camera_numbers(_chosen(seen, robot))
    yield camera_numbers(seen)


def _chosen(seen: RunState, robot: PoseNumbers) -> RunState:
    """Chooses among the poses that an image allows by the declared robot."""
    base_from_flange = dict(
        zip((view.number for view in seen.session.views), robot.poses(), strict=True)
    )
    both = [pose for pose in seen.poses.values() if np.isfinite(base_from_flange[pose.view]).all()]
    problem = chain(
        seen.session.mount,
        np.array([base_from_flange[view.view] for view in both]).reshape(-1, 4, 4),
        np.array([view.cam_from_target[0] for view in both]).reshape(-1, 4, 4),
    )
    boards = [*seen.session.boards.values()]
    targets = {name: boards[both[0].board] for name in problem.observations.observed if boards}
    found = init_frames(problem, both, targets)
    return replace(seen, poses={view.view: view for view in found.views})


def camera_numbers(seen: RunState) -> PoseNumbers:
    """The poses of one board, of each view the best by its image, or as the session gives them."""
    shown_in = seen.poses_of_one_board
    if not seen.corners:
        numbers = numbers_in(seen.session, MEASURED_CAM_POSE)
        shown = np.array([view.number in shown_in for view in seen.session.views])
        return replace(
            numbers,
            positions=np.where(shown[:, None], numbers.positions, np.nan),
            rotations=np.where(shown[:, None], numbers.rotations, np.nan),
        )
    poses = np.full((len(seen.session.views), 4, 4), np.nan)
    for at, view in enumerate(seen.session.views):
        if view.number in shown_in:
            poses[at] = shown_in[view.number].cam_from_target[0]
    return PoseNumbers.of_poses(poses, places_of(seen.session))


def places_of(session: Session) -> tuple[str, ...]:
    """What messages call the rows of a session."""
    return tuple(f"view {view.number}" for view in session.views)
