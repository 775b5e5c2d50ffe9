"""Which reading of a session's poses is right: measured from its images, without its robot."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.calibration.guess import Candidate, Guess, guess_reading
from visioncal.calibration.guess.given import FEWEST_ROWS, Recording, closes
from visioncal.calibration.pipeline.exchanged_names import exchanged_names
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.cause_ranking import (
    COUNTED_BACKWARDS,
    MIRRORED,
    MIRRORED_CORNERS,
    read_otherwise,
    unpaired_rows,
    unrecorded_positions,
    unrecorded_rotations,
    wrong_poses,
)
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.stages.init_frames import init_frames
from visioncal.calibration.stages.joints import match_joints
from visioncal.calibration.stages.judge import is_scattered
from visioncal.calibration.stages.pictures import because, unseen_cause
from visioncal.calibration.stages.robots import Pair, pairs_of
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Progress
from visioncal.core.verdict import Finding, Step
from visioncal.estimation.chain import chain, robot_part
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE

# What the camera's poses need; the robot has no part in it, so that it can be wrong.
_SEEING = ("detect", "intrinsics", "pnp")
# A robot that turns by less stands, a target that turns by more does not, ambiguous poses aside
# [deg].
_STILL_DEG, _TURNED_DEG = 0.5, 10.0
# Positions that differ by less are one [m].
_STILL_M = 1e-3
# Robot and camera turn alike between two views where they differ by less [deg].
_ALIKE_DEG = 3.0
# Rows are as good as shuffled where so many shuffles are as good in such a share; not of fewer
# rows, or of turns so small that chance makes more of the pairs alike.
_SHUFFLES, _CHANCE, _FEWEST_SHUFFLED, _MOST_BY_CHANCE = 200, 0.05, 8, 0.3


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
    return guess_seen(_seen(RunState(session, progress)), robot)


def guess_seen(seen: RunState, robot: PoseNumbers | None = None) -> Guess:
    """Does what `guess_session` does once the camera's poses are known.

    Args:
        seen: What is known, the camera's poses with all their rivals.
        robot: The robot's numbers; left out, those of the session are taken.

    Raises:
        DataError: There is nothing to read.
        DegenerateError: Too few views have both poses.
    """
    seen, matched = replace(seen, poses=seen.poses_of_one_board), seen.reported.matched
    # Joints that are misread say nothing about the poses.
    chain = (
        None
        if matched is not None and matched.misread
        else chain_poses(seen.session, None if matched is None else matched.arm)
    )
    if robot is None:
        poses = numbers_in(seen.session, POSE)
        robot = reported_or_chained(_at_times(seen) if seen.clocks else poses, chain)
    is_measured, mount = bool(seen.corners), seen.session.mount
    for camera in _seen_ways(seen, robot):
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
    seen = _seen(RunState(session, progress))
    return _camera_numbers(replace(seen, poses=seen.poses_of_one_board))


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
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), _places(session))


def reading_hint(seen: RunState) -> Finding | None:
    """Says which reading of the poses would explain a calibration that failed.

    Args:
        seen: What is known once the camera's poses are.

    Returns:
        It, with the command that applies it; None where no reading stands out.
    """
    still = _unrecorded(seen)
    if still is not None:
        return still
    try:
        guess = guess_seen(seen)
    except VisioncalError:
        # Too little to guess from: what failed has been said already.
        return None
    if not guess.stands_out:
        if guess.declared.closes:
            return None
        beside = _poses_beside_joints(seen, guess.declared)
        return beside or _one_position(seen) or _unpaired(seen)
    best, views = guess.best, seen.session.views
    is_mirrored = best.hypothesis.robot.signs == "mirror"
    swap = best.hypothesis.swap if len(best.differences) == 1 else ()
    exchanged = tuple(views[row].number for row in swap)
    found = read_otherwise(guess.sentence, exchanged, is_mirrored=is_mirrored)
    if is_mirrored and _corners_are_mirrored(seen):
        found = replace(found, do=MIRRORED_CORNERS)
    return found


def _corners_are_mirrored(seen: RunState) -> bool:
    """Whether corners.csv shows boards from behind, as a camera cannot see a print."""
    # A left-handed frame of the robot does not do that, nor do images that were mirrored before
    # another program numbered their corners.
    session = seen.session
    if any(it.image for it in session.views) or not session.corners:
        return False
    if any(it.kind == "points" for it in session.boards.values()):
        # Its z may point either way.
        return False
    poses = _camera_numbers(replace(seen, poses=seen.poses_of_one_board)).poses()
    # A board's z points into it.
    into = np.sum(poses[:, :3, 2] * poses[:, :3, 3], axis=1)
    return bool(np.nanmedian(into) < 0.0)


def session_is_mirrored(session: Session) -> bool:
    """Does what `_corners_are_mirrored` does with a session of which nothing is known yet.

    Raises:
        VisioncalError: The camera's poses cannot be found.
    """
    return _corners_are_mirrored(_seen(RunState(session)))


def _unrecorded(seen: RunState) -> Finding | None:
    """Says that the robot's rotations were not recorded, where the camera sees others."""
    seen = replace(seen, poses=seen.poses_of_one_board)
    robot, camera = _at_times(seen), _camera_numbers(seen)
    both = robot.there & camera.there
    if both.sum() < FEWEST_ROWS:
        return None
    moved = [invert(it[:1]) @ it for it in (way.poses()[both] for way in (robot, camera))]
    by_robot, by_camera = map(rotation_angle, moved)
    most, half = np.rad2deg([by_robot.max(), np.median(by_camera)]).tolist()
    if most > _STILL_DEG or half < _TURNED_DEG:
        return None
    is_one_pose = bool(np.abs(moved[0][:, :3, 3]).max() < _STILL_M)
    return unrecorded_rotations(most, half, is_one_pose=is_one_pose)


def _one_position(seen: RunState) -> Finding | None:
    """Says that the robot's positions were not recorded, where they explain nothing."""
    robot = _at_times(seen)
    positions = robot.poses()[robot.there, :3, 3]
    is_one = len(positions) >= FEWEST_ROWS and np.ptp(positions, axis=0).max() < _STILL_M
    return unrecorded_positions() if is_one else None


def _unpaired(seen: RunState) -> Finding | None:
    """Says that rows and images have nothing in common, where shuffled rows fit as well."""
    # A permutation test (Pitman 1937) of how much robot and camera turn between two views, which is
    # the same whatever the frames between them are.
    seen = replace(seen, poses=seen.poses_of_one_board)
    robot, camera = _at_times(seen), _camera_numbers(seen)
    both = robot.there & camera.there
    if both.sum() < _FEWEST_SHUFFLED:
        return None
    by_robot = _turns(robot_part(robot.poses()[both], seen.session.mount))
    by_camera = _turns(invert(camera.poses()[both]))
    first, second = np.triu_indices(len(by_robot), 1)

    def alike(order: IntArray) -> float:
        apart = by_robot[order[first], order[second]] - by_camera[first, second]
        return float(np.mean(np.abs(apart) < np.deg2rad(_ALIKE_DEG)))

    rng, share = np.random.default_rng(0), alike(np.arange(len(by_robot)))
    shuffled = [alike(rng.permutation(len(by_robot))) for _ in range(_SHUFFLES)]
    if share > np.quantile(shuffled, 1.0 - _CHANCE) or np.mean(shuffled) > _MOST_BY_CHANCE:
        return None
    return unpaired_rows(share, float(np.mean(shuffled)))


def _turns(poses: FloatArray) -> FloatArray:
    """(n, n) by how much each of (n, 4, 4) poses is turned from each other [rad]."""
    return rotation_angle(invert(poses)[:, None] @ poses)


def _poses_beside_joints(seen: RunState, declared: Candidate) -> Finding | None:
    """Says that poses are wrong which no reading explains, where the joint angles agree."""
    session = seen.session
    if session.robot_document is None or not numbers_in(session, POSE).there.any():
        return None
    arm = Robot.from_document(session.robot_document)
    chain, matched = chain_poses(session, arm), match_joints(session.views, arm)
    if chain is None:
        return None
    if matched.joints_rad and not matched.contradicting:
        # They are the poses of the joint angles: where the motion determines little, one chain
        # closes and the other does not by rounding alone.
        return None
    robot = PoseNumbers.of_poses(chain, _places(session))
    one_board = replace(seen, poses=seen.poses_of_one_board)
    for camera in _seen_ways(one_board, robot):
        by_joints = guess_reading(
            robot, camera, session.mount, is_measured=bool(seen.corners)
        ).declared
        if by_joints.closes:
            return wrong_poses(declared.figures, by_joints.figures)
    return None


def readings_in_cell(known: RunState) -> Iterator[Finding]:
    """Says which robots and cameras of a whole cell only another reading of the rows explains.

    Each camera is looked at with one target and by way of one robot alone, those of most views
    first. Where no reading explains the chain, what is wrong is no reading.

    Args:
        known: What is known of the cell.
    """
    session = known.session
    mirrored: set[str] = set()
    is_first = True
    for robot in session.robots:
        looked = set(mirrored)
        for pair in pairs_of(known, robot):
            if pair.camera in looked or _closes(known, robot, pair):
                continue
            # Sooner tried than readings, and nothing else looks like it.
            exchanged = exchanged_names(known) if is_first else None
            if exchanged is not None:
                yield exchanged
                return
            is_first = False
            looked.add(pair.camera)
            try:
                part = RunState(session.of(pair.camera, robot, pair.target), None, known.threads)
                for stage in STAGES[: [it.name for it in STAGES].index("joints") + 1]:
                    part = stage.run(part)
            except VisioncalError:
                # There is too little to see.
                continue
            hint = None if closes_as_declared(part) else reading_hint(part)
            if hint is None:
                continue
            if hint.do not in (MIRRORED, MIRRORED_CORNERS):
                step = (
                    f"Correct the rows of robot {robot} in views.csv (base_from_flange in metres, "
                    "quaternion x, y, z, w), and calibrate again."
                )
                yield replace(hint, words=f"Robot {robot}: {hint.words}", do=Step(step))
                # All cameras would say so.
                break
            mirrored.add(pair.camera)
            named = replace(hint, words=f"Camera {pair.camera}: {hint.words}")
            if hint.do is MIRRORED_CORNERS:
                # A copy is written of one camera and one robot alone.
                yield replace(named, do=Step(COUNTED_BACKWARDS))
                continue
            step = (
                f"Look at an image of {pair.camera} first: where it is mirrored (a flip in the "
                "camera's driver, a mirror before the lens), turn its images back, and calibrate "
                "anew."
            )
            yield replace(named, do=Step(step))


def _closes(known: RunState, robot: str, pair: Pair) -> bool:
    """Whether the chain of a pair closes as declared."""
    reported = known.robots[robot].base_from_flange
    views = [it for it in pair.poses if it in reported]
    places = tuple(f"view {it}" for it in views)
    robot_poses = np.array([reported[it] for it in views]).reshape(-1, 4, 4)
    seen = np.array([pair.poses[it].cam_from_target[0] for it in views]).reshape(-1, 4, 4)
    recording = Recording(
        PoseNumbers.of_poses(robot_poses, places),
        PoseNumbers.of_poses(seen, places),
        pair.mount,
        is_measured=True,
    )
    return closes(recording)


def closes_as_declared(seen: RunState) -> bool:
    """Whether the chain closes with the poses as they are declared: nothing else is tried.

    Args:
        seen: What is known once the camera's poses are.
    """
    seen = replace(seen, poses=seen.poses_of_one_board)
    robot = _at_times(seen)
    recording = Recording(
        robot, _camera_numbers(seen), seen.session.mount, is_measured=bool(seen.corners)
    )
    return closes(recording)


def is_suspect(known: RunState) -> bool:
    """Whether a finished calibration looks as if its poses had been misread."""
    verdict, findings = known.verdict, known.findings
    if verdict is None or findings is None or verdict.status == "good":
        return False
    out = not known.fitted.agreed.used.all()
    return out or is_scattered(findings) or known.robot is not None


def _at_times(seen: RunState) -> PoseNumbers:
    """The robot's numbers out of its stream, at the views' times; NaN where it has none."""
    numbers = np.full((len(seen.session.views), 7), np.nan)
    for at, view in enumerate(seen.session.views):
        if view.number in seen.base_from_flange:
            pose = RigidTransform.from_matrix(seen.base_from_flange[view.number])
            numbers[at] = [*pose.translation, *pose.rotation.as_quat()]
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), _places(seen.session))


def _seen(known: RunState) -> RunState:
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


def _seen_ways(seen: RunState, robot: PoseNumbers) -> Iterator[PoseNumbers]:
    """The camera's poses as the declared robot would have them, and then by the images alone."""
    # They differ where an image allows several poses: the wrong robot would choose wrong ones.
    if any(len(it.cam_from_target) > 1 for it in seen.poses.values()):
        # Where the declared robot cannot choose, the images alone are left.
        with suppress(VisioncalError):
            yield _camera_numbers(_chosen(seen, robot))
    yield _camera_numbers(seen)


def _chosen(seen: RunState, robot: PoseNumbers) -> RunState:
    """Chooses among the poses that an image allows by the declared robot."""
    base_from_flange = dict(
        zip((it.number for it in seen.session.views), robot.poses(), strict=True)
    )
    both = [it for it in seen.poses.values() if np.isfinite(base_from_flange[it.view]).all()]
    problem = chain(
        seen.session.mount,
        np.array([base_from_flange[it.view] for it in both]).reshape(-1, 4, 4),
        np.array([it.cam_from_target[0] for it in both]).reshape(-1, 4, 4),
    )
    boards = [*seen.session.boards.values()]
    targets = {it: boards[both[0].board] for it in problem.observations.observed if boards}
    found = init_frames(problem, both, targets)
    return replace(seen, poses={it.view: it for it in found.views})


def _camera_numbers(seen: RunState) -> PoseNumbers:
    """The target's poses, of each view the best by its image, or as the session gives them."""
    if not seen.corners:
        numbers = numbers_in(seen.session, MEASURED_CAM_POSE)
        shown = np.array([view.number in seen.poses for view in seen.session.views])
        return replace(
            numbers,
            positions=np.where(shown[:, None], numbers.positions, np.nan),
            rotations=np.where(shown[:, None], numbers.rotations, np.nan),
        )
    poses = np.full((len(seen.session.views), 4, 4), np.nan)
    for at, view in enumerate(seen.session.views):
        if view.number in seen.poses:
            poses[at] = seen.poses[view.number].cam_from_target[0]
    return PoseNumbers.of_poses(poses, _places(seen.session))


def _places(session: Session) -> tuple[str, ...]:
    return tuple(f"view {view.number}" for view in session.views)
