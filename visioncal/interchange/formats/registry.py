"""The formats that are known, and the way from one to another."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from visioncal.calibration.guess import Candidate
from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import check_free
from visioncal.core.number_format import did_you_mean
from visioncal.interchange.formats.assemble import assemble, wished
from visioncal.interchange.formats.columns import TABLE
from visioncal.interchange.formats.exchanging import exchange_views
from visioncal.interchange.formats.finding import listed
from visioncal.interchange.formats.foreign import Foreign, ForeignFormat
from visioncal.interchange.formats.import_options import ImportOptions
from visioncal.interchange.formats.industrial import HAND_EYE, KINEMATICS
from visioncal.interchange.formats.poses import check_radians
from visioncal.interchange.formats.rereading import InDoubt, load_in_doubt, reread, reread_session
from visioncal.interchange.formats.ros import EASY_HANDEYE, MOVEIT
from visioncal.interchange.formats.views import VIEWS
from visioncal.interchange.formats.yaml_folders import VISP, ZIVID
from visioncal.session import Session
from visioncal.session.selecting import check_one_of_each

# The first that recognises a path reads it: those that look for less come last.
FOREIGN_FORMATS: tuple[ForeignFormat, ...] = (
    HAND_EYE,
    KINEMATICS,
    VISP,
    ZIVID,
    EASY_HANDEYE,
    MOVEIT,
    VIEWS,
    TABLE,
)

_DEFAULTS = ImportOptions()

# Tries other readings of the poses, and settles which is right.
Choose: TypeAlias = Callable[[InDoubt | Foreign], Candidate]


@typed
def convert(
    source: Path | str,
    dest: Path | str,
    *,
    requested: ImportOptions = _DEFAULTS,
    form: str | None = None,
    force: bool = False,
    choose: Choose | None = None,
    mirrors_poses: bool = False,
    exchange: tuple[int, int] | None = None,
) -> Session:
    """Writes a session, or somebody else's recording, as a session's folder or as a recording.

    A session goes from one form of ours to another without loss.

    Args:
        source: The session, as a folder or an .rrd, or a recording in any of `FOREIGN_FORMATS`.
        dest: Where to; its suffix says in which form, and none of theirs means a folder.
        requested: What is to be known of somebody else's recording beyond what it says.
        form: The name of its format, where it is not to be recognised.
        force: Whether a file that is there may be replaced; a folder never is.
        choose: Called, where it is in doubt how the poses are meant, with what was read; what it
            answers is what is written.
        mirrors_poses: Whether that may mirror the robot's poses.
        exchange: Two views whose images, corners and readings are to be exchanged.

    Returns:
        The session.

    Raises:
        DataError: `source` is neither, `requested` is not for it, `dest` is taken, cannot be
            written or, read again, is another session.
    """
    source, dest = Path(source), Path(dest)
    _check_dest(source, dest, force=force)
    if form is not None or not _is_session(source):
        foreign = read_foreign(source, requested, form)
        if choose is None:
            check_radians(foreign.robot, requested.robot, "robot")
            if foreign.camera is not None:
                check_radians(foreign.camera, requested.camera, "camera")
        if choose is not None:
            foreign = reread(foreign, choose(foreign), mirrors_poses=mirrors_poses)
        session = assemble(foreign)
    elif requested != _DEFAULTS:
        raise DataError(
            f"{source} is a session already; what describes poses and cameras is for somebody "
            "else's recording.",
            culprits=[str(source)],
            next_step="Edit its session.toml, or convert its views.csv.",
        )
    elif choose is None:
        session = Session.load(source)
    else:
        doubtful = load_in_doubt(source)
        check_one_of_each(doubtful.session)
        session = reread_session(
            doubtful.session, choose(doubtful), doubtful.robot, mirrors_poses=mirrors_poses
        )
    if exchange is not None:
        session = exchange_views(session, *exchange)
    write_session(session, dest)
    return session


def read_foreign(source: Path, requested: ImportOptions, form: str | None = None) -> Foreign:
    """Reads somebody else's recording, as the user says that it is to be read.

    Args:
        source: A file or folder in any of `FOREIGN_FORMATS`.
        requested: What the user says of it.
        form: The name of its format; None to recognise it.

    Raises:
        DataError: It is of no known format, or something in it is wrong.
    """
    # Two files are two tables, whatever the first of them looks like.
    form = form or (TABLE.name if requested.camera_file is not None else None)
    return wished(_foreign_format(source, form).read(source, requested), requested)


def write_session(session: Session, dest: Path) -> None:
    """Writes a session in the form that the suffix of `dest` names, and reads it again.

    Raises:
        DataError: There is nothing in the session, `dest` cannot be written, or does not hold it.
    """
    if not session.views and not session.streams:
        raise DataError(
            " ".join([f"Session {session.name!r} has no view and no stream.", *session.warnings]),
            culprits=[session.name],
            next_step="Nothing was written; record it again.",
        )
    if _is_recording(dest):
        # The codec takes half a second to import, which help need not wait for.
        from visioncal.present.recording import write_recording
        from visioncal.present.viewer import blueprint

        write_recording(dest, session, None, (), blueprint(session))
    else:
        session.save(dest)
    if Session.load(dest).digest() != session.digest():
        raise DataError(
            f"{dest} does not hold the session {session.name}: their digests differ.",
            culprits=[str(dest)],
            next_step="Remove it, and report this with the session.",
        )


def _is_recording(path: Path) -> bool:
    return path.suffix.lower() == ".rrd"


def _is_session(path: Path) -> bool:
    """Whether a path is one of ours."""
    # A result is no session either, but what it is and where its session lies is told on reading.
    is_result = path.name == "calibration.json" or (path / "recording.rrd").is_file()
    is_folder = is_result or (path / "session.toml").is_file()
    return is_folder or (path.is_file() and _is_recording(path))


def _check_source(source: Path) -> None:
    if not source.exists():
        raise DataError(
            f"{source} does not exist.",
            culprits=[str(source)],
            next_step="Check the path and its spelling.",
        )
    if not (source.is_file() or source.is_dir()):
        raise DataError(
            f"{source} is no regular file; a file or a folder is needed.",
            culprits=[str(source)],
            next_step="Save what it gives as a file first.",
        )


def _check_dest(source: Path, dest: Path, *, force: bool) -> None:
    is_folder = not _is_recording(dest)
    # An empty folder is free for a session's folder, which looks for itself.
    if not (is_folder and dest.is_dir()):
        same = source.exists() and dest.exists() and dest.samefile(source)
        check_free(dest, force=force, replaceable=not is_folder and not same)


def _foreign_format(source: Path, form: str | None) -> ForeignFormat:
    _check_source(source)
    names = [foreign_format.name for foreign_format in FOREIGN_FORMATS]
    if form is not None and form not in names:
        raise DataError(
            f"There is no format named {form!r}; the names are {', '.join(names)}.",
            culprits=[form],
            next_step=did_you_mean(form, names),
        )
    for known in FOREIGN_FORMATS:
        if known.name == form or (form is None and known.recognises(source)):
            return known
    own = ("a session's folder", "an .rrd recording")
    words = "; ".join([*own, *(foreign_format.words for foreign_format in FOREIGN_FORMATS)])
    inside = ", ".join(path.name for path in listed(source)[:8]) if source.is_dir() else ""
    raise DataError(
        f"{source} is no session and in no format that is known: {words}."
        + (f" It holds {inside}." if inside else ""),
        culprits=[str(source)],
        next_step="Write the poses into a CSV with a header, a row a view.",
    )
