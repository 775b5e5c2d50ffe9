"""`visioncal calibrate`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.options import AsJson, NeedOptions, OutFolder, WorkOptions
from visioncal.core.choices import Convention, SolverName

if TYPE_CHECKING:
    from visioncal.session import Session


def calibrate_command(
    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION...",
            help="A session's folder, or its .rrd recording; several with --robot-shared.",
        ),
    ],
    need: NeedOptions,
    work: WorkOptions,
    out: OutFolder = Path("out"),
    views: Annotated[
        str | None,
        typer.Option(
            metavar="1-12,14", help="These views alone, as those before or after something moved."
        ),
    ] = None,
    solver: Annotated[
        SolverName,
        typer.Option(help="The joint fit, or a closed form by name; all are compared anyway."),
    ] = "joint",
    level: Annotated[
        str,
        typer.Option(
            metavar="auto|hand-eye|offsets|kinematics|elastic|thermal",
            help="What is calibrated of the arm: hand-eye (nothing), offsets (of its joints), "
            "kinematics, elastic (bending joints, too), thermal (drift with temperature, too).",
        ),
    ] = "auto",
    convention: Annotated[
        Convention | None,
        typer.Option(
            help="Convention of the arm's joint table in the result; by default the stated one."
        ),
    ] = None,
    robot_shared: Annotated[
        bool,
        typer.Option(
            "--robot-shared",
            help="Several sessions of one arm, each with a camera and a board of its own: the arm "
            "is calibrated from all of them.",
        ),
    ] = False,
    corrected: Annotated[
        bool,
        typer.Option(
            "--corrected",
            help="Targets are corrected for the calibrated arm (visioncal correct) before they are "
            "sent; else the verdict is about picks by the controller's own poses.",
        ),
    ] = False,
    dense: Annotated[
        bool,
        typer.Option(
            "--dense",
            help="Fit the board to all pixels of images that are too blurred, by focus or motion, "
            "for the corners to be found.",
        ),
    ] = False,
    as_json: AsJson = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Also show every solver's result.")
    ] = False,
) -> None:
    """Turn a session into a hand-eye calibration, with reasons to trust it or not.

    Writes calibration.json, report.html and recording.rrd. Tools and fixtures that had joined an
    earlier result there are kept in frames.json. Exit status 0: there is a result to use, good or
    check; 3: there is one, and its verdict is bad; 2: the input or the motion cannot give one, and
    an existing folder stays as it was; 1: drawing the report or the recording failed, and
    calibration.json is there. Several cameras or robots are
    solved together, in one frame; other commands take one of each out of that result (--camera,
    --robot, --target).
    """
    # Imported late, so that --help stays fast.

    from visioncal.calibration.pipeline import run
    from visioncal.calibration.pipeline.running import CalibrationOptions
    from visioncal.cli.console import exit_status, report_written, say, with_run_paths
    from visioncal.cli.parsing import views_in
    from visioncal.cli.progress import shown_progress
    from visioncal.cli.summary import print_summary
    from visioncal.interchange.outputs import RECORDING, write_outputs
    from visioncal.interchange.result_files import frames_to_keep

    # Of several sessions, the recording is that of the joined session.
    session = sessions[0] if len(sessions) == 1 else out / RECORDING
    with with_run_paths(session, out):
        loaded = _joined(
            [need.session(session, corrected=corrected) for session in sessions],
            shared=robot_shared,
        )
        if views is not None:
            loaded = loaded.only(views_in(views, "--views"))
    asked = CalibrationOptions(
        solver=solver,
        level=level,
        convention=convention,
        threads=work.threads,
        dense=dense,
        pictures=work.images == "thumbnail" and not work.no_recording,
    )
    left = frames_to_keep(out)
    with with_run_paths(session, out), shown_progress(quiet=as_json) as progress:
        result = run(loaded, **(asked | {"progress": progress}))
        progress("write", 0, 1)
        result = result.with_paths(session, out)
        if left is not None:
            left.keep()
        written = write_outputs(out, loaded, result, without=work.left_out, images=work.images)
    if as_json:
        typer.echo(result.calibration.text)
    else:
        print_summary(result.calibration, verbose=verbose)
    if left is not None:
        say(left.words)
    report_written(written, quiet=as_json, status=exit_status(result.calibration.verdict))


def _joined(sessions: Sequence["Session"], *, shared: bool) -> "Session":
    from visioncal.core.errors import DataError
    from visioncal.session.shared_arm import join_sessions

    if len(sessions) == 1 or shared:
        return join_sessions(sessions)
    raise DataError(
        f"{len(sessions)} sessions are given, and one is calibrated at a time.",
        culprits=[session.name for session in sessions],
        next_step="visioncal batch calibrates each by itself; --robot-shared one arm from all.",
    )
