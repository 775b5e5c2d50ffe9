"""`visioncal doctor`."""

from pathlib import Path

import typer
from rich.markup import escape

from visioncal.calibration.pipeline.checkup import Checkup, doctor, next_command, to_document
from visioncal.cli.console import EXIT_BAD, answers, print_json, with_run_paths
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import DoctorOptions


def doctor_command(options: DoctorOptions) -> None:
    """Runs `visioncal doctor`."""
    with with_run_paths(options.session), shown_progress(quiet=options.as_json) as progress:
        found = doctor(options.session, progress=progress)
    if options.as_json:
        print_json(to_document(found))
    else:
        _print(found, options.session)
    if not found.is_sound:
        raise typer.Exit(EXIT_BAD)


def _print(checkup: Checkup, session: Path) -> None:

    console = answers()
    console.print(escape(f"{checkup.session}: {'; '.join(checkup.seen)}"))
    for at, finding in enumerate(checkup.findings, 1):
        console.print(f"[bold]{at}.[/] {escape(finding.words)}")
        if finding.do is not None:
            console.print(escape(f"   {finding.do.words}"))
            if finding.do.command:
                console.print(f"   [bold]{escape(finding.do.command)}[/]")
    if checkup.is_sound:
        command = next_command(checkup, session)
        console.print(f"[bold green]Nothing is wrong.[/] Next: [bold]{escape(command)}[/]")
