"""Finds another reading of a recording's poses, and applies it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from visioncal.calibration.guess import (
    Candidate,
    Guess,
    Hypothesis,
)
from visioncal.calibration.pipeline.guess_inputs import (
    chain_poses,
    guess_from_camera_poses,
    numbers_in,
    of_pair,
    open_pairs,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import measured_run
from visioncal.core.choices import POSE_FORMS
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.documents.tables import TextTable, is_number
from visioncal.core.documents.toml import read_toml
from visioncal.core.errors import DataError
from visioncal.core.files import read_text_inside
from visioncal.core.number_format import robot_words, some_of
from visioncal.core.types import MOUNTS, FloatArray, Progress
from visioncal.interchange.formats.assemble import (
    assemble,
    pose_cells,
    with_observations_only,
)
from visioncal.interchange.formats.fields import fields_of_records
from visioncal.interchange.formats.foreign import ForeignRecording
from visioncal.interchange.formats.mending import noting, scaled_board
from visioncal.interchange.formats.pose_forms import makers_of
from visioncal.interchange.formats.poses import pose_names
from visioncal.session import Session, Stream
from visioncal.session.columns import (
    MEASURED_CAM_POSE,
    POSE,
    joint_columns,
)
from visioncal.session.kinds import has_robot_state, name_of
from visioncal.session.table import parse_csv
from visioncal.vision.boards.kind import LARGEST_M

_IDENTITY = ("0.0", "0.0", "0.0", "1.0")
# Sigma of a board's size, as a share of it, that the distances of some poses gave: nobody measured
# it, and the fit finds it better.
_BY_POSES = 0.01


@dataclass(frozen=True, eq=False)
class DoubtfulSession:
    """A session whose poses may be in another convention."""

    # The session, with identity rotations where its own are in an unsupported form.
    session: Session
    # The robot's poses as they are written; None for those of the session.
    robot: PoseNumbers | None = None
    # The measured poses of the target as they are written; None for those of the session.
    camera: PoseNumbers | None = None
    knows_mount: bool = True  # Whether the mount is stated; else both are tried.
    makers: tuple[str, ...] = ()  # Forms of poses that the names of their columns are of.

    @classmethod
    def of(cls, foreign: ForeignRecording) -> Self:
        """The session of a foreign recording, and its poses as they are written.

        Raises:
            DataError: No row has an observation, or a number is wrong.
        """
        foreign = with_observations_only(foreign)
        robot = foreign.robot if foreign.robot.present.any() else None
        session = assemble(foreign, mount=MOUNTS[0])
        return cls(session, robot, foreign.camera, foreign.mount is not None)

    def guess(self, progress: Progress | None = None) -> Guess:
        """Tries every plausible reading of its poses, and both mounts where it is not known.

        Raises:
            DataError: There are no poses, no view shows the target, or nothing determines the
                mount.
            DegenerateError: Too few views have both poses.
            ConvergenceError: The intrinsics do not converge.
        """
        run = measured_run(self.session, progress)
        return guess_from_camera_poses(run, self.robot, self.camera, knows_mount=self.knows_mount)


@dataclass(frozen=True, eq=False)
class DoubtfulRobot:
    """A robot of a whole cell whose poses may be in another convention."""

    robot: str
    run: RunState  # Run of the robot with one camera and one target alone.
    views: frozenset[int]  # Those whose poses may be.
    numbers: PoseNumbers | None  # The robot's poses as they are written; None for the session's.

    def guess(self, progress: Progress | None = None) -> Guess:
        """Tries every plausible reading of its poses; raises as `DoubtfulSession.guess`."""
        del progress
        return guess_from_camera_poses(self.run, self.numbers)


def applied_reading(
    foreign: ForeignRecording, guess: Guess, *, is_measured: bool
) -> ForeignRecording | None:
    """The recording as its best reading has it; None where that changes what is stated."""
    best, declared = guess.best.hypothesis, guess.declared.hypothesis
    numbers = {"robot": foreign.robot, "camera": foreign.camera}
    fits = (best.mount, best.order) == (declared.mount, declared.order)
    for side in ("robot", "camera"):
        found, stated = getattr(best, side), getattr(declared, side)
        # Images are the same whatever the size of their board, of which calibrating tells.
        if found == stated or (is_measured and replace(found, scale=1.0) == stated):
            continue
        free = foreign.unstated.get(side, frozenset())
        changed = {
            name for name in ("unit", "inverse") if getattr(found, name) != getattr(stated, name)
        }
        changed |= {"rotation"} if found.rotation != stated.rotation else set()
        may = free | ({"rotation"} if "angles" in free else set())
        # Nine numbers do not show whether they are by rows.
        by_columns = found.transposed and found.rotation == "matrix" and "inverse" in free
        fits &= (found.reading is not None or by_columns) and not found.mirrored and changed <= may
        old = numbers[side]
        numbers[side] = None if old is None or not fits else found.corrected(old)
    if not fits:
        return None
    # One unit of both sides scales the cell, which poses alone do not show.
    is_open = not is_measured and all("unit" in each for each in foreign.unstated.values())
    kept = (
        note
        for note in foreign.notes
        if not (note.startswith("The ") and " taken for " in note)
        or (is_open and "positions" in note)
    )
    means = ("images" if foreign.images else "corners") if is_measured else "poses"
    notes = [f"Found by the {means}: {guess.sentence}"]
    if is_measured and best.camera.scale != declared.camera.scale:
        notes.append(
            "The session keeps the board's stated size: measure the board, and correct target.toml "
            "(`visioncal convert SESSION NEW --guess` writes the size that was found)."
        )
    forms = [form for form in POSE_FORMS.values() if form.rotation == best.robot.rotation]
    makers = [form.name for form in forms if form.models and not foreign.form]
    # Columns A, B, C of turns about Z, Y, X are a KUKA's; roll, pitch, yaw may be any program's.
    named = [form for form in forms if form.name in foreign.makers]
    form_name = named[0].name if len(named) == 1 and named[0].name in makers else ""
    if form_name:
        by = "By the names of the columns, poses are written as"
        notes.append(f"{by} {named[0].words}; --robot-form says another form.")
    elif makers:
        # Exports, targets and picks by poses are in the robot's own form, once that is known.
        notes.append(f"Robots that write so: {some_of(makers)}; --robot-form says which it is.")
    notes += guess.notes
    return replace(
        foreign,
        robot=numbers["robot"] or foreign.robot,
        camera=numbers["camera"],
        form=form_name or foreign.form,
        notes=(*kept, *notes),
        unstated={},
        rivals=(),
    )


def load_for_rereading(path: Path) -> DoubtfulSession:
    """Loads a session for rereading, even where its poses or its board's size are invalid.

    A board too large for metres is read in millimetres; positions and rotations may be in columns
    or forms that sessions do not have. Raises DataError.
    """
    plain, robot, makers = _other_columns(path) or (None, None, ())
    file = path / "session.toml"
    name = str(read_toml(file, file.name).get("target")) if file.is_file() else ""
    stated = read_toml(path / name, name) if name.endswith(".toml") else {}
    sides = (stated.get(key) for key in ("square_m", "size_m"))
    side = next((side for side in sides if isinstance(side, int | float)), 0.0)
    if not LARGEST_M < side < 1e3 * LARGEST_M:
        return DoubtfulSession(Session.load(path, table=plain), robot, makers=makers)
    session = Session.load(path, target_document=scaled_board(stated, 1e-3), table=plain)
    note = f"{name} cannot be in metres: {side:g} is read as {side:g} mm."
    session = replace(session, warnings=(note, *session.warnings))
    return DoubtfulSession(session, robot, makers=makers)


def _other_columns(folder: Path) -> tuple[TextTable, PoseNumbers, tuple[str, ...]] | None:
    """Reads poses of other columns or forms, with the makers who name columns so; None if none."""
    if not (folder / "views.csv").is_file():
        return None
    table = parse_csv(read_text_inside(folder, "views.csv"), "views.csv")
    cells = [dict(zip(table.columns, row, strict=False)) for row in table.rows]
    places = tuple(map(table.place, range(len(cells))))
    if not any(row.get(POSE[-1]) for row in cells):
        # Three numbers of a rotation may stand in the columns of a quaternion.
        cells = [row | {POSE[-1]: "0"} if row.get(POSE[0]) else row for row in cells]
    texts = ({k: text for k, text in row.items() if is_number(text)} for row in cells)
    fields = fields_of_records([*texts], places, "views.csv", folder)
    names = pose_names(fields, (), "robot", (), by_shape=False)
    if len(names) not in (6, 7):
        return None
    values = np.hstack([fields.column(name) for name in names])
    positions, rotations = values[:, :3], values[:, 3:]
    if names == POSE and np.nan_to_num(rotations[:, 3]).any():
        return None
    form = "quaternion-xyzw"
    if not np.nan_to_num(rotations[:, 3:]).any():
        rotations = rotations[:, :3]
        largest = float(np.nanmax(np.abs(rotations), initial=0.0))
        # Larger numbers than a whole turn in radians are degrees.
        form = "euler-xyz-deg" if largest > 7.0 else "rotation-vector"
    kept = [name for name in table.columns if name not in names]
    plain = []
    for row, position in zip(cells, positions, strict=True):
        has_position = np.isfinite(position).all()
        pose = [*map(repr, position.tolist()), *_IDENTITY] if has_position else [""] * len(POSE)
        plain.append((*(row.get(name, "") for name in kept), *pose))
    robot = PoseNumbers(positions, rotations, Reading(form), places)
    return replace(table, columns=(*kept, *POSE), rows=tuple(plain)), robot, makers_of(names)


def reread(
    doubtful: DoubtfulSession, candidate: Candidate, *, mirrors_poses: bool = False
) -> Session:
    """Applies a candidate reading to a session's poses; everything else stays the same.

    The session notes the changes in `corrected`. Raises DataError.
    """
    session = doubtful.session
    changes: tuple[str, ...] = ()
    _refuse_mirrored(candidate, mirrors_poses=mirrors_poses)
    _refuse_lost(candidate)
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    camera = doubtful.camera or numbers_in(session, MEASURED_CAM_POSE)
    robot = doubtful.robot or numbers_in(session, POSE)
    reading = candidate.hypothesis
    streamed = any(name in stream for stream in session.streams.values() for name in POSE)
    recorded = streamed or robot.present.any()
    if not recorded and candidate.hypothesis.robot != candidate.recording.declared.robot:
        raise DataError(
            f"The chain closes with {candidate.words}, but the robot is known by its joint angles "
            "alone, of which that cannot be said.",
            culprits=[candidate.words],
            next_step="Check the robot's model, its tip, and the camera's poses.",
        )
    if _is_one_log(chain_poses(session), robot):
        names = joint_columns(session.columns)
        order = reading.rows(len(cells))
        joints = [{name: cells[at][name] if at >= 0 else "" for name in names} for at in order]
        _replace_cells(cells, joints, names)
    if robot.present.any():
        _replace_cells(cells, pose_cells(reading.robot_numbers(robot), POSE), POSE)
    if camera.present.any():
        corrected = pose_cells(reading.camera.corrected(camera), MEASURED_CAM_POSE)
        _replace_cells(cells, corrected, MEASURED_CAM_POSE)
    if candidate.hypothesis.changes:
        changes += (f"The poses are read otherwise than at first: {candidate.words}.",)
    document, target = {**session.document, "mount": reading.mount}, session.target_document
    if target is not None and candidate.board_scale != 1.0 and not session.targets:
        target = _rescaled(target, candidate)
        document["target"] = "target.toml"
    if candidate.hypothesis.camera.scale != 1.0 and not candidate.recording.is_measured:
        # Of the target's size nothing is known but what these poses gave.
        document["camera"] = {**session.document.get("camera", {}), "scale_sigma": _BY_POSES}
    document |= _robot_table(doubtful, candidate)
    streams = {name: _reread_stream(stream, reading) for name, stream in session.streams.items()}
    reread = session.with_content(
        document=noting(session, document, changes),
        cells=[[row[name] for name in session.columns] for row in cells],
        target_document=target,
    ).with_streams(streams)
    # Assumptions that the reading replaces.
    kept = (note for note in session.warnings if not changes or " taken for " not in note)
    mount = () if doubtful.knows_mount else (f"The mount is taken for {reading.mount}.",)
    notes = dict.fromkeys((*changes, *mount, *kept, *reread.warnings))
    return replace(reread, warnings=tuple(notes))


def doubtful_robots(
    doubtful: DoubtfulSession, progress: Progress | None = None
) -> Iterator[DoubtfulRobot]:
    """The robots of a whole cell whose chains do not close; raises as `DoubtfulSession.guess`.

    Each is tested with the camera and the target of most of its views.
    """
    session = doubtful.session
    run = measured_run(session, progress)
    places = {view.number: at for at, view in enumerate(session.views)}
    for robot in session.robots:
        # A robot's pose may stand in another row of the stop.
        of_views = {
            one.view.number: one.robots[robot]
            for one in session.observations
            if robot in one.robots
        }
        poses = {view: row.base_from_flange() for view, row in of_views.items()}
        known = {view: pose.as_matrix() for view, pose in poses.items() if pose is not None}
        wrong, right = open_pairs(run, robot, known)
        if not wrong:
            continue
        sound = {of_views[view].number for pair in right for view in pair.poses if view in of_views}
        of_robot = (
            view.number
            for view in session.views
            if name_of(session.declaration, "robot", view) == robot and has_robot_state(view)
        )
        part, numbers = of_pair(run, robot, wrong[0]), doubtful.robot
        if numbers is not None:
            rows = (of_views.get(view.number, view).number for view in part.session.views)
            numbers = numbers.rows(np.array([places[row] for row in rows]))
        yield DoubtfulRobot(robot, part, frozenset(of_robot) - sound, numbers)


def reread_robot(
    doubtful: DoubtfulSession,
    of_robot: DoubtfulRobot,
    candidate: Candidate,
    *,
    mirrors_poses: bool = False,
) -> DoubtfulSession:
    """Applies a reading to the poses of one robot of a whole cell; noted in `corrected`.

    Raises:
        DataError: The reading changes more than this robot's poses.
    """
    session, robot = doubtful.session, of_robot.robot
    label = robot_words(robot)
    _refuse_lost(candidate)
    _refuse_mirrored(candidate, mirrors_poses=mirrors_poses)
    if not candidate.is_of_robot:
        raise DataError(
            f"The chain of {label} closes with {candidate.words}, which changes more than the "
            "poses of this robot: nothing was written.",
            culprits=[candidate.words],
            next_step="Of several robots or cameras, correct the files by hand.",
        )
    numbers = doubtful.robot or numbers_in(session, POSE)
    rows = [at for at, view in enumerate(session.views) if view.number in of_robot.views]
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    corrected = candidate.hypothesis.robot.corrected(numbers.rows(np.array(rows)))
    _replace_cells([cells[at] for at in rows], pose_cells(corrected, POSE), POSE)
    document, words = {**session.document}, candidate.words
    table = _robot_table(doubtful, candidate, robot).get("robot")
    if table and robot:
        document["robots"] = {**document["robots"], robot: table}
    elif table:
        document["robot"] = table
    # Another form of the same numbers, which the columns show, is no change.
    is_other = bool(candidate.hypothesis.changes)
    changes = (f"Poses of {label} are read otherwise than at first: {words}.",) * is_other
    changed = session.with_content(
        document=noting(session, document, changes),
        cells=[[row[name] for name in session.columns] for row in cells],
    )
    read = replace(changed, warnings=tuple(dict.fromkeys((*changes, *session.warnings))))
    return replace(doubtful, session=read)


def _refuse_mirrored(candidate: Candidate, *, mirrors_poses: bool) -> None:
    """Refuses a reading that mirrors the poses, unless that is asked for; raises DataError."""
    if candidate.hypothesis.robot.mirrored and not mirrors_poses:
        raise DataError(
            "Nothing was written: mirrored images are the usual cause, and then the robot's poses "
            "are right.",
            culprits=[candidate.words],
            next_step="Turn the images back, and find their corners anew; only where the robot's "
            "frame is left-handed, mirror its poses with --mirror-poses.",
        )


def _refuse_lost(candidate: Candidate) -> None:
    """Refuses a reading whose rotations cannot be had back; raises DataError."""
    if candidate.hypothesis.robot.has_lost_turns:
        raise DataError(
            "Nothing was written: angles in degrees that were taken for radians lost whole turns, "
            "and those about the last axis of the tool cannot be found again.",
            culprits=[candidate.words],
            next_step="Convert the robot's own log, or make the poses anew from angles in radians.",
        )


def _robot_table(
    doubtful: DoubtfulSession, candidate: Candidate, robot: str = ""
) -> dict[str, Any]:
    """`[robot]` with the maker by the columns' names, without one whose rotations are others."""
    document = doubtful.session.document
    stated = document.get("robots", {}).get(robot) if robot else document.get("robot")
    table = stated or {}
    found, declared = candidate.hypothesis.robot, candidate.recording.declared.robot
    if (found.rotation, found.written) != (declared.rotation, declared.written):
        table = {key: value for key, value in table.items() if key != "form"}
    makers = [name for name in doubtful.makers if POSE_FORMS[name].rotation == found.rotation]
    if makers:
        table = {**table, "form": makers[0]}
    return {"robot": table} if makers or stated is not None else {}


def _reread_stream(stream: Stream, reading: Hypothesis) -> Stream:
    """Applies a reading to the poses of a stream."""
    if any(name not in stream for name in POSE):
        return stream
    numbers = np.stack([stream[name] for name in POSE], axis=1)
    places = tuple(f"sample {row + 1}" for row in range(len(stream)))
    poses = PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places)
    values = stream.values.copy()
    columns = [stream.columns.index(name) for name in POSE]
    rows = pose_cells(reading.robot.corrected(poses), POSE)
    values[:, columns] = [[float(row.get(name, "nan")) for name in POSE] for row in rows]
    values.setflags(write=False)
    return replace(stream, values=values)


def _is_one_log(chain: FloatArray | None, robot: PoseNumbers) -> bool:
    """Whether joint angles and poses of a row belong together, and are reordered together."""
    # Without a robot model this cannot be checked, and one log is more likely.
    if chain is None or not robot.present.any():
        return True
    # Other units or frames change all rows alike, so the steps between rows are compared.
    steps = [
        np.linalg.norm(np.diff(positions, axis=0), axis=1)
        for positions in (chain[:, :3, 3], robot.positions)
    ]
    finite = np.isfinite(steps).all(axis=0)
    if finite.sum() < 4:
        return True
    # Joints and poses are of one log where their steps correlate.
    return bool(np.corrcoef(steps[0][finite], steps[1][finite])[0, 1] > 0.9)


def _replace_cells(
    rows: Sequence[dict[str, str]], cells: Sequence[Mapping[str, str]], names: Sequence[str]
) -> None:
    for row, new_cells in zip(rows, cells, strict=True):
        row.update({name: new_cells.get(name, "") for name in names})


def _rescaled(target: Mapping[str, Any], candidate: Candidate) -> Mapping[str, Any]:
    """The board in another unit, or of another size, which then is no better known than so."""
    scaled = scaled_board(target, candidate.board_scale)
    size = scaled.get("square_m", scaled.get("size_m"))
    if candidate.hypothesis.camera.scale == 1.0 or not isinstance(size, float):
        return scaled
    return {**scaled, "square_sigma_m": _BY_POSES * size}
