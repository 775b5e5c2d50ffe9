"""`visioncal calibrate`."""

import shlex
from dataclasses import replace
from pathlib import Path

import typer

from visioncal.calibration.pipeline.run_state import CalibrationOptions
from visioncal.calibration.run import Run, run
from visioncal.cli.console import exit_status, report_written, say, with_run_paths
from visioncal.cli.history import enter
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import CalibrateOptions
from visioncal.cli.summary import print_summary
from visioncal.core.errors import DataError
from visioncal.core.number_format import ranges
from visioncal.core.verdict import Remedy, need_options
from visioncal.interchange.outputs import RECORDING, REPORT, check_replaceable, write_outputs
from visioncal.interchange.result_files import frames_to_keep, load_calibration
from visioncal.results.history import entries_of
from visioncal.session import Session
from visioncal.vision.hard_matches import check_weights


def calibrate_command(options: CalibrateOptions) -> None:
    """Runs `visioncal calibrate`."""
    session = options.session
    with with_run_paths(session, options.out):
        loaded = Session.load(session).needing(
            options.need_mm, options.need_deg, corrected=options.corrected
        )
        if options.views is not None:
            loaded = loaded.only(options.views)
        # Before a fit that may take minutes; a calibration.json only once there is another one.
        check_replaceable(options.out, (REPORT, RECORDING))
    if options.against is not None:
        _calibrate_loaded(options, loaded, options.against)
        return
    settings = CalibrationOptions(
        solver=options.solver,
        level=options.level,
        convention=options.convention,
        threads=options.threads,
        dense=options.dense,
        pictures=options.images == "thumbnail" and not options.no_recording,
    )
    check_weights(options.weights)
    if options.weights is not None:
        loaded = loaded.with_weights(options.weights)
    left = frames_to_keep(options.out)
    with with_run_paths(session, options.out), shown_progress(quiet=options.as_json) as progress:
        result = run(loaded, **(settings | {"progress": progress}))
        progress("write", 0, 1)
        typed = need_options(options.need_mm, options.need_deg, corrected=options.corrected)
        if options.views is not None:
            # The others stay left out, unless a step names its own.
            typed += ("--views", ranges(options.views))
        result = result.with_paths(session, options.out, typed)
        if left is not None:
            left.keep()
        written = write_outputs(
            options.out, loaded, result, without=options.left_out, images=options.images
        )
    enter(options, session, entries_of(result.calibration), options.out)
    if options.as_json:
        typer.echo(result.calibration.text)
    else:
        print_summary(result.calibration, result.evidence, verbose=options.verbose)
    if left is not None:
        say(left.words)
    report_written(written, quiet=options.as_json, status=exit_status(result.calibration.verdict))


def _calibrate_loaded(options: CalibrateOptions, loaded: Session, against: Path) -> None:
    """Adds the stiffness of a loaded session to an earlier calibration, in another folder."""
    # Few sessions have loads.
    from visioncal.verification.loaded import calibrate_loaded

    if options.out.absolute() == (against if against.is_dir() else against.parent).absolute():
        raise DataError(
            f"-o {options.out} is the calibration of the unloaded arm itself.",
            culprits=["-o", "--against"],
            next_step="Name another folder with -o: the unloaded one stays for further loads.",
        )
    folder = (against if against.is_dir() else against.parent).absolute()
    stiff = calibrate_loaded(loaded, load_calibration(against))

    def renamed(do: Remedy) -> Remedy:
        # Steps with the unloaded result are taken with this one.
        parts = shlex.split(do.command, posix=False)
        paths = ["OUT" if Path(at.strip("'")).absolute() == folder else at for at in parts]
        return replace(do, command=" ".join(paths))

    findings = tuple(found.with_do(renamed) for found in stiff.verdict.findings)
    verdict = replace(stiff.verdict, findings=findings)
    result = Run(replace(stiff, verdict=verdict), ()).with_paths(options.session, options.out)
    written = write_outputs(options.out, None, result)
    enter(options, options.session, entries_of(result.calibration), options.out)
    if options.as_json:
        typer.echo(result.calibration.text)
    else:
        print_summary(result.calibration, result.evidence, verbose=options.verbose)
    report_written(written, quiet=options.as_json, status=exit_status(result.calibration.verdict))
