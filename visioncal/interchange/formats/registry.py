"""All foreign formats, and the conversion of sessions and foreign recordings."""

import shutil
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from visioncal.calibration.guess import Candidate
from visioncal.calibration.pipeline.mended_images import mend_images
from visioncal.core.arguments import typed
from visioncal.core.choices import MOUNTS
from visioncal.core.errors import DataError
from visioncal.core.files import check_free
from visioncal.core.number_format import known_name, robot_words, some_of
from visioncal.core.types import Progress
from visioncal.interchange.formats.assemble import assemble, with_user_options
from visioncal.interchange.formats.bags import BAG
from visioncal.interchange.formats.columns import TABLE, VIEWS
from visioncal.interchange.formats.foreign import ForeignFormat, ForeignRecording, ImportOptions
from visioncal.interchange.formats.industrial import EASY_HANDEYE, HAND_EYE, KINEMATICS, MOVEIT
from visioncal.interchange.formats.lerobot import LEROBOT
from visioncal.interchange.formats.mending import (
    exchange_views,
    remove_tool,
    scale_board,
    shift_views,
    turn_boards,
    without_reported_poses,
    without_stated_lenses,
    write_positions,
)
from visioncal.interchange.formats.metrology import METROLOGY
from visioncal.interchange.formats.pose_forms import check_radians
from visioncal.interchange.formats.rereading import (
    DoubtfulRobot,
    DoubtfulSession,
    doubtful_robots,
    load_for_rereading,
    reread,
    reread_robot,
)
from visioncal.interchange.formats.settling import settled
from visioncal.interchange.formats.sources import describe, unknown
from visioncal.interchange.formats.views import VISP, ZIVID
from visioncal.interchange.mends import Mends
from visioncal.session import Session
from visioncal.session.selecting import is_whole_cell

# The first that recognises a path reads it, so that of anything comes last; `views` must be asked
# for, as it reads the same.
FOREIGN_FORMATS: tuple[ForeignFormat, ...] = (
    BAG,
    LEROBOT,
    HAND_EYE,
    KINEMATICS,
    VISP,
    ZIVID,
    EASY_HANDEYE,
    MOVEIT,
    METROLOGY,
    TABLE,
    VIEWS,
)

_DEFAULTS, _NO_MENDS = ImportOptions(), Mends()
_FREE_LENSES = replace(_DEFAULTS, intrinsics="estimate")

# Tries other readings of the poses, and selects one.
Choose: TypeAlias = Callable[[DoubtfulSession | DoubtfulRobot], Candidate]


@typed
def convert(
    source: Path | str,
    dest: Path | str,
    *,
    requested: ImportOptions = _DEFAULTS,
    form: str | None = None,
    force: bool = False,
    choose: Choose | None = None,
    mends: Mends = _NO_MENDS,
) -> Session:
    """Writes a session or a foreign recording as a session's folder or as a recording.

    Conversion between our own formats is lossless.

    Args:
        source: The session, as a folder or an .rrd, or a recording in any of `FOREIGN_FORMATS`.
        dest: Destination; its suffix selects the format, and any other suffix means a folder.
        requested: Options for a foreign recording; of a session lenses alone may be estimated.
        form: The name of its format; None to recognise it.
        force: Whether an existing file may be replaced; a folder never is.
        choose: Called with what was read, unless the only reading that agrees with the images or
            the target's poses contradicts nothing stated; returns the reading to apply.
        mends: Views and images that are mended; and whether that reading may mirror the robot's
            poses.

    Returns:
        The session.

    Raises:
        DataError: `source` is neither, `requested` does not apply to it, `dest` exists, cannot be
            written, or reads back differently.
    """
    source, dest = Path(source), Path(dest)
    is_folder = not _is_recording(dest)
    # An empty folder is checked by the session's writer.
    if not (is_folder and dest.is_dir()):
        same = source.exists() and dest.exists() and dest.samefile(source)
        check_free(dest, force=force, replaceable=not is_folder and not same)
    # Loading a result reports what it is and where its session is.
    is_result = source.name == "calibration.json" or (source / "recording.rrd").is_file()
    is_recording = source.is_file() and _is_recording(source)
    is_session = is_result or is_recording or (source / "session.toml").is_file()
    if form is not None or not is_session:
        foreign = read_foreign(source, requested, form)
        tested = foreign
        with nullcontext() if choose is None else suppress(DataError):
            tested = settled(foreign, requested.progress)
        # Of what nothing states, the only reading that agrees contradicts nobody.
        is_found = tested is not foreign and not tested.unstated
        if choose is None or is_found:
            tested = replace(_checked(foreign, tested, requested), title=dest.resolve().stem)
            choose, session = None, assemble(tested)
        else:
            doubtful = DoubtfulSession.of(replace(foreign, title=dest.resolve().stem))
    elif requested not in (_DEFAULTS, _FREE_LENSES):
        raise DataError(
            f"{source} is a session already; options that describe poses and cameras are for "
            "foreign recordings.",
            culprits=[str(source)],
            next_step="Edit its session.toml, or convert its views.csv.",
        )
    elif choose is None:
        session = Session.load(source)
    else:
        doubtful = load_for_rereading(source)
    if choose is not None:
        session = _reread(doubtful, choose, requested.progress, mirrors_poses=mends.mirror_poses)
    of_views: tuple[tuple[Callable[..., Session], tuple[object, ...] | None], ...] = (
        (exchange_views, mends.exchange),
        (shift_views, mends.shift),
        (turn_boards, mends.turned),
        (write_positions, mends.positions),
        (remove_tool, mends.without_tool),
        (scale_board, mends.board_scale),
    )
    for mend, values in of_views:
        session = session if values is None else mend(session, *values)
    for mend_whole, is_requested in (
        (without_stated_lenses, is_session and requested == _FREE_LENSES),
        (without_reported_poses, mends.by_joints),
    ):
        session = mend_whole(session) if is_requested else session
    if mends.mend_images:
        session = mend_images(session, requested.progress)
    write_session(session, dest)
    return session


def _reread(
    doubtful: DoubtfulSession, choose: Choose, progress: Progress | None, *, mirrors_poses: bool
) -> Session:
    """The session in the chosen reading, of a whole cell robot by robot; raises DataError."""
    if not is_whole_cell(doubtful.session):
        return reread(doubtful, choose(doubtful), mirrors_poses=mirrors_poses)
    reread_robots, refused = set[str](), dict[str, DataError]()
    for of_robot in doubtful_robots(doubtful, progress):
        try:
            chosen = choose(of_robot)
        except DataError as error:
            # Another robot's poses are mended nevertheless.
            refused[of_robot.robot] = error
            continue
        doubtful = reread_robot(doubtful, of_robot, chosen, mirrors_poses=mirrors_poses)
        reread_robots.add(of_robot.robot)
    if refused and not reread_robots:
        raise next(iter(refused.values()))
    # Numbers in another form are no poses until a reading makes them some.
    untested = {*doubtful.session.robots} - reread_robots if doubtful.robot is not None else set()
    if untested:
        raise DataError(
            f"Nothing was written: the poses of {some_of([*map(robot_words, sorted(untested))])} "
            "are in another form, and too few views test how they are read.",
            culprits=["views.csv"],
            next_step="Write its rotations as qx, qy, qz, qw, or add views that show a target.",
        )
    left = map(robot_words, refused)
    notes = [f"Poses of {label} stay as they are: no reading stands out." for label in left]
    if not reread_robots:
        notes.append("The poses of each robot that enough views test fit as first read.")
    return replace(doubtful.session, warnings=(*doubtful.session.warnings, *notes))


def _checked(
    foreign: ForeignRecording, tested: ForeignRecording, requested: ImportOptions
) -> ForeignRecording:
    """The recording with what its source does not say, as tested; raises DataError."""
    robot = foreign.robot if foreign.stream is None else foreign.stream.poses
    # A tested reading is in no doubt.
    if tested.unstated or not foreign.unstated:
        check_radians(robot, requested.robot, "robot")
        if foreign.camera is not None:
            check_radians(foreign.camera, requested.camera, "camera")
    return tested


def read_foreign(
    source: Path, requested: ImportOptions, form: str | None = None
) -> ForeignRecording:
    """Reads a foreign recording with the user's options applied; raises DataError.

    Its format is recognised; `form` selects one of several that fit.
    """
    # With a second file, both are tables, whatever the first looks like.
    if form is None and (requested.mount == "instrument" or requested.instrument is not None):
        form = METROLOGY.name
    form = form or (TABLE.name if requested.camera_file is not None else None)
    foreign = _foreign_format(source, form, requested).read(source, requested)
    rivals = ((rank, with_user_options(each, requested)) for rank, each in foreign.rivals)
    return replace(with_user_options(foreign, requested), rivals=tuple(rivals))


def write_session(session: Session, dest: Path) -> None:
    """Writes a session in the format of the suffix of `dest`, and checks that it reads back.

    Raises:
        DataError: The session is empty, `dest` cannot be written, or reads back differently.
    """
    if not session.views and not session.streams:
        raise DataError(
            " ".join([f"Session {session.name!r} has no view and no stream.", *session.warnings]),
            culprits=[session.name],
            next_step="Nothing was written; record it again.",
        )
    if _is_recording(dest):
        # The codec takes half a second to import, which --help need not wait for.
        from visioncal.present.recording import write_recording
        from visioncal.present.viewer import blueprint

        write_recording(dest, session, None, (), blueprint(session))
    else:
        session.save(dest)
    # Content beyond a session's, such as a place outside any cell, is refused, and not left.
    with ExitStack() as otherwise:
        otherwise.callback(shutil.rmtree if dest.is_dir() else Path.unlink, dest)
        if Session.load(dest).digest() != session.digest():
            raise DataError(
                f"session {session.name!r} is not the same when it is read twice, as a damaged "
                "video or a file that is still being written.",
                culprits=[session.name],
                next_step="Nothing was written; take a complete copy of its source.",
            )
        otherwise.pop_all()


def _is_recording(path: Path) -> bool:
    return path.suffix.lower() == ".rrd"


def _foreign_format(source: Path, form: str | None, requested: ImportOptions) -> ForeignFormat:
    if not (source.is_file() or source.is_dir()):
        fault = "is not a regular file" if source.exists() else "does not exist"
        raise DataError(
            f"{source} {fault}; it must be a file or a folder.",
            culprits=[str(source)],
            next_step="Check the path and its spelling.",
        )
    names = [foreign_format.name for foreign_format in FOREIGN_FORMATS]
    if form is not None:
        known_name("format", form, names)
    # Points of an instrument that is asked for need no program's headings; a camera has others.
    is_of_camera = requested.mount in MOUNTS or requested.target or requested.images
    others = (METROLOGY,) * bool(is_of_camera and form is None)
    for candidate in FOREIGN_FORMATS:
        if (
            form in (None, candidate.name)
            and candidate not in others
            and (form == METROLOGY.name or candidate.recognises(source))
        ):
            return candidate
    raise unknown(describe(source), requested)
