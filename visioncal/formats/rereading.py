"""Other readings of a recording's poses: which is right, and the recording read that way."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.conventions import PoseNumbers, Reading
from visioncal.files import parse_toml, read_text
from visioncal.formats.assemble import assemble, pose_cells, spoken
from visioncal.formats.foreign import Foreign
from visioncal.guess import Candidate, Guess, guess_reading
from visioncal.pipeline.guessing import chain_poses, numbers_in, seen_poses
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, joint_columns
from visioncal.targets import LARGEST_M
from visioncal.types import FloatArray, IntArray, Mount, Progress

_MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
# Distances between consecutive rows of one log go up and down together.
_FEWEST_STEPS, _SAME_LOG = 4, 0.9
# No printed square is larger.
_LARGEST_MM = 1e3 * LARGEST_M
_LENGTHS = ("square_m", "square_sigma_m", "marker_m", "size_m")


def guess_foreign(foreign: Foreign, *, progress: Progress | None = None) -> Guess:
    """Tries every plausible reading of somebody else's poses.

    Where the mount is not known, it is the one under which the fewest things are otherwise than
    declared: a chain with the camera's poses inverted closes as well under the other.

    Raises:
        DataError: There is nothing to read, or the target is in no view.
        DegenerateError: Too few views have both poses.
        ConvergenceError: The intrinsics do not come to rest.
    """
    foreign = spoken(foreign)
    session = assemble(foreign, mount=_MOUNTS[0])
    chain = chain_poses(session)
    is_measured = foreign.camera is None
    camera = foreign.camera
    if camera is None:
        camera = seen_poses(session, progress=progress)
    robot = foreign.robot if _is_told(foreign) or chain is None else _of_chain(foreign, chain)
    guesses = [
        guess_reading(robot, camera, mount, chain=chain, is_measured=is_measured)
        for mount in ((foreign.mount,) if foreign.mount else _MOUNTS)
    ]
    return min(guesses, key=lambda it: it.candidates[0].changes)


def reread(foreign: Foreign, candidate: Candidate) -> Foreign:
    """Reads a recording as a candidate has it: poses, pairing, mount and the size of the board."""
    foreign, notes = spoken(foreign), _note(candidate)
    if foreign.mount is None:
        notes = (
            *notes,
            f"The mount is taken for {candidate.mount}, under which the fewest things are "
            "otherwise than declared; --mount says another.",
        )
    target = foreign.target
    return replace(
        foreign,
        robot=candidate.robot_numbers(foreign.robot) if _is_told(foreign) else foreign.robot,
        camera=None if foreign.camera is None else candidate.camera_numbers(foreign.camera),
        mount=candidate.mount,
        target=None if target is None else _scaled(target, candidate.board_scale),
        notes=(*foreign.notes, *notes),
    )


def load_in_doubt(path: Path) -> Session:
    """Loads a session that is to be read anew: a board larger than any is taken for millimetres.

    Raises:
        DataError: It is no session.
    """
    file = path / "session.toml"
    name = parse_toml(read_text(file), file.name).get("target") if file.is_file() else None
    if not isinstance(name, str) or not name.endswith(".toml"):
        return Session.load(path)
    stated = parse_toml(read_text(path / name), name)
    sides = [stated[it] for it in ("square_m", "size_m") if isinstance(stated.get(it), int | float)]
    if not sides or not LARGEST_M < sides[0] < _LARGEST_MM:
        return Session.load(path)
    session = Session.load(path, target_document=_scaled(stated, 1e-3))
    note = f"{name} can only be in millimetres: a side of {sides[0]:g} is read as {sides[0]:g} mm."
    return replace(session, warnings=(note, *session.warnings))


def reread_session(session: Session, candidate: Candidate) -> Session:
    """Reads a session's poses as a candidate has it; everything else stays as it is.

    Raises:
        DataError: The session that comes out is wrong.
    """
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    robot, camera = numbers_in(session, POSE), numbers_in(session, MEASURED_CAM_POSE)
    if _any(robot):
        if _go_together(session, robot):
            _reorder(cells, candidate.hypothesis.rows(len(cells)), joint_columns(session.columns))
        _replace(cells, pose_cells(candidate.robot_numbers(robot), POSE), POSE)
    if _any(camera):
        corrected = candidate.camera_numbers(camera)
        _replace(cells, pose_cells(corrected, MEASURED_CAM_POSE), MEASURED_CAM_POSE)
    document = {**session.document, "mount": candidate.mount}
    target = session.target_document
    if target is not None and candidate.board_scale != 1.0:
        target = _scaled(target, candidate.board_scale)
        document["target"] = "target.toml"
    reread = Session.assemble(
        document,
        session.columns,
        [[row[name] for name in session.columns] for row in cells],
        session.images,
        target_document=target,
        robot_document=session.robot_document,
    )
    said = dict.fromkeys((*_note(candidate), *session.warnings, *reread.warnings))
    return replace(reread, warnings=tuple(said))


def _note(candidate: Candidate) -> tuple[str, ...]:
    if not candidate.changes:
        return ()
    return (f"The poses are read otherwise than declared: {candidate.words}.",)


def _is_told(foreign: Foreign) -> bool:
    """Whether the source has poses of the robot, not joints alone."""
    return bool(np.isfinite(foreign.robot.positions).any())


def _of_chain(foreign: Foreign, chain: FloatArray) -> PoseNumbers:
    rotations = chain[:, :3, :3].reshape(-1, 9)
    return PoseNumbers(chain[:, :3, 3], rotations, Reading("matrix"), foreign.robot.places)


def _any(numbers: PoseNumbers) -> bool:
    return bool(np.isfinite(numbers.positions).any())


def _go_together(session: Session, robot: PoseNumbers) -> bool:
    """Whether each row's joint angles are of its pose: they then change rows with it.

    Without a model of the robot nobody can tell, and one log is the likelier.
    """
    chain = chain_poses(session)
    if chain is None:
        return True
    # Other units or frames move all rows alike: what differs from row to row tells.
    steps = [
        np.linalg.norm(np.diff(it, axis=0), axis=1) for it in (chain[:, :3, 3], robot.positions)
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
        it: factor * value if it in _LENGTHS and isinstance(value, int | float) else value
        for it, value in target.items()
    }
