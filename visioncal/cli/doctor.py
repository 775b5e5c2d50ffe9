"""`visioncal doctor`."""

import typer

from visioncal.calibration.pipeline.checkup import doctor, to_document
from visioncal.cli.console import EXIT_BAD, answer, print_json, with_run_paths
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import DoctorOptions
from visioncal.core.verdict import CALIBRATE, with_paths


def doctor_command(options: DoctorOptions) -> None:
    """Runs `visioncal doctor`."""
    with with_run_paths(options.session), shown_progress(quiet=options.as_json) as progress:
        found = doctor(options.session, progress=progress)
    if options.as_json:
        print_json(to_document(found))
    else:
        answer(f"{found.session}: {'; '.join(found.seen)}")
        for at, finding in enumerate(found.findings, 1):
            answer(f" {finding.words}", f"{at}.")
            if finding.do is not None:
                answer(f"   {finding.do.words}")
                if finding.do.command:
                    answer("", f"   {finding.do.command}")
        if found.is_sound:
            command = with_paths(CALIBRATE, options.session, "out")
            answer(f" Next: {command}", "Nothing is wrong.", "bold green")
    if not found.is_sound:
        raise typer.Exit(EXIT_BAD)
