"""Selection of the same camera, robot and target from a session and a calibration, with checks."""

from collections.abc import Collection

from visioncal.core.errors import DataError
from visioncal.results.result import Calibration
from visioncal.session import Session
from visioncal.session.selecting import (
    PARTS,
    Choice,
    Part,
    check_one_of_each,
    chosen_of,
    has_several,
    must_select_one,
    select,
)


def select_matching(
    session: Session,
    calibration: Calibration,
    choice: Choice,
    needs: Collection[Part] = PARTS,
    *,
    parted: bool = True,
) -> tuple[Session, Calibration]:
    """Selects one camera, one robot and one target from a session and a calibration.

    Args:
        session: Of a whole cell, or of one of each.
        calibration: Of a whole cell, or of one of each.
        choice: Names of the parts; for whole cells only.
        needs: Parts of the calibration that must be unambiguous.
        parted: Whether the robot must be between the session's camera and target.

    Raises:
        DataError: There is none of that name, or the choice is ambiguous.
    """
    several = must_select_one(session, choice) if parted else has_several(session)
    of_session = dict[Part, str]()
    if several:
        chosen = chosen_of(session, choice, robot_between=parted)
        of_session = {part: chosen.frame_of(part) for part in PARTS}
        session = select(session, choice, robot_between=parted)
    if calibration.cell is None:
        # The names were those of the session.
        return session, calibration if several else calibration.chosen(choice)
    # A part that the session's rows determine needs no name, if the calibration has it.
    parents = calibration.tree.parents
    named = {
        part: getattr(choice, part)
        or (frame if (frame := of_session.get(part)) in parents else None)
        for part in needs
    }
    return session, calibration.chosen(Choice(**named), needs)


def check_mount(session: Session, calibration: Calibration) -> None:
    """Checks that the session's camera is mounted as the calibrated one; raises DataError."""
    check_one_of_each(session)
    if session.mount != calibration.mount:
        raise DataError(
            f"session {session.name!r} has its camera {session.mount}, and the calibration "
            f"{calibration.session_name!r} is of one {calibration.mount}.",
            culprits=["session.toml: mount"],
            next_step="Correct mount in session.toml, or name the calibration of this camera.",
        )


def check_resolution(
    session: Session, calibration: Calibration, resolution: tuple[int, int]
) -> None:
    """Checks that images have the calibrated camera's resolution; raises DataError."""
    camera = calibration.camera
    if camera is None or resolution == camera.camera.resolution:
        return
    shown, needed = (f"{pair[0]} x {pair[1]}" for pair in (resolution, camera.camera.resolution))
    raise DataError(
        f"session {session.name!r}: its images have {shown} pixels, and the calibrated camera has "
        f"{needed}.",
        culprits=["session.toml: camera.resolution"],
        next_step="Take the images with the same camera, binning and region as calibrated.",
    )
