"""Whether only another reading of a session's poses explains what its camera sees, and which."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.guess import Candidate, guess_reading
from visioncal.calibration.guess.changed_rows import changed_rows
from visioncal.calibration.guess.given import FEWEST_ROWS, Recording, closes
from visioncal.calibration.pipeline.exchanged_names import exchanged_names
from visioncal.calibration.pipeline.guess_inputs import (
    at_times,
    camera_numbers,
    chain_poses,
    guess_seen,
    numbers_in,
    places_of,
    seen_by_camera,
    seen_ways,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import stages_before
from visioncal.calibration.stages.cameras import COUNTED_BACKWARDS
from visioncal.calibration.stages.doubts import is_scattered
from visioncal.calibration.stages.joints import match_joints
from visioncal.calibration.stages.robots import CameraTargetPair, pairs_of
from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import VisioncalError
from visioncal.core.number_format import percent
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import CALIBRATE, GUESS_AND_CALIBRATE, READ_AGAIN, Finding, Remedy
from visioncal.estimation.chain import robot_part
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.checks import unit_warning
from visioncal.session.columns import POSE, POSITION

_MISREAD = "misread_poses"
# A robot that turns by less stands, a target that turns by more does not, ambiguous poses aside
# [deg].
_STILL_DEG, _TURNED_DEG = 0.5, 10.0
# Positions that differ by less are one [m].
_STILL_M = 1e-3
# Robot and camera turn alike between two views where they differ by less [deg].
_ALIKE_DEG = 3.0
# Rows are as good as shuffled where less than a third of them are those of their views: a ninth of
# the pairs beyond those by chance; not of fewer rows, or of turns so small that chance makes more
# of the pairs alike.
_SHUFFLES, _PAIRS_IN_PLACE, _FEWEST_SHUFFLED, _MOST_BY_CHANCE = 200, 1.0 / 9.0, 6, 0.3

# No copy mirrors sound poses unasked: another sign of y would look as good.
_MIRRORED = Remedy(
    "Look at an image first: where it is mirrored (a flip in the camera's driver, a mirror before "
    "the lens), turn the images back (and find the corners anew), and calibrate anew. Only where "
    "the robot's frame is left-handed, convert with --guess --mirror-poses."
)
_MIRRORED_CORNERS = Remedy(
    f"{COUNTED_BACKWARDS} As they are, the board would be seen from behind. Write a copy of the "
    "session whose u_px are mirrored back, and calibrate it.",
    GUESS_AND_CALIBRATE,
)
_UNRECORDED = Remedy(
    "Look how the poses were recorded: a logger that repeats one pose, or that writes positions as "
    "0, 0, 0 or rotations as 0, 0, 0, 1, gives no calibration. Record them again, at the same time "
    "as the images."
)
_NOT_ALONE = (
    "With this unit alone, robot, camera and target do not agree either: something else is wrong, "
    "too."
)
_UNIT_FIRST = Remedy(
    "Write x_m, y_m and z_m of views.csv in metres, and calibrate again: what else is wrong is "
    "said then.",
    CALIBRATE,
)
_UNPAIRED = Remedy(
    "Look how rows and images were paired: files sorted by name (10 before 2), rows sorted anew, "
    "views.csv of another run. Write into column image which file belongs to each row."
)
_UNPAIRED_JOINTS = Remedy(
    "Look first whether [robot] model in session.toml is this arm, through which the joint angles "
    f"become poses. {_UNPAIRED.words}"
)
_BESIDE_JOINTS = Remedy(
    "Look for exchanged columns and shifted rows among x_m to qw in views.csv; or delete these "
    "columns, and the poses are those of the joint angles.",
    CALIBRATE,
)


def reading_hint(seen: RunState) -> Finding | None:
    """Says which reading of the poses would explain a calibration that failed.

    Args:
        seen: What is known once the camera's poses are.

    Returns:
        It, with the command that applies it; None where no reading stands out.
    """
    hint = _unrecorded(seen) or _changed_midway(seen)
    if hint is not None:
        return hint
    try:
        guess = guess_seen(seen)
    except VisioncalError:
        # Too little to guess from: what failed has been said already.
        return None
    if not guess.stands_out:
        if guess.declared.closes:
            return None
        beside = _poses_beside_joints(seen, guess.declared)
        return beside or _one_position(seen) or _other_unit(seen) or _unpaired(seen)
    best, views = guess.best, seen.session.views
    is_mirrored = best.hypothesis.robot.signs == "mirror"
    swap = best.hypothesis.swap if len(best.differences) == 1 else ()
    exchanged = tuple(views[row].number for row in swap)
    step = READ_AGAIN
    if is_mirrored:
        step = _MIRRORED_CORNERS if _corners_are_mirrored(seen) else _MIRRORED
    return Finding(_MISREAD, guess.sentence, step, exchanged)


def _corners_are_mirrored(seen: RunState) -> bool:
    """Whether corners.csv shows boards from behind, as a camera cannot see a print."""
    # A left-handed frame of the robot does not do that, nor do images that were mirrored before
    # another program numbered their corners.
    session = seen.session
    if any(view.image for view in session.views) or not session.corners:
        return False
    if any(board.kind == "points" for board in session.boards.values()):
        # Its z may point either way.
        return False
    poses = camera_numbers(seen).poses()
    # A board's z points into it.
    into = np.sum(poses[:, :3, 2] * poses[:, :3, 3], axis=1)
    return bool(np.nanmedian(into) < 0.0)


def session_is_mirrored(session: Session) -> bool:
    """Does what `_corners_are_mirrored` does with a session of which nothing is known yet.

    Raises:
        VisioncalError: The camera's poses cannot be found.
    """
    return _corners_are_mirrored(seen_by_camera(RunState(session)))


def _unrecorded(seen: RunState) -> Finding | None:
    """Says that the robot's rotations were not recorded, where the camera sees others."""
    robot, camera = at_times(seen), camera_numbers(seen)
    both = robot.there & camera.there
    if both.sum() < FEWEST_ROWS:
        return None
    moved = [invert(array[:1]) @ array for array in (way.poses()[both] for way in (robot, camera))]
    by_robot, by_camera = map(rotation_angle, moved)
    most, half = np.rad2deg([by_robot.max(), np.median(by_camera)]).tolist()
    if most > _STILL_DEG or half < _TURNED_DEG:
        return None
    is_one_pose = bool(np.abs(moved[0][:, :3, 3]).max() < _STILL_M)
    said, wrong = f"The robot's poses turn by {most:.2g} deg at most", "rotations"
    if is_one_pose:
        said, wrong = "All rows have one pose of the robot", "poses"
    words = (
        f"{said}, and between the same views the camera sees the target turn by {half:.2g} deg: "
        f"the recorded {wrong} are not those of the views."
    )
    return Finding(_MISREAD, words, _UNRECORDED)


def _changed_midway(seen: RunState) -> Finding | None:
    """Says that the robot's poses are read otherwise from some view on."""
    found = changed_rows(_recording(seen))
    if found is None:
        return None
    numbers = [view.number for view in seen.session.views]
    views = tuple(numbers[row] for row in found.rows)
    when, others = f"From view {views[0]} on", "before them"
    if not found.is_behind:
        when, others = f"Up to view {views[-1]}", "behind them"
    words = (
        f"{when}, the robot's poses are not those of the others: with {' and '.join(found.words)}, "
        f"these views fit the ones {others}, and as declared they do not."
    )
    rows = f"rows {views[0]} to {views[-1]} of views.csv"
    shift = found.reading.shift
    step = (
        f"In {rows}, move the poses {'up' if shift > 0 else 'down'} by "
        f"{'one row' if abs(shift) == 1 else f'{abs(shift)} rows'}, delete rows that are left "
        "without a pose, and look why an image or a pose is missing there."
        if shift
        else f"Correct the poses in {rows} (base_from_flange in metres, quaternion x, y, z, w), or "
        "delete these rows; and look what was set up anew in between."
    )
    return Finding(_MISREAD, words, Remedy(step, CALIBRATE), views)


def _one_position(seen: RunState) -> Finding | None:
    """Says that the robot's positions were not recorded, where they explain nothing."""
    robot = at_times(seen)
    positions = robot.poses()[robot.there, :3, 3]
    is_one = len(positions) >= FEWEST_ROWS and np.ptp(positions, axis=0).max() < _STILL_M
    words = (
        "All rows have one position of the robot, and that does not explain what the camera sees: "
        "the recorded positions are not those of the views."
    )
    return Finding(_MISREAD, words, _UNRECORDED) if is_one else None


def _other_unit(seen: RunState) -> Finding | None:
    """Says that the robot's positions are in another unit, which alone explains nothing."""
    words = unit_warning(seen.session.views, POSITION)
    return Finding(_MISREAD, f"{words} {_NOT_ALONE}", _UNIT_FIRST) if words else None


def _unpaired(seen: RunState) -> Finding | None:
    """Says that rows and images have nothing in common, where shuffled rows fit as well."""
    # By how much robot and camera turn between two views, which is the same whatever the frames
    # between them are.
    robot, camera = at_times(seen), camera_numbers(seen)
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
    by_chance = float(np.mean([alike(rng.permutation(len(by_robot))) for _ in range(_SHUFFLES)]))
    if share > by_chance + _PAIRS_IN_PLACE or by_chance > _MOST_BY_CHANCE:
        return None
    words = (
        "The robot's poses are not those of the images: of all pairs of views, robot and camera "
        f"turn alike in {percent(share)}, and in {percent(by_chance)} if rows are shuffled."
    )
    is_reported = numbers_in(seen.session, POSE).there.any()
    return Finding(_MISREAD, words, _UNPAIRED if is_reported else _UNPAIRED_JOINTS)


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
    robot = PoseNumbers.of_poses(chain, places_of(session))
    for camera in seen_ways(seen, robot):
        by_joints = guess_reading(
            robot, camera, session.mount, is_measured=bool(seen.corners)
        ).declared
        if by_joints.closes:
            words = (
                f"The reported poses are wrong: with them the chain closes to {declared.figures} "
                f"only, with the joint angles and the robot's model to {by_joints.figures}."
            )
            return Finding(_MISREAD, words, _BESIDE_JOINTS)
    return None


def misreadings(known: RunState) -> Iterator[Finding]:
    """Says where the chain does not close as declared, and which reading explains it.

    Args:
        known: What is known once the cameras' poses are.
    """
    if known.mount is None:
        yield from _readings_in_cell(known)
    elif not _closes_as_declared(known) and (hint := reading_hint(known)) is not None:
        yield hint


def _readings_in_cell(known: RunState) -> Iterator[Finding]:
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
                for stage in stages_before("solve"):
                    part = stage.run(part)
            except VisioncalError:
                # There is too little to see.
                continue
            hint = next(misreadings(part), None)
            if hint is None:
                continue
            if hint.do not in (_MIRRORED, _MIRRORED_CORNERS):
                step = (
                    f"Correct the rows of robot {robot} in views.csv (base_from_flange in metres, "
                    "quaternion x, y, z, w), and calibrate again."
                )
                yield replace(hint, words=f"Robot {robot}: {hint.words}", do=Remedy(step))
                # All cameras would say so.
                break
            mirrored.add(pair.camera)
            named = replace(hint, words=f"Camera {pair.camera}: {hint.words}")
            if hint.do is _MIRRORED_CORNERS:
                # A copy is written of one camera and one robot alone.
                yield replace(named, do=Remedy(COUNTED_BACKWARDS))
                continue
            step = (
                f"Look at an image of {pair.camera} first: where it is mirrored (a flip in the "
                "camera's driver, a mirror before the lens), turn its images back, and calibrate "
                "anew."
            )
            yield replace(named, do=Remedy(step))


def _closes(known: RunState, robot: str, pair: CameraTargetPair) -> bool:
    """Whether the chain of a pair closes as declared."""
    reported = known.robots[robot].base_from_flange
    views = [pose for pose in pair.poses if pose in reported]
    places = tuple(f"view {view}" for view in views)
    robot_poses = np.array([reported[view] for view in views]).reshape(-1, 4, 4)
    seen = np.array([pair.poses[view].cam_from_target[0] for view in views]).reshape(-1, 4, 4)
    recording = Recording(
        PoseNumbers.of_poses(robot_poses, places),
        PoseNumbers.of_poses(seen, places),
        pair.mount,
        is_measured=True,
    )
    return closes(recording)


def _closes_as_declared(seen: RunState) -> bool:
    """Whether the chain closes with the poses as they are declared: nothing else is tried.

    Args:
        seen: What is known once the camera's poses are.
    """
    return closes(_recording(seen))


def _recording(seen: RunState) -> Recording:
    """The robot's poses, and the camera's, before anything is chosen by how they agree."""
    return Recording(
        at_times(seen), camera_numbers(seen), seen.session.mount, is_measured=bool(seen.corners)
    )


def is_suspect(known: RunState) -> bool:
    """Whether a finished calibration looks as if its poses had been misread."""
    verdict, findings = known.verdict, known.findings
    if verdict is None or findings is None or verdict.status == "good":
        return False
    out = not known.fitted.agreed.used.all()
    return out or is_scattered(findings) or known.robot is not None
