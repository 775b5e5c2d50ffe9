"""`visioncal convert`."""

import sys
from functools import partial

import typer
from rich.markup import escape

from visioncal.calibration.guess import Candidate, Guess
from visioncal.calibration.pipeline.guess_inputs import guess_session
from visioncal.cli import convert_options as option
from visioncal.cli.console import messages
from visioncal.cli.guessed import print_guess
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.interchange.formats import (
    Foreign,
    ImportOptions,
    PoseImportOptions,
    convert,
    guess_foreign,
)
from visioncal.session import Session


def convert_command(
    source: option.Source,
    dest: option.Dest,
    force: option.Force = False,
    form: option.Form = None,
    mount: option.MountOption = None,
    target: option.Target = None,
    robot_model: option.RobotModel = None,
    tip: option.Tip = None,
    robot_columns: option.RobotColumns = None,
    robot_form: option.RobotForm = None,
    robot_unit: option.RobotUnit = None,
    robot_inverse: option.RobotInverse = None,
    camera_columns: option.CameraColumns = None,
    camera_form: option.CameraForm = None,
    camera_unit: option.CameraUnit = None,
    camera_inverse: option.CameraInverse = None,
    camera_file: option.CameraFile = None,
    joint_columns: option.JointColumns = None,
    joint_unit: option.JointUnit = "rad",
    images: option.Images = None,
    image_column: option.ImageColumn = None,
    intrinsics: option.Intrinsics = None,
    resolution: option.Resolution = None,
    guess: option.TryOthers = False,
    yes: option.TakeBest = False,
) -> None:
    """Write a session as a folder or a recording, or make one of another program's.

    Between our own forms nothing is lost, which digests prove. Exit status 0: it is written; 2:
    nothing was written, and the message says what is missing or wrong.
    """
    robot_names = option.names_in(robot_columns, "--robot-columns")
    camera_names = option.names_in(camera_columns, "--camera-columns")
    requested = ImportOptions(
        robot=PoseImportOptions(robot_names, robot_form, robot_unit, robot_inverse),
        camera=PoseImportOptions(camera_names, camera_form, camera_unit, camera_inverse),
        joints=option.names_in(joint_columns, "--joint-columns"),
        joints_deg=joint_unit == "deg",
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
    choose = partial(_chosen, yes=yes) if guess else None
    session = convert(source, dest, requested=requested, form=form, force=force, choose=choose)
    for warning in session.warnings:
        messages().print(escape(f"note: {warning}"))
    messages().print(escape(f"wrote {dest}\nsha256 {session.digest()}"))


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


def _chosen(recorded: Session | Foreign, *, yes: bool) -> Candidate:
    """Tries other readings, prints them, and takes the one that is clearly right or confirmed."""
    with shown_progress(quiet=False) as told:
        if isinstance(recorded, Foreign):
            guess = guess_foreign(recorded, progress=told)
        else:
            guess = guess_session(recorded, progress=told)
    print_guess(guess)
    return _confirmed(guess, yes=yes)


def _confirmed(guess: Guess, *, yes: bool) -> Candidate:
    if not guess.stands_out:
        if guess.declared.closes:
            return guess.declared
        raise DataError(
            "Nothing was written: the chain does not close as declared, and no other reading "
            "stands out.",
            next_step="Check that the poses and what the camera saw are of the same views and the "
            "same robot; without --guess it is written as declared.",
        )
    if yes:
        return guess.best
    if not sys.stdin.isatty():
        raise DataError(
            "Nothing was written: another reading closes the chain better than the declared one.",
            culprits=[guess.best.words],
            next_step="Take it with --yes.",
        )
    try:
        agreed = typer.confirm(f"Read them so: {guess.best.words}?", err=True)
    except typer.Abort as error:
        raise DataError(
            "Nothing was written: there was no answer.", next_step="Take the reading with --yes."
        ) from error
    if not agreed:
        raise DataError("Nothing was written: the reading was declined.")
    return guess.best
