"""`visioncal convert`."""

import sys
from dataclasses import replace
from functools import partial

import typer
from rich.markup import escape
from rich.table import Table

from visioncal.calibration.guess import Candidate
from visioncal.cli.console import messages, say
from visioncal.cli.parsing import names_in, pair_in, size_in
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import ConvertOptions, RobotPoseOptions
from visioncal.core.errors import DataError
from visioncal.interchange.formats import (
    DoubtfulSession,
    ImportOptions,
    PoseImportOptions,
    convert,
)


def convert_command(options: ConvertOptions) -> None:
    """Runs `visioncal convert`."""
    written = options.written
    camera_columns = names_in(written.camera_columns, "--camera-columns")
    requested = replace(
        import_options(written),
        camera=PoseImportOptions(
            camera_columns, written.camera_form, written.camera_unit, written.camera_inverse
        ),
        image=written.image_column,
        camera_file=written.camera_file,
        mount=written.mount,
        target=written.target,
        intrinsics=written.intrinsics,
        images=written.images,
        corners=written.corners,
        resolution=None if written.resolution is None else size_in(written.resolution),
        tip=written.tip,
    )
    if options.yes and not options.guess:
        raise DataError("--yes takes the best guess; it needs --guess.", culprits=["--yes"])
    if options.mirror_poses and not options.guess:
        words = "--mirror-poses is for what a guess finds; it needs --guess."
        raise DataError(words, culprits=["--mirror-poses"])
    choose = partial(_chosen, yes=options.yes) if options.guess else None
    session = convert(
        options.source,
        options.dest,
        requested=requested,
        form=written.form,
        force=options.force,
        choose=choose,
        mirrors_poses=options.mirror_poses,
        exchange=None if options.exchange is None else pair_in(options.exchange, "--exchange"),
    )
    for warning in session.warnings:
        say(f"note: {warning}")
    say(f"wrote {options.dest}\nsha256 {session.digest()}")


def import_options(poses: RobotPoseOptions) -> ImportOptions:
    """The import options of a robot's poses.

    Raises:
        DataError: A name is empty or occurs twice.
    """
    columns = names_in(poses.robot_columns, "--robot-columns")
    return ImportOptions(
        robot=PoseImportOptions(columns, poses.robot_form, poses.robot_unit, poses.robot_inverse),
        joints=names_in(poses.joint_columns, "--joint-columns"),
        joints_deg=poses.joint_unit == "deg",
        robot_model=poses.robot_model,
    )


def _chosen(recorded: DoubtfulSession, *, yes: bool) -> Candidate:
    """Tries other readings, prints them, and returns the clearly best or confirmed one."""
    with shown_progress(quiet=False) as progress:
        guess = recorded.guess(progress)
    console = messages()
    table = Table("reading", "chain closes to", "views that agree", box=None, pad_edge=False)
    for candidate in guess.candidates:
        cells = (candidate.words, candidate.figures, f"{candidate.agreeing} of {candidate.rows}")
        table.add_row(*map(escape, cells), style="bold green" if candidate is guess.best else "")
    console.print(table)
    console.print(escape(guess.sentence))
    for note in guess.notes:
        console.print(escape(f"note: {note}"))
    if not guess.stands_out:
        if guess.declared.closes:
            return guess.declared
        raise DataError(
            "Nothing was written: the chain does not close as declared, and no other reading "
            "stands out.",
            next_step="Check that the poses and what the camera saw are of the same views and the "
            "same robot, and that positions stand before rotations (where not, name the columns in "
            "that order: --robot-columns 4,5,6,1,2,3). Without --guess it is written as declared; "
            "visioncal doctor then looks for what happened midway.",
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
        is_confirmed = typer.confirm(f"Read them so: {guess.best.words}?", err=True)
    except typer.Abort as error:
        raise DataError(
            "Nothing was written: there was no answer.", next_step="Take the reading with --yes."
        ) from error
    if not is_confirmed:
        raise DataError("Nothing was written: the reading was declined.")
    return guess.best
