"""Whether a session is of one camera and one robot, or of a whole cell."""

from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.session.choosing import Choice
from visioncal.session.document import KINDS
from visioncal.session.frames import frame_name
from visioncal.session.selecting import has_several
from visioncal.session.session import Session


def is_whole_cell(session: Session) -> bool:
    """Whether all of a session can only be adjusted together.

    So is a camera with an instrument, where the session says what hangs on what.
    """
    both = bool(session.cameras and session.instruments)
    return bool(_several(session)) or (both and bool(session.declaration.frames))


def is_to_be_parted(session: Session, choice: Choice) -> bool:
    """Whether one of each is to be taken out: several boards of one pair go together otherwise."""
    return is_whole_cell(session) or (bool(choice) and has_several(session))


def check_one_of_each(session: Session) -> None:
    """Refuses a session with several cameras, robots or instruments, or boards on either side.

    Raises:
        DataError: It is one of a whole cell.
    """
    if words := _several(session):
        raise DataError(
            f"session {session.name!r} {words}.",
            culprits=["session.toml"],
            next_step="Name one of each with --camera, --robot and --target, where the command has "
            "them (in Python: Session.of); or adjust all of it together: visioncal calibrate "
            "SESSION -o OUT.",
        )


def _several(session: Session) -> str:
    """What makes a session that of a whole cell; empty where it is none."""
    several = {it: list(session.declaration.named(it)) for it in KINDS if it != "target"}
    words = [f"{kind}s ({some_of(names)})" for kind, names in several.items() if len(names) > 1]
    if words:
        return f"has several {' and several '.join(words)}; this takes one"
    if not session.declaration.frames or session.mount == "instrument":
        return ""
    boards = [frame_name("target", name) for name in session.declaration.named("target")]
    moves = {it: session.frames[it].startswith("flange") for it in boards if it in session.frames}
    amiss = [it for it, is_moved in moves.items() if is_moved == (session.mount == "eye-in-hand")]
    if not amiss:
        return ""
    return (
        f"has its camera {session.mount} and {some_of(amiss)} on {session.frames[amiss[0]]}; "
        f"this takes boards {'in the cell' if moves[amiss[0]] else 'on the flange'} alone"
    )
