"""`visioncal doctor`."""

import typer
from rich.markup import escape

from visioncal.calibration.pipeline.checkup import doctor, next_command, to_document
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
        console = answers()
        console.print(escape(f"{found.session}: {'; '.join(found.seen)}"))
        for at, finding in enumerate(found.findings, 1):
            console.print(f"[bold]{at}.[/] {escape(finding.words)}")
            if finding.do is not None:
                console.print(escape(f"   {finding.do.words}"))
                if finding.do.command:
                    console.print(f"   [bold]{escape(finding.do.command)}[/]")
        if found.is_sound:
            command = next_command(found, options.session)
            console.print(f"[bold green]Nothing is wrong.[/] Next: [bold]{escape(command)}[/]")
    if not found.is_sound:
        raise typer.Exit(EXIT_BAD)
