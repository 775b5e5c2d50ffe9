"""A calibration and a session that go together: of one camera, and cut down to one pair alike."""

from collections.abc import Collection

from visioncal.core.errors import DataError
from visioncal.results.result import Calibration
from visioncal.session import Session
from visioncal.session.choosing import PARTS, Choice, Part
from visioncal.session.selecting import (
    check_one_of_each,
    chosen_of,
    has_several,
    is_to_be_parted,
    select,
)


def picked(
    session: Session,
    calibration: Calibration,
    choice: Choice,
    needs: Collection[Part] = PARTS,
    *,
    parted: bool = True,
) -> tuple[Session, Calibration]:
    """Takes one camera, one robot and one target out of what is of a whole cell.

    Args:
        session: Of a whole cell, or of one of each already.
        calibration: Likewise.
        choice: What is meant; names are for what is of a whole cell.
        needs: What of the calibration has to be clear.
        parted: Whether this robot is to move camera and target of the session before each other.

    Raises:
        DataError: There is no such thing, or several are meant.
    """
    several = is_to_be_parted(session, choice) if parted else has_several(session)
    by_rows = dict[Part, str]()
    if several:
        chosen = chosen_of(session, choice, parted=parted)
        by_rows = {part: chosen.frame_of(part) for part in PARTS}
        session = select(session, choice, parted=parted)
    if calibration.cell is None:
        # The names have served for the session.
        return session, calibration if several else calibration.chosen(choice)
    # What the session's rows make clear needs no name, if the calibration has it.
    known = calibration.tree.parents
    named = {
        part: choice.of(part) or (frame if (frame := by_rows.get(part)) in known else None)
        for part in needs
    }
    return session, calibration.chosen(Choice(**named), needs)


def check_mount(session: Session, calibration: Calibration) -> None:
    """Refuses the session of a camera that is mounted elsewhere than the calibrated one.

    Raises:
        DataError: So it is.
    """
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
    """Refuses images of another size than those of the calibrated camera.

    Raises:
        DataError: So they are.
    """
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
