"""Other readings of a recording's poses: which is right, and the recording read that way."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.calibration.guess import Candidate, Guess, guess_reading
from visioncal.calibration.guess.hypothesis import MIRROR_WORDS, Hypothesis
from visioncal.calibration.pipeline.guess_inputs import (
    chain_poses,
    guess_session,
    numbers_in,
    reported_or_chained,
    seen_poses,
)
from visioncal.calibration.pipeline.reading_hints import session_is_mirrored
from visioncal.core.conventions import UNITS_M, PoseNumbers, Reading
from visioncal.core.documents.tables import is_number
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.files import read_text_inside, read_toml
from visioncal.core.types import MOUNTS, FloatArray, IntArray, Progress
from visioncal.interchange.formats.assemble import assemble, pose_cells, spoken
from visioncal.interchange.formats.foreign import Foreign
from visioncal.session import Session, Stream
from visioncal.session.columns import (
    MEASURED_CAM_POSE,
    POSE,
    POSITION,
    QUATERNION,
    ROTATIONS,
    joint_columns,
    position_columns,
)
from visioncal.session.corners import CornerTable
from visioncal.session.table import TextRow, parse_csv
from visioncal.vision.targets import LARGEST_M

# Distances between consecutive rows of one log go up and down together.
_FEWEST_STEPS, _SAME_LOG = 4, 0.9
# No printed square is larger.
_LARGEST_MM = 1e3 * LARGEST_M
# Rotations with larger numbers are in degrees [rad].
_LARGEST_RAD = 7.0
_NO_TURN = ("0.0", "0.0", "0.0", "1.0")
# In which a board's size is written that is too large for metres; the likeliest first.
_BOARD_UNITS = ("mm", "cm", "inch")
_LENGTHS = ("square_m", "square_sigma_m", "marker_m", "size_m")


def guess_foreign(foreign: Foreign, *, progress: Progress | None = None) -> Guess:
    """Tries every plausible reading of somebody else's poses, and both mounts where none is known.

    Raises:
        DataError: There is nothing to read, the target is in no view, or nothing shows the mount.
        DegenerateError: Too few views have both poses.
        ConvergenceError: The intrinsics do not come to rest.
    """
    foreign = spoken(foreign)
    # The mount has no part in what is taken from the session here.
    session = assemble(foreign, mount=MOUNTS[0])
    chain = chain_poses(session)
    camera = foreign.camera
    if camera is None:
        camera = seen_poses(session, progress=progress)
    return guess_reading(
        reported_or_chained(foreign.robot, chain),
        camera,
        foreign.mount,
        chain=chain,
        is_measured=foreign.camera is None,
    )


def reread(foreign: Foreign, candidate: Candidate, *, mirrors_poses: bool = False) -> Foreign:
    """Reads a recording as a candidate has it: poses, pairing, mount and the size of the board.

    Args:
        foreign: The recording.
        candidate: How its poses are meant.
        mirrors_poses: Whether the robot's poses may be mirrored.

    Raises:
        DataError: It reads the robot's poses otherwise, and there are joint angles in their place;
            or it mirrors them, unasked.
    """
    if _mirrors(candidate) and not mirrors_poses:
        raise _not_mirrored(candidate)
    foreign, notes, taken = spoken(foreign), _note(candidate), candidate.hypothesis
    if foreign.mount is None:
        notes = (*notes, f"The mount is taken for {taken.mount}.")
    robot, camera, joints = foreign.robot, foreign.camera, foreign.joints_rad
    _check_applies(candidate, robot)
    if joints is not None:
        chain = chain_poses(assemble(foreign, mount=taken.mount))
        if _go_together(chain, robot):
            order = taken.rows(len(joints))
            joints = np.where((order >= 0)[:, None], joints[order], np.nan)
    target, sweep = foreign.target, foreign.sweep
    if sweep is not None:
        corrected = taken.robot.corrected(sweep.robot), taken.camera.corrected(sweep.camera)
        sweep = replace(sweep, robot=corrected[0], camera=corrected[1])
    return replace(
        foreign,
        sweep=sweep,
        robot=taken.robot_numbers(robot) if robot.there.any() else robot,
        camera=None if camera is None else taken.camera_numbers(camera),
        joints_rad=joints,
        mount=taken.mount,
        target=None if target is None else _scaled(target, candidate.board_scale),
        notes=(*(note for note in foreign.notes if not _is_overruled(note, candidate)), *notes),
    )


def _is_overruled(note: str, candidate: Candidate) -> bool:
    """Whether a note says what was assumed of something that is now read otherwise."""
    if " taken for " not in note:
        return False
    start = note.replace("quaternions", "rotations").lower()
    return any(
        start.startswith(" ".join(difference.split()[:3])) for difference in candidate.differences
    )


@dataclass(frozen=True, eq=False)
class InDoubt:
    """A session that is to be read anew.

    Attributes:
        session: It, with any rotations where its own are of no form that sessions have.
        robot: The numbers of its robot's poses as they are written; None for those that it has.
    """

    session: Session
    robot: PoseNumbers | None = None


def load_in_doubt(path: Path) -> InDoubt:
    """Loads a session that is to be read anew, even where it cannot be read as it stands.

    A board larger than any is taken for the unit with which the chain closes, else for millimetres;
    positions and rotations may be in other columns, or of another form, than those of sessions.

    Raises:
        DataError: It is no session.
    """
    table = _otherwise_written(path) if path.is_dir() else None
    plain, robot = (None, None) if table is None else (table.plain, table.robot)
    file = path / "session.toml"
    name = read_toml(file, file.name).get("target") if file.is_file() else None
    stated = {}
    if isinstance(name, str) and name.endswith(".toml"):
        stated = read_toml(path / name, name)
    sides = (stated.get(name) for name in ("square_m", "size_m"))
    numbers = (side for side in sides if isinstance(side, int | float))
    side = next((number for number in numbers if LARGEST_M < number < _LARGEST_MM), None)
    if side is None:
        return InDoubt(Session.load(path, table=plain), robot)
    ways = {}
    for unit in _BOARD_UNITS:
        if UNITS_M[unit] * side <= LARGEST_M:
            target = _scaled(stated, UNITS_M[unit])
            ways[unit] = Session.load(path, target_document=target, table=plain)
    scores = {unit: _closing_score(way, robot) for unit, way in ways.items()}
    unit = min(scores, key=lambda index: scores[index])
    note = f"{name} cannot be in metres: {side:g} is read as {side:g} {unit}."
    return InDoubt(replace(ways[unit], warnings=(note, *ways[unit].warnings)), robot)


def _closing_score(session: Session, robot: PoseNumbers | None) -> float:
    """How well the chain closes as declared; infinite where it does not."""
    try:
        declared = guess_session(session, robot).declared
    except VisioncalError:
        # The reading that is then tried says why.
        return np.inf
    return declared.score if declared.closes else np.inf


@dataclass(frozen=True, eq=False)
class _PoseTable:
    """A views.csv whose poses are written otherwise than sessions have them.

    Attributes:
        plain: Its columns and rows, with positions as they are and the rotation of no turn.
        robot: What it says of the poses.
    """

    plain: tuple[tuple[str, ...], tuple[TextRow, ...]]
    robot: PoseNumbers


def _otherwise_written(folder: Path) -> _PoseTable | None:
    """Reads positions and rotations of other columns or forms; None where there are none."""
    if not (folder / "views.csv").is_file():
        return None
    columns, rows = parse_csv(read_text_inside(folder, "views.csv"), "views.csv")
    places = position_columns(columns) or POSITION
    spelt = {name.lower(): name for name in columns}
    others = (
        tuple(spelt[name] for name in names) for names in ROTATIONS if spelt.keys() >= set(names)
    )
    turns = QUATERNION if set(QUATERNION) <= set(columns) else next(others, ())
    if not turns or not {*places} <= {*columns}:
        return None
    cells = [dict(zip(columns, row.cells, strict=False)) for row in rows]
    numbers = [[_number(row.get(name, "")) for name in (*places, *turns)] for row in cells]
    values = np.array(numbers).reshape(-1, len(places) + len(turns))
    positions, rotations = values[:, :3], values[:, 3:]
    if turns == QUATERNION:
        if not np.nan_to_num(rotations[:, 3]).any():
            rotations = rotations[:, :3]
        elif places == POSITION:
            return None
    form = "quaternion-xyzw"
    if rotations.shape[1] == 3:
        largest = float(np.nanmax(np.abs(rotations), initial=0.0))
        form = "euler-xyz-deg" if largest > _LARGEST_RAD else "rotation-vector"
    kept = [name for name in columns if name not in {*places, *turns}]
    plain = []
    for row, mine, position in zip(rows, cells, positions, strict=True):
        is_there = np.isfinite(position).all()
        pose = [*map(repr, position.tolist()), *_NO_TURN] if is_there else [""] * len(POSE)
        plain.append(replace(row, cells=(*(mine.get(name, "") for name in kept), *pose)))
    robot = PoseNumbers(positions, rotations, Reading(form), tuple(row.where for row in rows))
    return _PoseTable(((*kept, *POSE), tuple(plain)), robot)


def _number(cell: str) -> float:
    return float(cell) if is_number(cell) else np.nan


def reread_session(
    session: Session,
    candidate: Candidate,
    robot: PoseNumbers | None = None,
    *,
    mirrors_poses: bool = False,
) -> Session:
    """Reads a session's poses as a candidate has it; everything else stays as it is.

    Of a mirror, corners.csv is turned back where it shows the board from behind. The session says
    what was changed.

    Args:
        session: The session.
        candidate: How its poses are meant.
        robot: The numbers of its robot's poses as they are written; left out, those that it has.
        mirrors_poses: Whether the robot's poses may be mirrored.

    Raises:
        DataError: The session that comes out is wrong; or as `reread`.
    """
    corners = session.corner_table
    changed: tuple[str, ...] = ()
    if _mirrors(candidate) and not mirrors_poses:
        if corners is None or session.resolution is None or not session_is_mirrored(session):
            raise _not_mirrored(candidate)
        corners, changed, candidate = _turned_back(corners, session.resolution[0], candidate)
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    camera = numbers_in(session, MEASURED_CAM_POSE)
    robot = numbers_in(session, POSE) if robot is None else robot
    taken = candidate.hypothesis
    _check_applies(candidate, robot)
    if _go_together(chain_poses(session), robot):
        _reorder(cells, taken.rows(len(cells)), joint_columns(session.columns))
    if robot.there.any():
        _replace(cells, pose_cells(taken.robot_numbers(robot), POSE), POSE)
    if camera.there.any():
        corrected = pose_cells(taken.camera_numbers(camera), MEASURED_CAM_POSE)
        _replace(cells, corrected, MEASURED_CAM_POSE)
    changed = (*changed, *_note(candidate))
    document = {**session.document, "mount": taken.mount}
    if changed:
        document["corrected"] = [*session.declaration.corrected, *changed]
    target = session.target_document
    if target is not None and candidate.board_scale != 1.0 and not session.targets:
        target = _scaled(target, candidate.board_scale)
        document["target"] = "target.toml"
    reread = Session.assemble(
        document,
        session.columns,
        [[row[name] for name in session.columns] for row in cells],
        session.images,
        target_document=target,
        robot_document=session.robot_document,
        corners=corners,
    ).with_streams(
        {name: _reread_stream(stream, taken) for name, stream in session.streams.items()}
    )
    said = dict.fromkeys((*changed, *session.warnings, *reread.warnings))
    return replace(reread, warnings=tuple(said))


def _reread_stream(stream: Stream, taken: Hypothesis) -> Stream:
    """Reads the poses of a stream as they are read in views."""
    if any(name not in stream for name in POSE):
        return stream
    numbers = np.stack([stream[name] for name in POSE], axis=1)
    places = tuple(f"sample {row + 1}" for row in range(len(stream)))
    poses = PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places)
    values = stream.values.copy()
    columns = [stream.columns.index(name) for name in POSE]
    rows = pose_cells(taken.robot.corrected(poses), POSE)
    values[:, columns] = [[float(row.get(name, "nan")) for name in POSE] for row in rows]
    values.setflags(write=False)
    return replace(stream, values=values)


def _mirrors(candidate: Candidate) -> bool:
    return candidate.hypothesis.robot.signs == "mirror"


def _not_mirrored(candidate: Candidate) -> DataError:
    """Says that poses are not mirrored unasked: those of mirrored images are right."""
    return DataError(
        "Nothing was written: mirrored images are the usual cause, and then the robot's poses are "
        "right.",
        culprits=[candidate.words],
        next_step="Turn the images back, and find their corners anew; only where the robot's "
        "frame is left-handed, mirror its poses with --mirror-poses.",
    )


def _turned_back(
    corners: CornerTable, width: int, candidate: Candidate
) -> tuple[CornerTable, tuple[str, ...], Candidate]:
    """Mirrors corners back, with the words for it and a candidate that leaves the poses alone."""
    px = corners.px.copy()
    px[:, 0] = width - 1 - px[:, 0]
    words = (
        f"corners.csv is mirrored back: each u_px is {width - 1} less what it was, and the robot's "
        "poses are not mirrored. Where it was v_px that counted from the wrong side, mirror v_px "
        "instead: the camera's frame is turned by 180 deg about its z else."
    )
    tried = candidate.hypothesis
    tried = replace(tried, robot=replace(tried.robot, signs=""))
    others = tuple(difference for difference in candidate.differences if difference != MIRROR_WORDS)
    return (
        replace(corners, px=px),
        (words,),
        replace(candidate, hypothesis=tried, differences=others),
    )


def _note(candidate: Candidate) -> tuple[str, ...]:
    if not candidate.changes:
        return ()
    return (f"The poses are read otherwise than declared: {candidate.words}.",)


def _check_applies(candidate: Candidate, robot: PoseNumbers) -> None:
    """Joint angles can change rows with their views, and nothing else."""
    if not robot.there.any() and candidate.hypothesis.robot != candidate.declared.robot:
        raise DataError(
            f"The chain closes with {candidate.words}, but the robot is known by its joint angles "
            "alone, of which that cannot be said.",
            culprits=[candidate.words],
            next_step="Check the robot's model, its tip, and the camera's poses.",
        )


def _go_together(chain: FloatArray | None, robot: PoseNumbers) -> bool:
    """Whether each row's joint angles are of its pose: they then change rows with it."""
    # Without a model of the robot this stays open, and one log is the likelier.
    if chain is None or not robot.there.any():
        return True
    # Other units or frames move all rows alike: what differs from row to row shows it.
    steps = [
        np.linalg.norm(np.diff(array, axis=0), axis=1)
        for array in (chain[:, :3, 3], robot.positions)
    ]
    both = np.isfinite(steps).all(axis=0)
    if both.sum() < _FEWEST_STEPS:
        return True
    return bool(np.corrcoef(steps[0][both], steps[1][both])[0, 1] > _SAME_LOG)


def _reorder(rows: Sequence[dict[str, str]], order: IntArray, names: Sequence[str]) -> None:
    before = [{name: row[name] for name in names} for row in rows]
    for row, at in zip(rows, order, strict=True):
        row.update(before[at] if at >= 0 else dict.fromkeys(names, ""))


def _replace(
    rows: Sequence[dict[str, str]], cells: Sequence[Mapping[str, str]], names: Sequence[str]
) -> None:
    for row, own in zip(rows, cells, strict=True):
        row.update({name: own.get(name, "") for name in names})


def _scaled(target: Mapping[str, Any], factor: float) -> Mapping[str, Any]:
    if factor == 1.0:
        return target
    return {
        name: factor * value if name in _LENGTHS and isinstance(value, int | float) else value
        for name, value in target.items()
    }
