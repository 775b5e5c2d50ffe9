"""Recordings of which several readings are possible: the one that robot and camera agree on."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Self

import numpy as np

from visioncal.calibration.guess import (
    CAMERA_OVER_BOARD,
    CLEAR,
    FEWEST_ROWS,
    NO_READING,
    ONE_AXIS,
    SWITCH_OFF,
    Guess,
    are_of_camera,
)
from visioncal.calibration.pipeline.guess_inputs import (
    board_shown,
    chain_poses,
    guess_from_camera_poses,
    may_agree,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import measured_run
from visioncal.core.choices import POSE_FORMS
from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.transforms import invert, log
from visioncal.core.types import MOUNTS, IntArray, Progress, Searched, evenly
from visioncal.interchange.formats.assemble import (
    FileImages,
    assemble,
    lacks_target,
    unknown_target,
    with_observations_only,
)
from visioncal.interchange.formats.foreign import ForeignRecording, Side, rows_of
from visioncal.interchange.formats.pairing import UnpairedError
from visioncal.interchange.formats.rereading import DoubtfulSession, applied_reading

# Advice where the motion determines neither the calibration nor the form of the poses.
_MOVE = (
    "First add 3 or more views in which the flange is tilted by 20 to 40 degrees about different "
    "axes: it takes them for any result, and they show the form, too. Or "
)
# The beginning of the reason where the robot's rotations do not differ, of whatever unit.
_STILL, _SAME = "the robot does not turn: its rotations are the same", 1e-3
# Motions turn by more than this [rad], and agree in angle and path along their axis [rad, m rad].
_TURNING_RAD, _SCREW = 0.05, 0.01
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
            or the poses of one side serve as both's, or are motions.
    """
    unstated = frozenset[str]().union(*foreign.unstated.values())
    _check_motions(foreign)
    is_known = foreign.stream is not None or not (unstated - {"inverse"} or foreign.doubt)
    if is_known or foreign.mount is None:
        return foreign
    foreign = _of_turning(foreign)
    _check_sides(foreign)
    # Other images make no difference where the stored poses of the target are used.
    by_images = foreign.camera is None or foreign.target is not None
    rivals = (each for each in foreign.rivals if by_images or each[1].robot is not foreign.robot)
    readings = [(0, foreign), *rivals]
    other_orders = [(rank, each) for rank, item in readings for each in _reordered(item)]
    why, fault = "too few rows have a pose and what the camera saw", None
    doubt = foreign.doubt
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
            found, reason, closest = _tested(tried, seen, is_last=is_last)
            if found is not None:
                return found
            is_read = tried is readings
            why, doubt = (reason, _with_fields(foreign, closest)) if is_read else (why, doubt)
            if why.startswith(ONE_AXIS):
                # No order of the numbers closes the chain better than others.
                break
    is_clear = bool(searches) and fault is None
    stored = _by_stored_poses(foreign, progress) if is_clear else None
    return stored or _untested(replace(foreign, doubt=doubt), why, fault)


def _by_stored_poses(
    foreign: ForeignRecording, progress: Progress | None
) -> ForeignRecording | None:
    """The reading by poses of the target beside images of another motion; None without any."""
    if foreign.camera is None or foreign.target is None:
        return None
    stored = replace(foreign, images=(), corners=(), target=None, rivals=())
    with suppress(VisioncalError):
        seen = _Seen.of(stored, _TESTED[-1], progress, {})
        found, *_ = _tested([(0, stored)], seen, is_last=True)
        if found is not None:
            note = (
                "The images are left aside: no reading of the robot's poses fits them, but one "
                "fits the stored poses of the target."
            )
            return replace(found, notes=(*found.notes, note))
    return None


def _check_motions(foreign: ForeignRecording) -> None:
    """Raises DataError where robot and camera have motions between two poses, as in A X = X B.

    One transform makes the one of the other: they turn by the same angle, and as far along their
    axes. Of poses only those of two frames that are one do so (Chen 1991).
    """
    if foreign.camera is None or foreign.stream is not None:
        return
    sides = [side.poses() for side in (foreign.robot, foreign.camera)]
    has_both = np.isfinite(sides).all(axis=(0, 2, 3))
    robot, camera = (side[has_both] for side in sides)
    if len(robot) < FEWEST_ROWS:
        return
    vectors = np.array([log(side) for side in (robot, camera)])
    angles = np.linalg.norm(vectors[..., :3], axis=2)
    # A rotation of so little has no axis.
    turning = (angles > _TURNING_RAD).all(axis=0)
    apart = np.ptp(angles, axis=0) + np.ptp(np.sum(vectors[..., :3] * vectors[..., 3:], axis=2), 0)
    are_one = any(np.median(np.abs(robot - each)) < _SAME for each in (camera, invert(camera)))
    if turning.sum() < FEWEST_ROWS or are_one or np.median(apart[turning]) > _SCREW:
        return
    if float(np.ptp(angles[0, turning])) < 10.0 * _SCREW:
        return
    raise DataError(
        f"{foreign.name}: robot and camera turn by the same angle in each of {len(robot)} rows: "
        "these are motions between two poses, as A and B of A X = X B, and must be poses.",
        culprits=[foreign.name],
        next_step="Give the pose of the flange in the base, and of the target in the camera, at "
        "each stop, of which the motions were made.",
    )


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


def _of_turning(foreign: ForeignRecording) -> ForeignRecording:
    """The recording without series in which the robot does not turn, where it does in others."""
    readings = [(0, foreign), *foreign.rivals]
    turning = [(rank, each) for rank, each in readings if not _is_still(each)]
    places = {each.robot.places for _, each in turning}
    least = min((rank for rank, _ in turning), default=np.inf)
    # Of fields of the same rows those that stand still are frames, where others are as likely.
    kept = [
        (rank, each)
        for rank, each in readings
        if not _is_still(each) or (places <= {each.robot.places} and rank < least)
    ]
    (_, first), *others = kept
    same = len(kept) == len(readings)
    doubt = _with_fields(foreign, first)
    return foreign if same else replace(first, rivals=tuple(others), doubt=doubt)


def _tested(
    readings: Sequence[tuple[int, ForeignRecording]], seen: "_Seen", *, is_last: bool
) -> tuple[ForeignRecording | None, str, ForeignRecording | None]:
    """The reading that agrees best with what was seen, or why the first does not; and the closest.

    Raises DataError where several agree alike, are not the same, and no more rows can tell.
    """
    found: list[tuple[float, int, ForeignRecording]] = []
    scores = dict[int, float]()
    why, others, of_camera = "", list[Guess](), list[ForeignRecording]()
    for at, (rank, item) in enumerate(readings):
        try:
            guess = seen.guess(item)
        except VisioncalError as error:
            why = why or error.message.rstrip(".")
            continue
        if seen.run is not None and are_of_camera(guess.best.fit.x, guess.best.fit.z):
            of_camera.append(item)
            continue
        why = why or guess.sentence.rstrip(".")
        scores[at] = score = guess.best.log_posterior - CLEAR * rank
        if guess.stands_out or guess.declared.fit.closes:
            done = applied_reading(item, guess, is_measured=seen.run is not None)
            found += [] if done is None else [(score, rank, done)]
            is_other = guess.stands_out and guess.best.hypothesis.mount != item.mount
            others += [guess] if done is None and is_other else []
    if others and not found:
        raise DataError(
            f"{readings[0][1].name}: the camera is not mounted as stated. {others[0].sentence}",
            culprits=["--mount"],
            next_step=f"Give --mount {others[0].best.hypothesis.mount}.",
        )
    if of_camera and not found:
        raise DataError(
            f"{readings[0][1].name}: {CAMERA_OVER_BOARD}.",
            culprits=[str(of_camera[0].robot.places[0])],
            next_step="Name the poses that the robot reported with --robot-key or --robot-columns, "
            f"or their file; {SWITCH_OFF}.",
        )
    closest = readings[max(scores, key=scores.__getitem__)][1] if scores else None
    if not found:
        return None, why, closest
    score, rank, best = max(found, key=lambda each: each[0])
    alike = (each for at, same, each in found if same == rank and at > score - CLEAR)
    doubt = next((item.doubt for _, item in readings), None)
    if doubt is not None and not all(_are_same(best, each) for each in alike):
        if not is_last:
            return None, why, closest
        raise doubt
    return best, "", best


def _with_fields(foreign: ForeignRecording, closest: ForeignRecording | None) -> DataError | None:
    """The doubt of a recording, with the fields of the reading that agrees best proposed."""
    is_open = foreign.doubt is not None and not isinstance(foreign.doubt, UnpairedError)
    if not is_open or foreign.proposing is None or closest is None or not closest.fields:
        return foreign.doubt
    return foreign.proposing(closest.fields)


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
        usable = [at for at, image in enumerate(seen.images) if image and image.is_file()]
        usable = usable or [at for at, px in enumerate(seen.corners) if px is not None]
        rows = np.array(usable, dtype=int)[evenly(len(usable), most)]
        run = None
        if len(rows) >= FEWEST_ROWS:
            session = assemble(rows_of(replace(seen, rivals=()), rows), mount=MOUNTS[0])
            if isinstance(session.images, FileImages):
                images = replace(session.images, searches=searches)
                session = replace(session, images=images)
            run = measured_run(session, progress)
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
            is_readable = (
                item.robot.present if item.robot.present.any() else np.full(len(item.robot), True)
            )
            is_readable &= (
                np.full(len(is_readable), True) if item.camera is None else item.camera.present
            )
            rows = np.flatnonzero(is_readable)
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


def _untested(
    foreign: ForeignRecording, why: str, fault: VisioncalError | None = None
) -> ForeignRecording:
    """Asks for a form of rotations that nothing determines, or for the board that would.

    `fault` is what kept the images from being used. Else notes that nothing was tested.
    """
    other = board_shown(fault)
    needs_form = foreign.doubt or any("rotation" in free for free in foreign.unstated.values())
    if other is not None:
        raise DataError(
            other.words,
            culprits=["--target"],
            next_step="Name this board with --target, by its kind, its columns x rows and the "
            "measured side (as checkerboard_9x6_25mm, or circles_4x11_20mm_asymmetric of "
            "staggered rows 20 mm apart), or by its .toml.",
        )
    is_armless = foreign.arm is None and foreign.robot_document is None
    is_armless &= foreign.joints_rad is not None and not foreign.robot.present.any()
    if needs_form and is_armless:
        raise DataError(
            f"{foreign.name}: there are joint angles and no poses of the robot, and their arm is "
            "not stated.",
            culprits=["--robot-model"],
            next_step="Name the arm with --robot-model: a built-in robot, its .urdf or a DH table.",
        )
    # Other images make no difference where the stored poses of the target are used.
    is_stored = foreign.camera is not None and foreign.target is None
    if foreign.doubt and not (is_stored and isinstance(foreign.doubt, UnpairedError)):
        raise foreign.doubt
    for side, free in foreign.unstated.items():
        if "rotation" in free:
            raise _unsaid(foreign, side, why, fault)
    if foreign.lens == {"model": "points"}:
        # Places alone test no reading.
        return foreign
    note = f"The form of the poses stays as first read: {why}."
    note += " Convert with --guess --yes to read them so." if why.startswith("With ") else ""
    return replace(foreign, notes=(*foreign.notes, note))


def _unsaid(
    foreign: ForeignRecording, side: Side, why: str, fault: VisioncalError | None
) -> DataError:
    """The error that a form of rotations is not stated, and why images do not determine it."""
    joints = (
        " Where the numbers are joint angles, name them with --joint-columns, and the arm with "
        "--robot-model."
    )
    numbers = foreign.robot if side == "robot" else foreign.camera
    size = 0 if numbers is None else numbers.rotations.shape[1]
    forms = (
        "quaternion-xyzw, or quaternion-wxyz"
        if size == 4
        else "rotation-vector, euler-xyz-rad, euler-ZYX-deg or another, or their maker, as kuka"
    )
    by_names = [name for name in foreign.makers if POSE_FORMS[name].likely]
    if side == "robot" and len(by_names) == 1:
        forms = f"{by_names[0]}, as the columns' names suggest, or {forms}"
    unsaid = f"the form of the {side}'s rotations is not stated"
    # A fault of the images comes first: while it lasts, no form helps.
    words = f"{unsaid}, and nothing determines it: {why}"
    step = f"{_MOVE}say" if why.startswith((ONE_AXIS, _STILL)) else "Say"
    if why.startswith(_STILL):
        words = f"{why}. No calibration is determined so, and no form of these rotations"
    elif why.startswith("With "):
        words, step = f"{unsaid}. {why}", "Convert with --guess --yes to read them so. Else say"
    elif why.startswith(NO_READING):
        step = "Look whether these rows are those of these images or poses of the target. Else give"
        if foreign.images and foreign.target is None:
            board = "Name the board that the images show with --target: its corners determine more."
            step = f"{board} {step}"
    elif fault is not None:
        words = f"{re.sub('^session .*?: ', '', why)}. Beside that, {unsaid}"
        step = f"{fault.next_step} Else give".strip()
    return DataError(
        f"{foreign.name}: {words}.",
        culprits=[*(fault.culprits if fault else ()), f"--{side}-form"],
        next_step=f"{step} --{side}-form {forms}.{joints if side == 'robot' else ''}",
    )
