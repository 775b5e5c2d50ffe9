"""Other readings of a recording's poses: which is right, and the recording read that way."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.conventions import PoseNumbers, Reading
from visioncal.formats.assemble import assemble, pose_cells, spoken
from visioncal.formats.foreign import Foreign
from visioncal.guess import Candidate, Guess, guess_reading
from visioncal.pipeline.guessing import chain_poses, seen_poses
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE
from visioncal.types import FloatArray, Mount, Progress

_MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
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


def reread_session(session: Session, candidate: Candidate) -> Session:
    """Reads a session's poses as a candidate has it; everything else stays as it is.

    Raises:
        DataError: The session that comes out is wrong.
    """
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    robot, camera = _numbers(session, POSE), _numbers(session, MEASURED_CAM_POSE)
    if robot is not None:
        _replace(cells, pose_cells(candidate.robot_numbers(robot), POSE), POSE)
    if camera is not None:
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
    return replace(reread, warnings=(*_note(candidate), *reread.warnings))


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


def _numbers(session: Session, names: Sequence[str]) -> PoseNumbers | None:
    rows = [[view.numbers.get(name, np.nan) for name in names] for view in session.views]
    numbers = np.array(rows, dtype=float)
    if not np.isfinite(numbers).any():
        return None
    places = tuple(f"view {view.number}" for view in session.views)
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places)


def _replace(
    rows: Sequence[dict[str, str]], cells: Sequence[Mapping[str, str]], names: Sequence[str]
) -> None:
    for row, own in zip(rows, cells, strict=True):
        row.update({name: own.get(name, "") for name in names})


def _scaled(target: Mapping[str, Any], factor: float) -> Mapping[str, Any]:
    if factor == 1.0:
        return target
    return {it: factor * value if it in _LENGTHS else value for it, value in target.items()}
