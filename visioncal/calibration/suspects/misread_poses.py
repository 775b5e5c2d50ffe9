"""Findings on misread poses: another reading of them explains what the cameras see."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.calibration.guess.decide import POSE_OPTIONS, Guess
from visioncal.calibration.guess.readings import OR_IMAGES
from visioncal.calibration.guess.recording import FEWEST_ROWS, thinned
from visioncal.calibration.guess.search import PAIRS_SHARE, relative_angles
from visioncal.calibration.pipeline.guess_inputs import (
    both_sides,
    closes,
    guess_from_camera_poses,
    of_pair,
    open_pairs,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cameras import exchanged_columns, shows_print
from visioncal.calibration.stages.cell import rows_of_robot, stop_of, stops_by_view
from visioncal.calibration.stages.corner_numbers import EXCHANGE_COLUMNS, are_from_behind
from visioncal.calibration.stages.other_board import MEND_IMAGES
from visioncal.calibration.stages.robots import CameraTargetPair, pairs_of
from visioncal.calibration.suspects.declared_frames import carried, on_another
from visioncal.calibration.suspects.late_poses import by_joints, on_the_way
from visioncal.calibration.suspects.misread_readings import misread_readings
from visioncal.calibration.suspects.missing_axis import missing_axes
from visioncal.calibration.suspects.mistaken_rows import Undoing
from visioncal.calibration.suspects.moved_views import IN_MOTION
from visioncal.calibration.suspects.other_rows import of_other_rows
from visioncal.calibration.suspects.pairs_alone import of_all_rows
from visioncal.calibration.suspects.record import Edges, Record, StopOfRobot, evidence
from visioncal.calibration.suspects.suspect import ARM_ERRORS, CHAIN, SOURCES, STEPS, Suspect
from visioncal.calibration.suspects.undoing import likeliest, undone
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import FEWEST_COMPARED
from visioncal.core.number_format import robot_words, view_words
from visioncal.core.types import FloatArray
from visioncal.core.verdict import (
    BY_HAND,
    CALIBRATE,
    CALIBRATE_FIXED,
    GUESS,
    READ_AGAIN,
    Finding,
    Option,
    Remedy,
    calibrating,
    mending,
    or_alone,
)
from visioncal.session.columns import POSE

# A robot that moves by less stood still [m].
_STILL_M = 1e-3
# In `PAIRS_SHARE` of the pairs, those of sound views, the angles by which robot and camera turn
# differ by less [rad]: by 2 degrees for a servo arm that repeats to 2 degrees, by 4 to 15 where
# angles were misread or rows are mixed up.
_MISREAD_RAD = float(np.deg2rad(3.5))
# Where a third of the rows are sound, in a ninth of the pairs the angles differ by less [rad].
_ALIKE_RAD, _PAIRS_IN_PLACE = 0.01, 1.0 / 9.0

# Poses are mirrored only on request: another sign of y would fit as well.
_MIRRORED = calibrating(
    "Look at an image first: where it is mirrored (a flip in the camera's driver, a mirror before "
    "the lens; in a corners.csv, u_px counts to the right and v_px down), write a copy in which "
    "images and corners are mirrored back, and",
    "it. Only where the robot's frame is left-handed, convert with --guess --yes --mirror-poses.",
    MEND_IMAGES,
)
_LEFT_HANDED = calibrating(
    "The images are not mirrored, as the markers in them are not: one axis of the robot's frame "
    "points the other way. Write a copy in which y of its poses is mirrored, try its axes by one "
    "known motion before the robot moves by them, and",
    "it.",
    f"{GUESS} --mirror-poses && {CALIBRATE_FIXED}",
)
_LOST_TURNS = Remedy(
    "Where the poses were made of the robot's angles, convert these to radians first (np.deg2rad, "
    "or degrees=True of SciPy), and write the poses anew; or convert the robot's own log. The "
    "session cannot be mended: whole turns about the last axis of the tool are lost."
)
_WHICH = (
    "Look how the program wrote the poses, and where the camera is; then convert the recording "
    f"anew with that stated: {POSE_OPTIONS}."
)
_LOG_ANEW = Remedy(
    "Look how this number comes into the log, and record again; or convert the robot's own log."
)
_HALF_TURNS = (
    "are half turns in all views, about axes in all directions: the real part of their quaternion "
    "was lost, as where w was 0 or one of three numbers was taken for it. How far each turns "
    "cannot be found again from these numbers."
)
_REAL_PART = Remedy(
    "Convert the recording itself again, with all four numbers of each quaternion, or with x, y "
    "and z alone as it wrote them (--robot-form or --camera-form quaternion-xyz)."
)
# A number that stands still does so to a digit; others vary by more [mm, deg].
_DIGIT_MM, _DIGIT_DEG, _VARIES_MM, _VARIES_DEG = 1e-3, 2e-3, 20.0, 5.0
UNRECORDED = Remedy(
    "Convert the recording itself again with --guess, if the session was made of one: angles that "
    "were misread cannot all be read anew from here. Or look how the poses were recorded, and how "
    "they were paired with the images: a logger that repeats one pose, or writes positions of 0, "
    "0, 0 or rotations of 0, 0, 0, 1; files sorted by name (10 before 2), rows sorted anew, "
    "views.csv of another run; and, where joint angles become poses, whether [robot] model in "
    "session.toml is this arm. Write into column image which file belongs to each row."
)


def with_misreading(run: RunState) -> RunState:
    """The run with the likeliest misreading of its poses, once they are read; none where unlikely.

    Misread joints were reported before: they would mislead this search.
    """
    if run.misread is not None:
        return run
    found = (*islice(misreadings(run), 1),)
    joints = [warning for warning in run.warnings if warning.kind == "misread_joints"]
    # Poses by angles whose mistake is known are those of no other mistake.
    if found and joints and not any(POSE[0] in view.numbers for view in run.session.views):
        rest = tuple(warning for warning in run.warnings if warning not in joints)
        return replace(run, misread=(replace(joints[0], kind=found[0].kind),), warnings=rest)
    return replace(run, misread=found)


def with_open_chains(run: RunState) -> RunState:
    """Looks for misread poses before the fit where chains do not close; notes turned boards."""
    run = with_undone(run)
    poses, boards = run.base_from_flange, run.poses_of_one_board
    if not (run.session.has_one_pair and closes(poses, boards, run.session.mount)):
        run = with_misreading(run)
    return run if run.misread else run.noting((), turned_boards(run))


def with_undone(run: RunState) -> RunState:
    """Leaves out the views that mistakes of the record explain, and names these.

    Of a whole cell, each robot is tested with one camera and one target alone.
    """
    if run.session.has_one_pair:
        # Each mistake hides the next.
        while (mistake := likeliest(run)) is not None:
            run = undone(run, mistake)
        return run
    for robot in run.session.robots:
        stops, commands = _stops_of(run, robot), set[str]()
        pairs = [(at, likeliest(of_pair(run, robot, at), stops)) for at in pairs_of(run, robot)]
        for pair, mistake in pairs:
            if mistake is None:
                continue
            of_images = _is_of_images(run, mistake.found, pair, pairs)
            subject = robot_words(robot)
            subject = (
                f"{subject[0].upper()}{subject[1:]}, in its rows of {pair.camera} and {pair.target}"
            )
            found = _with_rest_of_log(run, robot, mistake.found)
            do = found.do
            if do is not None and do.option.name == "views":
                # The other views are those of all pairs.
                others = [at.number for at in run.session.views if at.number not in found.views]
                do = or_alone(do.words, others)
            else:
                do = of_all_rows(found, run, robot, pair, of_images=of_images)
            fits = " The images of other cameras fit its poses." if of_images else ""
            found = replace(found, words=f"{subject}: {found.words}{fits}", do=do)
            # One command mends the robot's rows of all pairs.
            command = "" if do is None else do.command
            run = undone(run, replace(mistake, found=found), is_named=command in commands)
            commands |= {command} - {""}
    # Other robots' poses may be misread beside it.
    return replace(run, misread=run.misread or None)


def _with_rest_of_log(run: RunState, robot: str, found: Finding) -> Finding:
    """A finding on repeated poses of a robot with its rows that repeat these without a gap, too."""
    if found.kind != "copied_poses":
        return found
    poses, stops = run.robots[robot].base_from_flange, stops_by_view(run.session)
    # Stops with the pose of the one before, by each time that the robot, or its log, stood still.
    stills: list[dict[int, FloatArray]] = [{}]
    for (_, before), (stop, at) in pairwise(_stops_of(run, robot).items()):
        if np.array_equal(before.pose, at.pose):
            stills[-1][stop] = at.pose
        else:
            stills.append({})
    named = {stops[view] for view in found.views}
    stuck = {stop: pose for still in stills if named & {*still} for stop, pose in still.items()}
    among = {view: pose for view, pose in poses.items() if stops[view] in stuck}
    alike = {view for view, pose in among.items() if np.array_equal(pose, stuck[stops[view]])}
    rest = sorted(alike - {*found.views} - _agreeing(run, robot))
    if not rest:
        return found
    words = f"{found.words} Left out, too, where its poses are repeated: {view_words(rest)}."
    return replace(found, words=words, views=tuple(sorted((*found.views, *rest))))


def _agreeing(run: RunState, robot: str) -> set[int]:
    """Views of a robot of a cell that agree with the others of their camera and target."""
    found = set[int]()
    for pair in pairs_of(run, robot):
        record = Record.of(of_pair(run, robot, pair))
        paired = record.paired(np.arange(len(record.views)))
        is_enough = len(record.rows) >= FEWEST_COMPARED
        edges = Edges.by(record, paired, ~record.copies) if is_enough else None
        if edges is not None:
            ((agrees,),) = evidence(edges.of(paired)[None])[1:]
            found |= {*record.views[record.rows[agrees]].tolist()}
    return found


def _is_of_images(
    run: RunState,
    found: Finding,
    pair: CameraTargetPair,
    every: Sequence[tuple[CameraTargetPair, Undoing | None]],
) -> bool:
    """Whether the images of a pair's camera are rows apart, as others fit the poses there."""
    if found.kind != "shifted_rows":
        return False
    stops = stops_by_view(run.session)
    apart_stops = {stops[view] for view in found.views}
    others = [
        mistake is not None and mistake.found.kind == found.kind
        for one, mistake in every
        if one.camera != pair.camera and apart_stops & {stops[view] for view in one.poses}
    ]
    return bool(others) and not any(others)


def _stops_of(run: RunState, robot: str) -> dict[int, StopOfRobot]:
    """The stops of a robot of a cell, in the order of its rows."""
    found = dict[int, StopOfRobot]()
    by_view = run.robots[robot].base_from_flange if robot in run.robots else {}
    for view in rows_of_robot(run.session, robot):
        if view.number in by_view:
            found.setdefault(stop_of(view), StopOfRobot(view.number, by_view[view.number]))
    return found


def misreadings(run: RunState) -> Iterator[Finding]:
    """Findings on misread poses; after the stage `pnp`.

    Of a whole cell, each robot is tested with one camera and one target alone, those of most views
    first, where their chain does not close.
    """
    if run.session.has_one_pair:
        yield from _misread_poses(run) if run.readings is None else misread_readings(run)
        return
    for robot in (name for name in run.session.robots if name in run.robots):
        wrong, right = open_pairs(run, robot, run.robots[robot].base_from_flange)
        subject = robot_words(robot)
        for pair in wrong:
            if (other := on_another(run, robot, pair)) is not None:
                yield other
                break
            hint = next(_misread_poses(of_pair(run, robot, pair), (run, robot)), None)
            if hint is None:
                continue
            within = ""
            if right:
                # Through other cameras or targets its poses are right.
                seen = " and ".join(filter(None, [pair.camera, pair.target]))
                within = f", in its rows of {seen}"
            words = f"{subject[0].upper()}{subject[1:]}{within}: {hint.words}"
            of_images = any(one.camera != pair.camera for one in right)
            do = of_all_rows(hint, run, robot, pair, of_images=of_images)
            yield replace(hint, words=words, do=do)
            # All of these would show the same.
            break
    yield from carried(run)


def _rows_apart(run: RunState, by: int, cell: RunState, robot: str) -> Remedy:
    """Advice to give all views of a pair of a cell the poses of rows before or after."""
    views = [view.number for view in run.session.views]
    order = [*dict.fromkeys(stop_of(view) for view in rows_of_robot(cell.session, robot))]
    stops = stops_by_view(cell.session)
    # Rows are counted by the robot's stops, of which the pair may show every other one.
    steps = {
        *np.diff([order.index(stops[view]) for view in views if stops[view] in order]).tolist()
    }
    if not by or len(steps) != 1 or any(len(at.robots) > 1 for at in cell.session.observations):
        return BY_HAND
    return mending("each has its own pose", Option("shift", f"{by * steps.pop()}", tuple(views)))


def _misread_poses(run: RunState, within: tuple[RunState, str] | None = None) -> Iterator[Finding]:
    """The finding on the reading of one robot's poses that closes the chain, if any.

    Within a whole cell, a command reads the rows of this robot anew, or gives them other ones.
    """
    try:
        guess = guess_from_camera_poses(run)
    except VisioncalError:
        # Too little to guess from; the calibration's own error says so.
        return
    if guess.best.is_of_size and any(found.kind == "board_size" for found in run.warnings):
        # The fit's own size is the more precise one.
        return
    # A reading that closes it roughly does not precede columns that close it to the noise.
    if apart := [*of_other_rows(run, guess.best.fit.score)]:
        yield from apart
        return
    unknown = [*_unrecorded(run)]
    if guess.best.fit.closes:
        # Units that merely bring both sides nearer do not precede an axis that closes the chain;
        # poses a bit on the way close it roughly.
        unknown = [hint for hint in unknown if hint.do == IN_MOTION and not _is_counted(run, guess)]
    if guess.stands_out and all(hint.do in (UNRECORDED, _LOG_ANEW) for hint in unknown):
        robot = guess.best.hypothesis.robot
        step = _LOST_TURNS if robot.has_lost_turns else READ_AGAIN
        if within is not None and not guess.best.is_of_robot:
            step = _rows_apart(run, guess.best.rows_apart, *within)
        found = Finding("misread_poses", guess.sentence, step)
        yield _mirrored(run, found) if robot.mirrored else found
    elif guess.is_open:
        step = Remedy(_WHICH)
        if guess.positions:
            every = tuple(view.number for view in run.session.views)
            option = Option("positions", guess.positions, every)
            write = f"{_WHICH} Where the positions are wrong: Write"
            step = mending("positions are read otherwise", option, write)
        yield Finding("misread_poses", guess.sentence, step)
    yield from unknown


def _is_counted(run: RunState, guess: Guess) -> bool:
    """Whether another reading is the likelier one, or a fit counts what poses on the way do."""
    counted = ("stops_short", "moves_on")
    return guess.stands_out or any(found.kind in counted for found in run.warnings)


def _mirrored(run: RunState, found: Finding) -> Finding:
    """The finding that poses or images are mirrored, with the one that it is where that shows."""
    if exchanged_columns(run):
        words = f"In corners.csv, u_px and v_px are exchanged, as the lens shows. {found.words}"
        return replace(found, words=words, do=EXCHANGE_COLUMNS)
    if shows_print(run):
        words = found.words.replace(OR_IMAGES, "")
        return replace(found, words=words, do=_LEFT_HANDED)
    return replace(found, do=_MIRRORED if run.cameras else replace(_MIRRORED, command=""))


def _unrecorded(run: RunState) -> Iterator[Finding]:
    """The finding that the robot's poses are not those of the images, whatever the frames are."""
    views, pairs = both_sides(run.base_from_flange, run.poses_of_one_board, run.session.mount)
    kept, robot = thinned(np.arange(len(pairs))), pairs[:, 0]
    views, pairs = views[kept], pairs[kept]
    if len(pairs) < FEWEST_ROWS:
        return
    # Robot and camera turn by the same angle between two views, whatever the unknown frames.
    by_robot, by_camera = (relative_angles(pairs[:, side, :3, :3]) for side in (0, 1))
    away = np.abs(by_robot - by_camera)
    if still := _still(robot):
        yield Finding("misread_poses", still, _LOG_ANEW)
    if np.quantile(away, PAIRS_SHARE) < _ALIKE_RAD:
        yield from missing_axes(run, views, pairs)
    if np.median(away) > _ALIKE_RAD and (other := [*by_joints(run)]):
        yield from other
        return
    alike = float(np.mean(away < _ALIKE_RAD))
    if np.median(away) > _ALIKE_RAD and (late := on_the_way(robot, by_camera, kept)) is not None:
        yield late
        return
    if np.median(away) > _ALIKE_RAD and (side_name := _half_turned(pairs)):
        yield Finding("misread_poses", f"The {side_name}'s rotations {_HALF_TURNS}", _REAL_PART)
        return
    words = "The robot's poses are not those of the images: "
    if np.ptp(pairs[:, 0, :3, 3], axis=0).max() < _STILL_M:
        words += "all rows have one position of the robot."
    elif np.quantile(away, PAIRS_SHARE) > _MISREAD_RAD and alike < _PAIRS_IN_PLACE:
        words += (
            "between two views, robot and camera must turn by the same angle; here these differ by "
            f"{np.rad2deg(np.median(away)):.0f} deg (median of all pairs)."
        )
    else:
        return
    yield Finding("misread_poses", words, UNRECORDED)


def _half_turned(pairs: FloatArray) -> str:
    """The side of (m, 2, 4, 4) poses all of whose rotations are half turns; empty for none.

    Rotations of a tool that points straight down are, too, but about axes in one plane.
    """
    for side, poses in zip(("robot", "target"), pairs.swapaxes(0, 1), strict=True):
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
        spread = np.linalg.svd(turns, compute_uv=False)[-1] / np.sqrt(len(turns))
        if np.linalg.norm(turns, axis=1).min() > np.pi - _ALIKE_RAD and spread > 3 * _ALIKE_RAD:
            return side
    return ""


def _still(robot: FloatArray) -> str:
    """The number of (m, 4, 4) poses that stood still while all others varied; empty for none.

    Of positions, or of angles about moving axes in the orders that makers use.
    """
    turns = Rotation.from_matrix(robot[:, :3, :3])
    numbers: dict[str, tuple[Sequence[str], FloatArray, str, float, float]] = {
        "": ("xyz", 1e3 * robot[:, :3, 3], "mm", _DIGIT_MM, _VARIES_MM)
    }
    for order in ("ZYX", "XYZ", "ZYZ"):
        with warnings.catch_warnings(), suppress(UserWarning):
            # Where two axes coincide, one of their angles is zero by convention.
            warnings.simplefilter("error", UserWarning)
            angles = np.rad2deg(np.unwrap(turns.as_euler(order), axis=0))
            of = f", of angles about moving axes {order}"
            about = [f"angle about {axis}" for axis in order]
            numbers[of] = (about, angles, "deg", _DIGIT_DEG, _VARIES_DEG)
    for of, (names, values, unit, digit, varies) in numbers.items():
        spread = np.ptp(values, axis=0)
        at = int(spread.argmin())
        if spread[at] < digit and np.delete(spread, at).min() > varies:
            return (
                f"The robot's {names[at]} is {values[0, at]:.6g} {unit} in all {len(robot)} rows, "
                f"to the last digit{of}, though all else varies: the log repeated one number, or "
                "this column is not the robot's."
            )
    return ""


def turned_boards(run: RunState) -> Iterator[Finding]:
    """Findings on boards that corners.csv numbers as if they were seen from behind.

    Their frames are turned over, and where nothing is misread, the chain closes nevertheless.
    """
    session = run.session
    for name, target in session.boards.items():
        views = [
            view
            for view in session.views
            if view.has_corners and view.number in run.poses and session.board_of(view) == name
        ]
        if are_from_behind([(session.corners[view.number], target) for view in views]):
            subject = f"target {name}" if name else "the board"
            yield Finding(
                "corner_numbers",
                f"corners.csv numbers the corners of {subject} as if it was seen from behind: rows "
                "from the bottom up, column by column, or counterclockwise. The camera's pose "
                "holds, but the board's frame is turned over: its z axis points at the camera.",
                Remedy(
                    "Number them as they are printed, row by row from corner 0, at the upper left; "
                    "those of a marker clockwise from there. Calibrate again.",
                    CALIBRATE,
                ),
                tuple(view.number for view in views),
            )


# Findings measured through the robot, which mean nothing where its poses are misread.
BY_CHAIN = (
    *(*STEPS, ARM_ERRORS, "prior"),
    *("board_size", "board_shape", "lens", "lens_field", "corner_noise", "tool_frame"),
    *("carried_away", "tool_active", "late_poses", "untied"),
)
MISREAD_POSES, MISREAD_READINGS = (
    Suspect(kind, None, 1e-3, True, (CHAIN, *BY_CHAIN), SOURCES)
    for kind in ("misread_poses", "misread_readings")
)
