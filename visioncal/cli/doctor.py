"""`visioncal doctor`."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape

from visioncal.cli.console import EXIT_BAD, answers, print_json, with_run_paths
from visioncal.cli.options import AsJson, SessionArgument
from visioncal.cli.progress import shown_progress

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.calibration.pipeline.checkup import Checkup


def doctor_command(session: SessionArgument, as_json: AsJson = False) -> None:
    """Say what is wrong with a session before it is calibrated, and what to type.

    Checks files, pairing, units, conventions of the poses, the board, blur, coverage, motion and
    clocks, in seconds, as nothing is solved. Exit status 0: nothing is wrong; 3: something is; 2:
    it cannot be read.
    """
    from visioncal.calibration.pipeline.checkup import doctor, to_document

    with with_run_paths(session), shown_progress(quiet=as_json) as progress:
        found = doctor(session, progress=progress)
    if as_json:
        print_json(to_document(found))
    else:
        _print(found, session)
    if not found.is_sound:
        raise typer.Exit(EXIT_BAD)


def _print(checkup: "Checkup", session: Path) -> None:
    from visioncal.calibration.pipeline.checkup import next_command

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
