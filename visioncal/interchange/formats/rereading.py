"""Finds another reading of a recording's poses, and applies it."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Self

import numpy as np

from visioncal.calibration.guess import (
    CLEAR,
    FEWEST_ROWS,
    NO_READING,
    ONE_AXIS,
    Candidate,
    Guess,
    Hypothesis,
)
from visioncal.calibration.pipeline.guess_inputs import (
    chain_poses,
    guess_from_camera_poses,
    may_agree,
    numbers_in,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, run_stages
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.core.choices import POSE_FORMS
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.documents.tables import TextTable, is_number
from visioncal.core.documents.toml import read_toml
from visioncal.core.errors import DataError, DegenerateError, VisioncalError
from visioncal.core.files import read_text_inside
from visioncal.core.number_format import some_of
from visioncal.core.types import MOUNTS, FloatArray, IntArray, Progress, Searched, evenly
from visioncal.interchange.formats.assemble import (
    FileImages,
    assemble,
    lacks_target,
    pose_cells,
    unknown_target,
    with_observations_only,
)
from visioncal.interchange.formats.fields import fields_of_records
from visioncal.interchange.formats.foreign import ForeignRecording, Side, rows_of
from visioncal.interchange.formats.mending import noting, scaled_board
from visioncal.interchange.formats.poses import makers_of, pose_names
from visioncal.session import Session, Stream
from visioncal.session.columns import (
    MEASURED_CAM_POSE,
    POSE,
    joint_columns,
)
from visioncal.session.table import parse_csv
from visioncal.vision.boards.kind import LARGEST_M

_IDENTITY = ("0.0", "0.0", "0.0", "1.0")
# Advice where the motion determines neither the calibration nor the form of the poses.
_MOVE = (
    "First add 3 or more views in which the flange is tilted by 20 to 40 degrees about different "
    "axes: it takes them for any result, and they show the form, too. Or "
)
# The beginning of the reason where the robot's rotations do not differ, of whatever unit.
_STILL, _SAME = "the robot does not turn: its rotations are the same", 1e-3
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
        run = _measured(self.session, progress)
        return guess_from_camera_poses(run, self.robot, self.camera, knows_mount=self.knows_mount)


def _measured(session: Session, progress: Progress | None) -> RunState:
    """The turn of the camera's poses, for any of the robot's; raises as `DoubtfulSession.guess`."""
    # The offset of a stream's clock is found by rotation angles, which no reading changes.
    by_clock = {"robot", "clock"} if waits_for_clock(session) else set()
    names = {"detect", "intrinsics", "pnp"} | by_clock
    return run_stages(RunState(session, progress), [each for each in STAGES if each.name in names])


# Rows by which readings are tested, evenly spread: few first, more where these do not decide. Every
# third of the more is one of the few, whose images are searched once.
_TESTED = (12, 34)


def settled(foreign: ForeignRecording, progress: Progress | None = None) -> ForeignRecording:
    """Finds what a source does not say of its poses by what agrees with its images or target poses.

    All readings of the source are tested, then those with the six numbers of a pose in another
    order.

    Raises:
        DataError: Nothing determines which fields are poses, or a form of rotations that is not
            said; the images show another board than declared, or the camera is mounted otherwise;
            or the poses of one side serve as both's.
    """
    unstated = frozenset[str]().union(*foreign.unstated.values())
    is_known = foreign.stream is not None or not (unstated - {"inverse"} or foreign.doubt)
    if is_known or foreign.mount is None:
        return foreign
    _check_sides(foreign)
    # Other images make no difference where the stored poses of the target are used.
    by_images = foreign.camera is None or foreign.target is not None
    rivals = (each for each in foreign.rivals if by_images or each[1].robot is not foreign.robot)
    readings = [(0, foreign), *rivals]
    other_orders = [(rank, each) for rank, item in readings for each in _reordered(item)]
    why, fault = "too few rows have a pose and what the camera saw", None
    searches = dict[Path, Searched]()
    if _is_still(foreign):
        # No image need be searched for what no reading can change.
        return _untested(foreign, f"{_STILL} in all {len(foreign.robot)} rows")
    for least, most in pairwise((FEWEST_ROWS - 1, *_TESTED)):
        try:
            seen = _Seen.of(foreign, most, progress, searches)
        except VisioncalError as error:
            why, fault = error.message.rstrip("."), error
            # Where a dozen images show nothing, the others of a short recording will not.
            if isinstance(error, DataError) and len(foreign.robot) <= _TESTED[-1]:
                break
            continue
        if seen.count <= least:
            break
        fault = None
        searches |= seen.searches
        # Rows that turn otherwise are another motion's, whatever more rows add.
        readings = [*readings[:1], *filter(seen.may_agree, readings[1:])]
        other_orders = [*filter(seen.may_agree, other_orders)]
        is_last = most == _TESTED[-1] or seen.count < most
        for tried in (readings, other_orders):
            found, reason = _tested(tried, seen, is_last=is_last)
            why = reason if tried is readings else why
            if found is not None:
                return found
            if why.startswith(ONE_AXIS):
                # No order of the numbers closes the chain better than others.
                break
    is_clear = bool(searches) and fault is None
    stored = _by_stored_poses(foreign, progress) if is_clear else None
    return stored or _untested(foreign, why, fault)


def _by_stored_poses(
    foreign: ForeignRecording, progress: Progress | None
) -> ForeignRecording | None:
    """The reading by poses of the target beside images of another motion; None without any."""
    if foreign.camera is None or foreign.target is None:
        return None
    stored = replace(foreign, images=(), corners=(), target=None, rivals=())
    with suppress(DegenerateError):
        found, _ = _tested([(0, stored)], _Seen.of(stored, _TESTED[-1], progress, {}), is_last=True)
        if found is not None:
            note = (
                "The images are left aside: no reading of the robot's poses fits them, but one "
                "fits the stored poses of the target."
            )
            return replace(found, notes=(*found.notes, note))
    return None


def _check_sides(foreign: ForeignRecording) -> None:
    """Raises DataError where nothing says what images show, or one side's numbers are both's."""
    if lacks_target(foreign):
        then = " Forms of poses that are not stated are then found by the images."
        raise unknown_target(foreign, "--target", then)
    if foreign.camera is not None or foreign.corners:
        # Of the same numbers any reading agrees; corners need the size of their images.
        assemble(replace(foreign, images=()))


def _is_still(foreign: ForeignRecording) -> bool:
    """Whether all rows have one rotation of the robot."""
    turns = foreign.robot.rotations[foreign.robot.present]
    return bool(turns.size) and float(np.ptp(turns, axis=0).max()) < _SAME


def _tested(
    readings: Sequence[tuple[int, ForeignRecording]], seen: "_Seen", *, is_last: bool
) -> tuple[ForeignRecording | None, str]:
    """The reading that agrees best with what was seen, or why the first does not.

    Raises DataError where several agree alike, are not the same, and no more rows can tell.
    """
    found: list[tuple[float, int, ForeignRecording]] = []
    why, others = "", list[Guess]()
    for rank, item in readings:
        try:
            guess = seen.guess(item)
        except VisioncalError as error:
            why = why or error.message.rstrip(".")
            continue
        why = why or guess.sentence.rstrip(".")
        if guess.stands_out or guess.declared.fit.closes:
            done = _applied(item, guess, is_measured=seen.run is not None)
            score = guess.best.log_posterior - CLEAR * rank
            found += [] if done is None else [(score, rank, done)]
            is_other = guess.stands_out and guess.best.hypothesis.mount != item.mount
            others += [guess] if done is None and is_other else []
    if others and not found:
        raise DataError(
            f"{readings[0][1].name}: the camera is not mounted as stated. {others[0].sentence}",
            culprits=["--mount"],
            next_step=f"Say --mount {others[0].best.hypothesis.mount}.",
        )
    if not found:
        return None, why
    score, rank, best = max(found, key=lambda each: each[0])
    alike = (each for at, same, each in found if same == rank and at > score - CLEAR)
    doubt = next((item.doubt for _, item in readings), None)
    if doubt is not None and not all(_are_same(best, each) for each in alike):
        if not is_last:
            return None, why
        raise doubt
    return best, ""


def _are_same(first: ForeignRecording, second: ForeignRecording) -> bool:
    """Whether two readings have the same poses, but for what is written with fewer digits."""
    if first.images != second.images:
        return False
    if len(first.robot) != len(second.robot):
        return True
    away = np.abs(first.robot.poses() - second.robot.poses())
    return bool(np.nanmax(away, initial=0.0) < 1e-3)


def _reordered(foreign: ForeignRecording) -> Iterator[ForeignRecording]:
    """The recording with the six numbers of the robot's poses in other orders.

    Either half is the position; with all forms of Euler angles, the orders of three angles with
    another one in the middle are all products of three turns.
    """
    if "angles" not in foreign.unstated.get("robot", frozenset()):
        return
    flat = np.hstack([foreign.robot.positions, foreign.robot.rotations])
    for first, turn in product((0, 3), ((0, 1, 2), (1, 0, 2), (0, 2, 1))):
        order = [*range(first, first + 3), *(3 - first + at for at in turn)]
        robot = replace(foreign.robot, positions=flat[:, order[:3]], rotations=flat[:, order[3:]])
        if order != [*range(6)]:
            words = ", ".join(str(1 + at) for at in order)
            note = f"The numbers of the robot's poses are taken in the order {words}."
            yield replace(foreign, robot=robot, notes=(*foreign.notes, note))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Corners in some rows of a source, by which its readings are tested."""

    run: RunState | None  # With the board's poses by the images; None for poses of the target.
    rows: IntArray  # These rows of the recording.
    images: tuple[Path | None, ...]  # Their images; empty where corners were given.
    count: int  # The number of rows.
    progress: Progress | None

    @classmethod
    def of(
        cls,
        foreign: ForeignRecording,
        most: int,
        progress: Progress | None,
        searches: Mapping[Path, Searched],
    ) -> Self:
        """The corners in at most so many rows; raises VisioncalError.

        `searches` has what was found in images before.
        """
        seen = with_observations_only(foreign)
        if not (seen.images or seen.corners):
            return cls(None, np.arange(0), (), min(len(seen.robot), most), progress)
        there = [at for at, image in enumerate(seen.images) if image and image.is_file()]
        there = there or [at for at, px in enumerate(seen.corners) if px is not None]
        rows = np.array(there, dtype=int)[evenly(len(there), most)]
        run = None
        if len(rows) >= FEWEST_ROWS:
            session = assemble(rows_of(replace(seen, rivals=()), rows), mount=MOUNTS[0])
            if isinstance(session.images, FileImages):
                images = replace(session.images, searches=searches)
                session = replace(session, images=images)
            run = _measured(session, progress)
        shown = tuple(seen.images[at] for at in rows) if seen.images else ()
        return cls(run, rows, shown, len(rows), progress)

    @property
    def searches(self) -> dict[Path, Searched]:
        """The corners found in the images, by file."""
        if self.run is None or not isinstance(images := self.run.session.images, FileImages):
            return {}
        views, found = self.run.session.views, self.run.searches
        return {
            images.files[view.image]: found[view.number] for view in views if view.number in found
        }

    def may_agree(self, reading: tuple[int, ForeignRecording]) -> bool:
        """Whether the robot's rows of a reading, with its rank, may turn as the boards do."""
        try:
            item = with_observations_only(replace(reading[1], rivals=()))
            return self.run is None or may_agree(self.run, self._robot(item))
        except VisioncalError:
            # Its test says why.
            return True

    def guess(self, foreign: ForeignRecording) -> Guess:
        """Tries the readings of one recording's poses; raises VisioncalError."""
        item = with_observations_only(replace(foreign, rivals=()))
        if self.run is None:
            here = (
                item.robot.present if item.robot.present.any() else np.full(len(item.robot), True)
            )
            here &= np.full(len(here), True) if item.camera is None else item.camera.present
            rows = np.flatnonzero(here)
            rows = rows[evenly(len(rows), self.count)]
            return DoubtfulSession.of(rows_of(item, rows)).guess(self.progress)
        knows_mount = foreign.mount is not None
        return guess_from_camera_poses(self.run, self._robot(item), knows_mount=knows_mount)

    def _robot(self, foreign: ForeignRecording) -> PoseNumbers:
        """The robot's numbers of what was seen; NaN where a recording has none."""
        row = {image: at for at, image in enumerate(foreign.images)}
        rows = np.array([row.get(image, -1) for image in self.images] or self.rows)
        robot = foreign.robot
        if not robot.present.any():
            chain = chain_poses(assemble(foreign))
            robot = robot if chain is None else PoseNumbers.of_poses(chain, robot.places)
        robot = robot.rows(np.maximum(rows, 0))
        robot.positions[rows < 0] = np.nan
        return robot


def _applied(
    foreign: ForeignRecording, guess: Guess, *, is_measured: bool
) -> ForeignRecording | None:
    """The recording as its best reading has it; None where that changes what is stated."""
    best, declared = guess.best.hypothesis, guess.declared.hypothesis
    numbers = {"robot": foreign.robot, "camera": foreign.camera}
    fits = (best.mount, best.order) == (declared.mount, declared.order)
    for whose in ("robot", "camera"):
        found, stated = getattr(best, whose), getattr(declared, whose)
        # Images are the same whatever the size of their board, of which calibrating tells.
        if found == stated or (is_measured and replace(found, scale=1.0) == stated):
            continue
        free = foreign.unstated.get(whose, frozenset())
        changed = {
            name for name in ("unit", "inverse") if getattr(found, name) != getattr(stated, name)
        }
        changed |= {"rotation"} if found.rotation != stated.rotation else set()
        may = free | ({"rotation"} if "angles" in free else set())
        # Nine numbers do not show whether they are by rows.
        by_columns = found.transposed and found.rotation == "matrix" and "inverse" in free
        fits &= (found.reading is not None or by_columns) and not found.mirrored and changed <= may
        old = numbers[whose]
        numbers[whose] = None if old is None or not fits else found.corrected(old)
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
    own = named[0].name if len(named) == 1 and named[0].name in makers else ""
    if own:
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
        form=own or foreign.form,
        notes=(*kept, *notes),
        unstated={},
        rivals=(),
    )


def _untested(
    foreign: ForeignRecording, why: str, fault: VisioncalError | None = None
) -> ForeignRecording:
    """Asks for a form of rotations that nothing determines, or for the board that would.

    `fault` is what kept the images from being used. Else notes that nothing was tested.
    """
    other = fault.finding if isinstance(fault, OtherBoardError) else None
    is_asked = foreign.doubt or any("rotation" in free for free in foreign.unstated.values())
    if is_asked and other is not None and other.kind == "other_board":
        raise DataError(
            other.words,
            culprits=["--target"],
            next_step="Name this board with --target, by its kind, its columns x rows and the "
            "measured side (as checkerboard_9x6_25mm), or by its .toml.",
        )
    if foreign.doubt is not None:
        raise foreign.doubt
    is_armless = foreign.arm is None and foreign.robot_document is None
    is_armless &= foreign.joints_rad is not None and not foreign.robot.present.any()
    if is_asked and is_armless:
        raise DataError(
            f"{foreign.name}: there are joint angles and no poses of the robot, and which arm they "
            "belong to is not said.",
            culprits=["--robot-model"],
            next_step="Name the arm with --robot-model: a built-in robot, its .urdf or a DH table.",
        )
    for whose, free in foreign.unstated.items():
        if "rotation" in free:
            raise _unsaid(foreign, whose, why, fault)
    note = f"The form of the poses stays as first read: {why}."
    note += " Convert with --guess --yes to read them so." if why.startswith("With ") else ""
    return replace(foreign, notes=(*foreign.notes, note))


def _unsaid(
    foreign: ForeignRecording, whose: Side, why: str, fault: VisioncalError | None
) -> DataError:
    """The error of a form of rotations that is not said, and what kept the images from telling."""
    joints = (
        " Where the numbers are joint angles, name them with --joint-columns, and the arm with "
        "--robot-model."
    )
    numbers = foreign.robot if whose == "robot" else foreign.camera
    size = 0 if numbers is None else numbers.rotations.shape[1]
    forms = (
        "quaternion-xyzw, or quaternion-wxyz"
        if size == 4
        else "rotation-vector, euler-xyz-rad, euler-ZYX-deg or another, or whose they are, as kuka"
    )
    by_names = [name for name in foreign.makers if POSE_FORMS[name].likely]
    if whose == "robot" and len(by_names) == 1:
        forms = f"{by_names[0]}, as the columns' names suggest, or {forms}"
    if why.startswith("With "):
        joints += (
            " What else this reading changes is done to the session that is then written: "
            "visioncal convert SESSION NEW --guess --yes."
        )
    unsaid = f"the form of the {whose}'s rotations is not said"
    # A fault of the images comes first: while it lasts, no form helps.
    words = f"{unsaid}, and nothing determines it: {why}"
    step = f"{_MOVE}say" if why.startswith((ONE_AXIS, _STILL)) else "Say"
    if why.startswith(_STILL):
        words = f"{why}. No calibration is determined so, and no form of these rotations"
    elif why.startswith(NO_READING):
        step = "Look whether these rows are those of these images or poses of the target. Else say"
        if foreign.images and foreign.target is None:
            board = "Name the board that the images show with --target: its corners determine more."
            step = f"{board} {step}"
    elif fault is not None:
        words = f"{re.sub('^session .*?: ', '', why)}. Beside that, {unsaid}"
        step = f"{fault.next_step} Else say".strip()
    return DataError(
        f"{foreign.name}: {words}.",
        culprits=[*(fault.culprits if fault else ()), f"--{whose}-form"],
        next_step=f"{step} --{whose}-form {forms}.{joints if whose == 'robot' else ''}",
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
    if candidate.hypothesis.robot.mirrored and not mirrors_poses:
        raise DataError(
            "Nothing was written: mirrored images are the usual cause, and then the robot's poses "
            "are right.",
            culprits=[candidate.words],
            next_step="Turn the images back, and find their corners anew; only where the robot's "
            "frame is left-handed, mirror its poses with --mirror-poses.",
        )
    if candidate.hypothesis.robot.has_lost_turns:
        raise DataError(
            "Nothing was written: angles in degrees that were taken for radians lost whole turns, "
            "and those about the last axis of the tool cannot be found again.",
            culprits=[candidate.words],
            next_step="Convert the robot's own log, or make the poses anew from angles in radians.",
        )
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


def _robot_table(doubtful: DoubtfulSession, candidate: Candidate) -> dict[str, Any]:
    """`[robot]` with the maker by the columns' names, without one whose rotations are others."""
    stated = doubtful.session.document.get("robot")
    table = stated or {}
    found, declared = candidate.hypothesis.robot, candidate.recording.declared.robot
    if (found.rotation, found.written) != (declared.rotation, declared.written):
        table = {key: value for key, value in table.items() if key != "form"}
    own = [name for name in doubtful.makers if POSE_FORMS[name].rotation == found.rotation]
    if own:
        table = {**table, "form": own[0]}
    return {"robot": table} if own or stated is not None else {}


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
