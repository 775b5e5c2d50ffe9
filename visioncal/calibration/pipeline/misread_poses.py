"""Findings on misread poses: another reading of them explains what the cameras see."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.guess.fit import CLOSING_SCORE, distances, robust_fit
from visioncal.calibration.guess.readings import SHIFTS, Hypothesis, changes
from visioncal.calibration.guess.search import FEWEST_ROWS, Recording, chains, closes
from visioncal.calibration.pipeline.guess_inputs import (
    camera_numbers,
    guess_from_camera_poses,
    robot_numbers,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import stages_before
from visioncal.calibration.stages.cameras import COUNTED_BACKWARDS
from visioncal.calibration.stages.corner_numbers import are_from_behind
from visioncal.calibration.stages.robots import CameraTargetPair, pairs_of
from visioncal.calibration.suspects.checks import is_scattered
from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import VisioncalError
from visioncal.core.number_format import percent
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.core.verdict import (
    CALIBRATE,
    GUESS_AND_CALIBRATE,
    READ_AGAIN,
    Finding,
    Remedy,
    exchanging,
)
from visioncal.estimation.chain import robot_part
from visioncal.session import Session

_MISREAD = "misread_poses"
# A robot that turns and moves by less did not move; a target that turns by at least the last did,
# even with ambiguous poses.
_STILL_DEG, _STILL_M, _TURNED_DEG = 0.5, 1e-3, 10.0
# Fewest rows at one end that determine both edges, and fewest that show another reading.
_REFERENCE, _FEWEST = 6, 3
# Least share of rows that agree with their reading, and largest share with a wrong one.
_AGREEING_SHARE, _WRONG_SHARE = 0.9, 0.2
# Robot and camera turn alike between two views where the angles differ by less [deg].
_ALIKE_DEG = 3.0
# Rows are taken for shuffled where less than a third of them belong to their views: then less than
# a ninth of the pairs are alike beyond those by chance. Not tested with fewer rows, or with turns
# so small that more pairs are alike by chance.
_SHUFFLES, _PAIRS_IN_PLACE, _FEWEST_SHUFFLED, _MOST_BY_CHANCE = 200, 1.0 / 9.0, 6, 0.3

# Poses are mirrored only on request: another sign of y would fit as well.
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
_UNPAIRED = Remedy(
    "Look how rows and images were paired: files sorted by name (10 before 2), rows sorted anew, "
    "views.csv of another run; and, where joint angles become poses, whether [robot] model in "
    "session.toml is this arm. Write into column image which file belongs to each row."
)


def misread_pose_finding(run: RunState) -> Finding | None:
    """Finding on the reading of the poses that closes the chain, if any; after the stage `pnp`."""
    hint = _unrecorded(run, "rotations") or _changed_midway(run)
    if hint is not None:
        return hint
    try:
        guess = guess_from_camera_poses(run)
    except VisioncalError:
        # Too little to guess from; the calibration's own error says so.
        return None
    if not guess.stands_out:
        if guess.declared.fit.closes:
            return None
        return _unrecorded(run, "positions") or _unpaired(run)
    best, step = guess.best, READ_AGAIN
    swap = best.hypothesis.swap if len(best.differences) == 1 else ()
    exchanged = tuple(run.session.views[row].number for row in swap)
    if len(exchanged) == 2:
        step = exchanging(*exchanged)
    if best.hypothesis.robot.mirrored:
        step = _MIRRORED_CORNERS if session_is_mirrored(run.session) else _MIRRORED
    return Finding(_MISREAD, guess.sentence, step, exchanged)


def session_is_mirrored(session: Session) -> bool:
    """Whether a session's corners.csv shows boards from behind, which a camera cannot see."""
    # Neither a left-handed robot frame has that effect, nor images that were mirrored before
    # another program numbered their corners.
    boards, corners = session.boards, session.corners
    seen = [view for view in session.views if view.number in corners]
    views = [(corners[view.number], boards[session.board_of(view)]) for view in seen]
    return not any(view.image for view in session.views) and are_from_behind(views)


def _unrecorded(run: RunState, what: str) -> Finding | None:
    """Finding that rotations, or positions, were not recorded: they are constant, as none seen."""
    robot, camera = robot_numbers(run), camera_numbers(run)
    both = robot.present & camera.present
    if both.sum() < FEWEST_ROWS:
        return None
    of_robot, of_camera = robot.poses()[both], camera.poses()[both]
    motions = invert(of_robot[:1]) @ of_robot
    turns = np.rad2deg(rotation_angle(motions)).max() > _STILL_DEG
    moves = np.abs(motions[:, :3, 3]).max() > _STILL_M
    seen_deg = np.rad2deg(np.median(rotation_angle(invert(of_camera[:1]) @ of_camera)))
    if (turns or seen_deg < _TURNED_DEG) if what == "rotations" else moves:
        return None
    one = "pose" if not turns and not moves else what[:-1]
    return Finding(
        _MISREAD,
        f"All rows have one {one} of the robot, and between the same views the camera sees the "
        f"target turn by {seen_deg:.2g} deg: the recorded {one}s are not those of the views.",
        _UNRECORDED,
    )


def _changed_midway(run: RunState) -> Finding | None:
    """Finding that the robot's poses need another reading from some view on, or up to one."""
    # A driver that is set up anew midway writes other units or rotations; an image that was lost,
    # or a pose that was recorded twice, shifts all rows behind it.
    recording = _recording(run)
    rows = recording.common_rows
    if len(rows) < _REFERENCE + _FEWEST or (changed := _changed_rows(recording, rows)) is None:
        return None
    at, reading = changed
    views = tuple(run.session.views[row].number for row in at)
    words = (
        f"From view {views[0]} on, the robot's poses are not those of the others: with "
        f"{reading.changes[0]}, these views fit the ones before, and as declared they do not."
    )
    step = f"In rows {views[0]} to {views[-1]} of views.csv, "
    if shift := SHIFTS.get(reading.order, 0):
        step += (
            f"move the poses {'up' if shift > 0 else 'down'} by "
            f"{'one row' if abs(shift) == 1 else f'{abs(shift)} rows'}, delete rows that are left "
            "without a pose, and look why an image or a pose is missing there."
        )
    else:
        step += (
            "correct the poses (base_from_flange in metres, quaternion x, y, z, w), or delete "
            "these rows; and look what was set up anew in between."
        )
    return Finding(_MISREAD, words, Remedy(step, CALIBRATE), views)


def _changed_rows(recording: Recording, rows: IntArray) -> tuple[IntArray, Hypothesis] | None:
    """The last of some rows, which only another reading explains, and that; None without."""
    declared = recording.declared
    robot, camera = (side[0] for side in chains(recording, [declared], rows))
    count = _REFERENCE
    for _ in range(2):
        fit = robust_fit(robot[:count], camera[:count])
        edges = fit.x, fit.z
        agrees = distances(robot, camera, fit.lever, edges).residuals < CLOSING_SCORE
        count = _rows_before_change(agrees)
        if count < _REFERENCE or len(rows) - count < _FEWEST:
            return None
    tried = [
        change.of(declared)
        for change in changes(declared, is_measured=True)
        if change.name in ("unit", "turns", "inverse") or change.words in SHIFTS
    ]
    robots, cameras = chains(recording, tried, rows[count:])
    for reading, robot, camera in zip(tried, robots, cameras, strict=True):
        residuals = distances(robot, camera, fit.lever, edges).residuals
        # A shift leaves as many rows without a partner: at the table's end where images are lost,
        # at its beginning where poses are.
        paired = len(residuals) - abs(SHIFTS.get(reading.order, 0))
        if np.sum(residuals < CLOSING_SCORE) >= max(_FEWEST, _AGREEING_SHARE * paired):
            return rows[count:], reading
    return None


def _rows_before_change(agrees: Mask) -> int:
    """Number of rows before the change point; 0 without a clear one."""
    agreeing = np.append(0, np.cumsum(agrees))
    change = int(np.argmax(2 * agreeing - np.arange(len(agreeing))))
    share_behind = float(np.mean(agrees[change:])) if change < len(agrees) else 0.0
    is_clear = agreeing[change] >= _AGREEING_SHARE * change and share_behind <= _WRONG_SHARE
    return change if is_clear else 0


def _unpaired(run: RunState) -> Finding | None:
    """Finding that rows do not belong to their images: shuffled rows fit about as well."""
    # Robot and camera rotate by the same angle between two views, whatever the unknown frames.
    robot, camera = robot_numbers(run), camera_numbers(run)
    both = robot.present & camera.present
    if both.sum() < _FEWEST_SHUFFLED:
        return None
    by_robot = _pairwise_angles(robot_part(robot.poses()[both], run.session.mount))
    by_camera = _pairwise_angles(invert(camera.poses()[both]))
    first, second = np.triu_indices(len(by_robot), 1)

    def share_alike(order: IntArray) -> float:
        difference = by_robot[order[first], order[second]] - by_camera[first, second]
        return float(np.mean(np.abs(difference) < np.deg2rad(_ALIKE_DEG)))

    rng, count = np.random.default_rng(0), len(by_robot)
    share = share_alike(np.arange(count))
    by_chance = float(np.mean([share_alike(rng.permutation(count)) for _ in range(_SHUFFLES)]))
    if share > by_chance + _PAIRS_IN_PLACE or by_chance > _MOST_BY_CHANCE:
        return None
    words = (
        "The robot's poses are not those of the images: of all pairs of views, robot and camera "
        f"turn alike in {percent(share)}, and in {percent(by_chance)} if rows are shuffled."
    )
    return Finding(_MISREAD, words, _UNPAIRED)


def _pairwise_angles(poses: FloatArray) -> FloatArray:
    """(n, n) rotation angles between (n, 4, 4) poses [rad]."""
    return rotation_angle(invert(poses)[:, None] @ poses)


def misreadings(run: RunState) -> Iterator[Finding]:
    """Findings on misread poses, where chains do not close as declared; after the stage `pnp`."""
    if run.mount is None:
        yield from _misreadings_in_cell(run)
    elif not _closes(run) and (hint := misread_pose_finding(run)) is not None:
        yield hint


def turned_boards(run: RunState) -> Iterator[Finding]:
    """Findings on boards that corners.csv numbers as if they were seen from behind.

    Their frames are turned over. The chain closes nevertheless: of mirrored images it does not.
    """
    session = run.session
    for name, target in session.boards.items():
        views = [
            view
            for view in session.views
            if view.has_corners and view.number in run.poses and session.board_of(view) == name
        ]
        if not are_from_behind([(session.corners[view.number], target) for view in views]):
            continue
        if run.mount is None or _closes(run):
            whose = f"target {name}" if name else "the board"
            yield Finding(
                "corner_numbers",
                f"corners.csv numbers the corners of {whose} as if it was seen from behind: rows "
                "from the bottom up, column by column, or counterclockwise. The camera's pose "
                "holds, but the board's frame is turned over: its z axis points at the camera.",
                Remedy(
                    "Number them as they are printed, row by row from corner 0, at the upper left; "
                    "those of a marker clockwise from there. Calibrate again.",
                    CALIBRATE,
                ),
                tuple(view.number for view in views),
            )


def _misreadings_in_cell(run: RunState) -> Iterator[Finding]:
    """Findings on the robots and cameras of a whole cell whose rows are misread.

    Each camera is tested with one target and one robot alone, those of most views first.
    """
    for robot in run.session.robots:
        for pair in pairs_of(run, robot):
            if _closes_in_cell(run, robot, pair):
                continue
            hint = _misread_in_pair(run, robot, pair)
            if hint is None:
                continue
            # The command that writes a copy takes one camera and one robot only.
            whose, step = f"Camera {pair.camera}", COUNTED_BACKWARDS
            if hint.do == _MIRRORED:
                step = _MIRRORED.words
            elif hint.do != _MIRRORED_CORNERS:
                whose = f"Robot {robot}"
                step = (
                    f"Correct the rows of robot {robot} in views.csv (base_from_flange in metres, "
                    "quaternion x, y, z, w), and calibrate again."
                )
            yield replace(hint, words=f"{whose}: {hint.words}", do=Remedy(step))
            # All cameras would show the same.
            break


def _misread_in_pair(run: RunState, robot: str, pair: CameraTargetPair) -> Finding | None:
    try:
        part = RunState(run.session.of(pair.camera, robot, pair.target), None, run.threads)
        for stage in stages_before("solve"):
            part = stage.run(part)
    except VisioncalError:
        # Too few views of this pair.
        return None
    return next(misreadings(part), None)


def _closes_in_cell(run: RunState, robot: str, pair: CameraTargetPair) -> bool:
    """Whether the chain of a pair closes as declared."""
    reported = run.robots[robot].base_from_flange
    both = [
        (reported[view], poses.cam_from_target[0])
        for view, poses in pair.poses.items()
        if view in reported
    ]
    sides = np.array(both).reshape(-1, 2, 4, 4)
    of_robot, of_camera = (PoseNumbers.of_poses(sides[:, at], [""] * len(both)) for at in (0, 1))
    return closes(Recording(of_robot, of_camera, pair.mount, is_measured=True))


def _closes(run: RunState) -> bool:
    """Whether the chain closes as declared."""
    return closes(_recording(run))


def _recording(run: RunState) -> Recording:
    """The poses of robot and camera as declared, of the camera the best by each image."""
    sides = robot_numbers(run), camera_numbers(run)
    return Recording(*sides, run.session.mount, is_measured=bool(run.corners))


def may_be_misread(run: RunState) -> bool:
    """Whether a finished calibration may be of misread poses."""
    verdict, findings = run.verdict, run.findings
    if verdict is None or findings is None or verdict.status == "good":
        return False
    has_outliers = not run.cell_fit.inlier_fit.used.all()
    return has_outliers or is_scattered(findings) or run.robot is not None
