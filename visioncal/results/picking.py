"""A calibration and a session of whole cells, cut down to one camera, robot and target alike."""

from collections.abc import Collection

from visioncal.results.result import Calibration
from visioncal.session import Session
from visioncal.session.choosing import PARTS, Choice, Part
from visioncal.session.selecting import has_several, select
from visioncal.session.single import is_to_be_parted


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
    if several:
        session = select(session, choice, parted=parted)
    if calibration.cell is None:
        # The names have served for the session.
        return session, calibration if several else calibration.chosen(choice)
    named = {part: choice.of(part) for part in needs}
    return session, calibration.chosen(Choice(**named), needs)
