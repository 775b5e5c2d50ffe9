"""`visioncal convert`."""

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import messages, shown_progress
from visioncal.cli.guessed import print_guess
from visioncal.errors import DataError
from visioncal.formats import (
    FOREIGN_FORMATS,
    Foreign,
    PoseWishes,
    Wishes,
    assemble,
    check_free,
    convert,
    guess_foreign,
    is_session,
    load_in_doubt,
    read_foreign,
    reread,
    reread_session,
    write_session,
)
from visioncal.guess import Candidate, Guess
from visioncal.pipeline.guessing import guess_session
from visioncal.session import Session
from visioncal.types import Mount

_POSES = "The poses"
_CAMERA = "Somebody else's camera"
_OTHER = "Somebody else's recording"

_FORMS = "ur, kuka, fanuc, abb ..., or a rotation such as euler-ZYX-deg, quaternion-wxyz"
_FORMATS = ", ".join(it.name for it in FOREIGN_FORMATS)


def _option(*names: str, panel: str, words: str) -> object:
    return typer.Option(*names, help=words, rich_help_panel=panel, show_default=False)


def convert_command(
    source: Annotated[
        Path,
        typer.Argument(help="A session's folder, its .rrd, or somebody else's file or folder."),
    ],
    dest: Annotated[Path, typer.Argument(help="An .rrd, or the folder to write.")],
    force: Annotated[
        bool, typer.Option("--force", help="Replace a file that is there; never a folder.")
    ] = False,
    form: Annotated[
        str | None, _option("--from", panel=_OTHER, words=f"Its format, by name: {_FORMATS}.")
    ] = None,
    mount: Annotated[
        Mount | None, _option("--mount", panel=_OTHER, words="Where the camera is.")
    ] = None,
    target: Annotated[
        str | None,
        _option(
            "--target",
            panel=_OTHER,
            words="A name in targets/, a .toml, or in one word as checkerboard_9x6_23.6mm, "
            "charuco_5x7_36.2mm_18.3mm_DICT_6X6_250, marker_DICT_4X4_50_10_48mm.",
        ),
    ] = None,
    robot_columns: Annotated[
        str | None,
        _option(
            "--robot-columns",
            "--robot-key",
            panel=_POSES,
            words="Columns or keys of the robot's poses, position first: X,Y,Z,A,B,C or O_T_EE.",
        ),
    ] = None,
    robot_form: Annotated[
        str | None, _option("--robot-form", panel=_POSES, words=f"How they are written: {_FORMS}.")
    ] = None,
    robot_unit: Annotated[
        str | None, _option("--robot-unit", panel=_POSES, words="m, cm, mm, um or inch.")
    ] = None,
    robot_inverse: Annotated[
        bool | None,
        _option(
            "--robot-inverse/--robot-as-is",
            panel=_POSES,
            words="They give the base in the flange.",
        ),
    ] = None,
    camera_columns: Annotated[
        str | None,
        _option(
            "--camera-columns",
            "--camera-key",
            panel=_POSES,
            words="Columns or keys of measured poses of the target: rvec,tvec.",
        ),
    ] = None,
    camera_form: Annotated[
        str | None, _option("--camera-form", panel=_POSES, words="As --robot-form.")
    ] = None,
    camera_unit: Annotated[
        str | None, _option("--camera-unit", panel=_POSES, words="As --robot-unit.")
    ] = None,
    camera_inverse: Annotated[
        bool | None,
        _option(
            "--camera-inverse/--camera-as-is",
            panel=_POSES,
            words="They give the camera in the target.",
        ),
    ] = None,
    camera_file: Annotated[
        Path | None,
        _option(
            "--camera-file",
            panel=_POSES,
            words="A second file with the camera's poses; with times in both, the clocks' offset "
            "is found.",
        ),
    ] = None,
    joint_columns: Annotated[
        str | None,
        _option(
            "--joint-columns",
            "--joint-key",
            panel=_POSES,
            words="Columns or keys of the joint angles, in radians.",
        ),
    ] = None,
    joints_deg: Annotated[
        bool, _option("--joints-deg", panel=_POSES, words="The joint angles are in degrees.")
    ] = False,
    images: Annotated[
        Path | None,
        _option(
            "--images",
            panel=_CAMERA,
            words="The folder of the images; matched by name, by number, or in order.",
        ),
    ] = None,
    image_column: Annotated[
        str | None,
        _option(
            "--image-column",
            "--image-key",
            panel=_CAMERA,
            words="The column or key that names each row's image.",
        ),
    ] = None,
    intrinsics: Annotated[
        str | None,
        _option(
            "--intrinsics",
            panel=_CAMERA,
            words="A file (ROS, OpenCV, Kalibr, ViSP, .npz, .json), or `estimate` to ignore those "
            "of the source.",
        ),
    ] = None,
    resolution: Annotated[
        str | None,
        _option("--resolution", panel=_CAMERA, words="WIDTH,HEIGHT that the intrinsics hold for."),
    ] = None,
    robot_model: Annotated[
        str | None,
        _option(
            "--robot-model",
            panel=_OTHER,
            words="A built-in robot, or the path of a .urdf or .toml.",
        ),
    ] = None,
    tip: Annotated[
        str | None, _option("--tip", panel=_OTHER, words="The frame that the poses are of.")
    ] = None,
    guess: Annotated[
        bool,
        _option("--guess", panel=_OTHER, words="Try other readings of the poses, and ask."),
    ] = False,
    yes: Annotated[
        bool,
        _option("--yes", panel=_OTHER, words="Take the best guess where it stands out clearly."),
    ] = False,
) -> None:
    """Write a session as a folder or as a recording, or make one of somebody else's recording.

    Between our own forms nothing is lost, which digests prove. Exit status 0: it is written; 2:
    nothing was written, and the message says what is missing or wrong.
    """
    wishes = Wishes(
        robot=PoseWishes(_names(robot_columns), robot_form, robot_unit, robot_inverse),
        camera=PoseWishes(_names(camera_columns), camera_form, camera_unit, camera_inverse),
        joints=_names(joint_columns),
        joints_deg=joints_deg,
        image=image_column,
        camera_file=camera_file,
        mount=mount,
        target=target,
        intrinsics=intrinsics,
        images=images,
        resolution=_size(resolution),
        robot_model=robot_model,
        tip=tip,
    )
    if yes and not guess:
        raise DataError("--yes takes the best guess; it needs --guess.", culprits=["--yes"])
    is_own = form is None and is_session(source)
    if is_own and wishes != Wishes():
        raise DataError(
            f"{source} is a session already; what describes poses and cameras is for somebody "
            "else's recording.",
            culprits=[str(source)],
            next_step="Edit its session.toml, or convert its views.csv.",
        )
    if is_own and not guess:
        session = convert(source, dest, force=force)
    else:
        check_free(source, dest, force=force)
        if is_own:
            session = _reread_session(load_in_doubt(source), yes=yes)
        else:
            foreign = read_foreign(source, wishes, form)
            session = assemble(_reread(foreign, yes=yes) if guess else foreign)
        write_session(session, dest)
    for warning in session.warnings:
        messages().print(escape(f"note: {warning}"))
    messages().print(escape(f"wrote {dest}\nsha256 {session.digest()}"))


def _names(words: str | None) -> tuple[str, ...]:
    return tuple(it.strip() for it in words.split(",") if it.strip()) if words else ()


def _size(words: str | None) -> tuple[int, int] | None:
    if words is None:
        return None
    sides = words.replace("x", ",").split(",")
    if len(sides) != 2 or not all(it.strip().isdecimal() and len(it) < 7 for it in sides):
        raise DataError(
            f"--resolution is {words[:40]!r}; width and height are needed, as 1280,800.",
            culprits=["--resolution"],
        )
    return int(sides[0]), int(sides[1])


def _reread(foreign: Foreign, *, yes: bool) -> Foreign:
    with shown_progress(quiet=False) as told:
        guess = guess_foreign(foreign, progress=told)
    return reread(foreign, _confirmed(guess, yes=yes))


def _reread_session(session: Session, *, yes: bool) -> Session:
    with shown_progress(quiet=False) as told:
        guess = guess_session(session, progress=told)
    return reread_session(session, _confirmed(guess, yes=yes))


def _confirmed(guess: Guess, *, yes: bool) -> Candidate:
    """Prints the readings and takes the one that is clearly right, or that the user confirms."""
    print_guess(guess)
    first = guess.candidates[0]
    if first is guess.declared or (yes and guess.stands_out):
        return guess.best
    if not yes and sys.stdin.isatty():
        if typer.confirm(f"Read them so: {first.words}?", err=True):
            return first
        raise DataError("Nothing was written: the reading was declined.")
    raise DataError(
        "Nothing was written: another reading closes the chain better than the declared one"
        + ("." if guess.stands_out else ", but it does not stand out clearly."),
        culprits=[first.words],
        next_step="Take it with --yes."
        if guess.stands_out
        else "Say which it is with --robot-form, --robot-unit, --robot-inverse and --mount.",
    )
