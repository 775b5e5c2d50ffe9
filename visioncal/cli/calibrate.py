"""`visioncal calibrate`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from visioncal.calibration import to_document
from visioncal.cli.console import messages, print_summary, shown_progress
from visioncal.outputs import write_outputs
from visioncal.pipeline import run
from visioncal.session import Session
from visioncal.types import SolverName


def calibrate_command(
    session: Annotated[Path, typer.Argument(help="A session's folder, or its .rrd recording.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the result, report and recording.")
    ] = Path("out"),
    solver: Annotated[
        SolverName,
        typer.Option(help="The joint fit, or a closed form by name; all are compared anyway."),
    ] = "joint",
    as_json: Annotated[
        bool, typer.Option("--json", help="Print calibration.json to stdout.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Also show every solver's result.")
    ] = False,
) -> None:
    """Turn a session into a hand-eye calibration, with reasons to trust it or not.

    Writes calibration.json, report.html and recording.rrd. Exit status 0: there is a result, with
    a verdict; 2: the input or the motion cannot give one, and an existing folder stays as it was.
    """
    loaded = Session.load(session)
    with shown_progress(quiet=as_json) as told:
        result = run(loaded, solver=solver, progress=told)
        told("write", 0, 1)
        files = write_outputs(out, loaded, result)
    if as_json:
        typer.echo(json.dumps(to_document(result.calibration), indent=2))
        return
    print_summary(result.calibration, verbose=verbose)
    for file in files:
        messages().print(f"wrote {file}")
