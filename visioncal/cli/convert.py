"""`visioncal convert`."""

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import messages, say
from visioncal.cli.options import Force
from visioncal.cli.parsing import pair_in, size_in
from visioncal.cli.pose_options import UNITS, RobotPoseOptions, names_in, poses_option
from visioncal.cli.progress import shown_progress
from visioncal.core.choices import FOREIGN_NAMES, CameraMount
from visioncal.core.errors import DataError

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.calibration.guess import Candidate, Guess
    from visioncal.interchange.formats import DoubtfulSession, ForeignRecording, ImportOptions

_FORMATS = ", ".join(FOREIGN_NAMES)
_other = partial(typer.Option, rich_help_panel="The recording itself")
_camera = partial(typer.Option, rich_help_panel="Its camera")
_doubt = partial(typer.Option, rich_help_panel="Poses that may be misread, of a session as well")


@dataclass(frozen=True)
class ConvertOptions(RobotPoseOptions):
    """Options for a foreign recording."""

    form: Annotated[str | None, _other("--from", help=f"Its format, by name: {_FORMATS}.")] = None
    mount: Annotated[CameraMount | None, _other(help="Where the camera is.")] = None
    target: Annotated[
        str | None,
        _other(
            help="A name in targets/, a .toml, or in one word as checkerboard_9x6_23.6mm, "
            "charuco_5x7_36.2mm_18.3mm_DICT_6X6_250, marker_DICT_4X4_50_10_48mm."
        ),
    ] = None
    tip: Annotated[str | None, _other(help="The frame that the poses are of.")] = None
    camera_columns: Annotated[
        str | None,
        poses_option(
            "--camera-columns",
            "--camera-key",
            help="Columns or keys of measured poses of the target: rvec,tvec.",
        ),
    ] = None
    camera_form: Annotated[str | None, poses_option(help="As --robot-form.")] = None
    camera_unit: Annotated[
        str | None, poses_option(metavar=UNITS, help="Unit of their positions.")
    ] = None
    camera_inverse: Annotated[
        bool | None,
        poses_option("--camera-inverse/--camera-as-is", help="They give the camera in the target."),
    ] = None
    camera_file: Annotated[
        Path | None,
        poses_option(
            help="A second file with the camera's poses; with times in both, the clocks' offset is "
            "found."
        ),
    ] = None
    images: Annotated[
        Path | None,
        _camera(help="The folder of the images; matched by name, by number, or in order."),
    ] = None
    image_column: Annotated[
        str | None,
        _camera(
            "--image-column", "--image-key", help="The column or key that names each row's image."
        ),
    ] = None
    corners: Annotated[
        Path | None,
        _camera(
            help="A file with the corners that another program found: mrcal's .vnl or another "
            "table, OpenCV's image_points, or lists by image in JSON, YAML or .npz."
        ),
    ] = None
    intrinsics: Annotated[
        str | None,
        _camera(
            help="A file (ROS, OpenCV, Kalibr, ViSP, .npz, .json), or `estimate` to ignore those "
            "of the source."
        ),
    ] = None
    resolution: Annotated[
        str | None, _camera(help="WIDTH,HEIGHT that the intrinsics hold for.")
    ] = None

    def requested(self) -> "ImportOptions":
        """The import options.

        Raises:
            DataError: Names or a resolution are malformed.
        """
        from visioncal.interchange.formats import PoseImportOptions

        columns = names_in(self.camera_columns, "--camera-columns")
        return replace(
            super().requested(),
            camera=PoseImportOptions(
                columns, self.camera_form, self.camera_unit, self.camera_inverse
            ),
            image=self.image_column,
            camera_file=self.camera_file,
            mount=self.mount,
            target=self.target,
            intrinsics=self.intrinsics,
            images=self.images,
            corners=self.corners,
            resolution=None if self.resolution is None else size_in(self.resolution),
            tip=self.tip,
        )


def convert_command(
    source: Annotated[
        Path,
        typer.Argument(help="A session's folder, its .rrd, or somebody else's file or folder."),
    ],
    dest: Annotated[Path, typer.Argument(help="An .rrd, or the folder to write.")],
    written: ConvertOptions,
    force: Force = False,
    guess: Annotated[
        bool, _doubt("--guess", help="Try other readings of the poses, and ask.")
    ] = False,
    yes: Annotated[
        bool, _doubt("--yes", help="Take the best one where it stands out clearly.")
    ] = False,
    mirror_poses: Annotated[
        bool,
        _doubt("--mirror-poses", help="Mirror the robot's poses where its frame is left-handed."),
    ] = False,
    exchange: Annotated[
        str | None,
        _doubt("--exchange", help="Two views whose images are exchanged, by number: 8,17."),
    ] = None,
) -> None:
    """Write a session as a folder or a recording, or make one of another program's.

    Between our own forms nothing is lost, which digests prove. Exit status 0: it is written; 2:
    nothing was written, and the message says what is missing or wrong.
    """
    from visioncal.interchange.formats import convert

    requested, form = written.requested(), written.form
    if yes and not guess:
        raise DataError("--yes takes the best guess; it needs --guess.", culprits=["--yes"])
    if mirror_poses and not guess:
        words = "--mirror-poses is for what a guess finds; it needs --guess."
        raise DataError(words, culprits=["--mirror-poses"])
    choose = partial(_chosen, yes=yes) if guess else None
    session = convert(
        source,
        dest,
        requested=requested,
        form=form,
        force=force,
        choose=choose,
        mirrors_poses=mirror_poses,
        exchange=None if exchange is None else pair_in(exchange, "--exchange"),
    )
    for warning in session.warnings:
        say(f"note: {warning}")
    say(f"wrote {dest}\nsha256 {session.digest()}")


def _chosen(recorded: "DoubtfulSession | ForeignRecording", *, yes: bool) -> "Candidate":
    """Tries other readings, prints them, and returns the clearly best or confirmed one."""
    from visioncal.calibration.pipeline.guess_inputs import guess_session
    from visioncal.interchange.formats import ForeignRecording, guess_foreign

    with shown_progress(quiet=False) as progress:
        if isinstance(recorded, ForeignRecording):
            guess = guess_foreign(recorded, progress=progress)
        else:
            guess = guess_session(recorded.session, recorded.robot, progress=progress)
    _print_guess(guess)
    return _confirmed(guess, yes=yes)


def _confirmed(guess: "Guess", *, yes: bool) -> "Candidate":
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


def _print_guess(guess: "Guess") -> None:
    """Prints the readings, the best first, the conclusion, and what remains ambiguous."""
    from rich.table import Table

    console = messages()
    table = Table("reading", "chain closes to", "views that agree", box=None, pad_edge=False)
    for candidate in guess.candidates:
        cells = (candidate.words, candidate.figures, f"{candidate.agreeing} of {candidate.rows}")
        table.add_row(*map(escape, cells), style="bold green" if candidate is guess.best else "")
    console.print(table)
    console.print(escape(guess.sentence))
    for note in guess.notes:
        console.print(escape(f"note: {note}"))
