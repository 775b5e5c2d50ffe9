"""`visioncal calibrate`."""

import typer

from visioncal.calibration.pipeline.run_state import CalibrationOptions
from visioncal.calibration.run import run
from visioncal.cli.console import exit_status, report_written, say, with_run_paths
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import CalibrateOptions
from visioncal.cli.summary import print_summary
from visioncal.core.errors import DataError
from visioncal.interchange.outputs import RECORDING, write_outputs
from visioncal.interchange.result_files import frames_to_keep
from visioncal.session import Session
from visioncal.session.shared_arm import join_sessions


def calibrate_command(options: CalibrateOptions) -> None:
    """Runs `visioncal calibrate`."""
    # Of several sessions, the recording is that of the joined session.
    session = options.sessions[0] if len(options.sessions) == 1 else options.out / RECORDING
    with with_run_paths(session, options.out):
        loaded = _joined(options)
        if options.views is not None:
            loaded = loaded.only(options.views)
    asked = CalibrationOptions(
        solver=options.solver,
        level=options.level,
        convention=options.convention,
        threads=options.work.threads,
        dense=options.dense,
        pictures=options.work.images == "thumbnail" and not options.work.no_recording,
    )
    left = frames_to_keep(options.out)
    with with_run_paths(session, options.out), shown_progress(quiet=options.as_json) as progress:
        result = run(loaded, **(asked | {"progress": progress}))
        progress("write", 0, 1)
        result = result.with_paths(session, options.out)
        if left is not None:
            left.keep()
        written = write_outputs(
            options.out, loaded, result, without=options.work.left_out, images=options.work.images
        )
    if options.as_json:
        typer.echo(result.calibration.text)
    else:
        print_summary(result.calibration, verbose=options.verbose)
    if left is not None:
        say(left.words)
    report_written(written, quiet=options.as_json, status=exit_status(result.calibration.verdict))


def _joined(options: CalibrateOptions) -> Session:
    """The session, or several of one arm as one."""
    need = options.need
    sessions = [
        Session.load(path).needing(need.need_mm, need.need_deg, corrected=options.corrected)
        for path in options.sessions
    ]
    if len(sessions) == 1 or options.robot_shared:
        return join_sessions(sessions)
    raise DataError(
        f"{len(sessions)} sessions are given, and one is calibrated at a time.",
        culprits=[session.name for session in sessions],
        next_step="visioncal batch calibrates each by itself; --robot-shared one arm from all.",
    )
