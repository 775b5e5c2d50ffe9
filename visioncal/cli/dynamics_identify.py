"""`visioncal dynamics identify`."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from visioncal.cli.console import answers, messages, report_written
from visioncal.cli.dynamics_options import MotionsArgument, StreamOptions
from visioncal.cli.options import AsJson
from visioncal.cli.summary import print_verdict
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.dynamics.document import stribeck_rows, to_document
from visioncal.dynamics.friction import FrictionTerms
from visioncal.dynamics.identified import CLASSES, FILE, UNKNOWN, Identified
from visioncal.dynamics.identify import SLOW_RAD_S, Options
from visioncal.dynamics.judge import judge
from visioncal.dynamics.run import identify_session
from visioncal.interchange.outputs import write_dynamics
from visioncal.session import Session

_FRICTION = ("coulomb", "viscous", "offset")


def dynamics_identify_command(
    session: MotionsArgument,
    streams: StreamOptions,
    validate_on: Annotated[
        str | None,
        typer.Option(help="A stream to predict. Default: the last 30 % of the fastest motion."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", file_okay=False, help=f"A folder for {FILE}, report and recording."
        ),
    ] = None,
    friction: Annotated[
        str,
        typer.Option(help=f"What joints have of their own: {', '.join(_FRICTION)}; or none."),
    ] = "coulomb,viscous,offset",
    rotors: Annotated[
        bool | None,
        typer.Option(
            "--rotors/--no-rotors",
            help="Motors' inertia in the torques, or none in those of sensors behind the gears. "
            "Default: as unseen torques have it.",
        ),
    ] = None,
    stribeck: Annotated[
        bool, typer.Option("--stribeck/--no-stribeck", help="Look for humps of dry friction.")
    ] = True,
    unchecked: Annotated[
        bool,
        typer.Option("--unchecked", help="Take torques that contradict the robot's inertias."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Identify an arm's inertias and friction from the torques of its motions.

    Exit status 0: there is a result, with a verdict; 2: there is none, for the reason given.
    """
    options = Options(terms=_terms(friction), stribeck=stribeck, checked=not unchecked)
    request = replace(
        streams.request(), validate_on=validate_on or "", options=options, rotors=rotors
    )
    run = identify_session(Session.load(session), request)
    identified = run.identified
    written = None if output is None else write_dynamics(output, run)
    if as_json:
        typer.echo(json.dumps(to_document(identified), indent=2, allow_nan=False))
    else:
        _report(identified, () if run.predicted is None else run.predicted.notes)
    if written is not None:
        report_written(written, quiet=as_json)
    elif not as_json:
        messages().print("nothing was written: -o names a folder for it")


def _terms(words: str) -> FrictionTerms:
    """The terms of friction that the user names.

    Raises:
        DataError: There is no such term.
    """
    names = [] if words == "none" else [it.strip() for it in words.split(",")]
    wrong = [it for it in names if it not in _FRICTION]
    if wrong:
        raise DataError(
            f"--friction names {', '.join(wrong)}; the terms are {', '.join(_FRICTION)}, or none.",
            culprits=["--friction"],
        )
    coulomb, viscous, offset = (it in names for it in _FRICTION)
    return FrictionTerms(coulomb, viscous, offset, slow_rad_s=SLOW_RAD_S)


def _report(identified: Identified, proof: Sequence[str]) -> None:
    """Prints the verdict, what was fitted, and what was found in the samples of the proof."""
    console = answers()
    print_verdict(judge(identified), f"dynamics of {identified.robot.name}")
    for stream in identified.streams:
        left = f", {stream.left_out} torques left out" if stream.left_out else ""
        console.print(
            escape(
                f"{stream.label}: {stream.samples} samples at {figure(2 * stream.cutoff_hz)} Hz of "
                f"a motion up to {figure(stream.band_hz)} Hz{left}"
            )
        )
        for note in stream.notes:
            console.print(f"  - {escape(note)}")
    fitted = {note for stream in identified.streams for note in stream.notes}
    for note in (it for it in proof if it not in fitted):
        console.print(f"  - {escape(note)}")
    counts = [(word, identified.determined.count(word)) for _, word in CLASSES]
    shares = ", ".join(f"{count} to {word}" for word, count in counts[:-1])
    console.print(
        f"{identified.base.rank} base parameters: {shares}, {counts[-1][1]} {counts[-1][0]}, "
        f"{identified.determined.count(UNKNOWN)} {UNKNOWN}"
    )
    console.print(_joint_table(identified))
    console.print("in N m, N m s/rad, kg m^2 and rad/s; before: with the robot's own inertias")


def _joint_table(identified: Identified) -> Table:
    """What each joint's torques and friction came to."""
    names = [identified.base.model.names[it] for it in identified.base.independent]
    values = dict(zip(names, identified.values.tolist(), strict=True))
    humps = {row["joint"]: row for row in stribeck_rows(identified)}
    joints = range(1, identified.robot.joint_count + 1)
    columns: dict[str, list[float | None]] = {"fitted": [*identified.fitted_rms_nm]}
    validation = identified.validation
    if validation is not None:
        columns["predicted"] = [*validation.rms_nm]
        columns["of range, %"] = [*(100.0 * validation.shares)]
        if validation.known_rms_nm is not None:
            columns["before"] = [*validation.known_rms_nm]
    for symbol in ("Fc", "Fv", "Ia"):
        columns[symbol] = [values.get(f"{symbol}{it}") for it in joints]
    columns["Fs/Fc"] = [humps.get(it, {}).get("static_over_coulomb") for it in joints]
    columns["vs"] = [humps.get(it, {}).get("speed_rad_s") for it in joints]
    known = {name: it for name, it in columns.items() if any(value is not None for value in it)}
    table = Table("joint", *known, box=None)
    for at, joint in enumerate(joints):
        row = [None if it[at] is None else figure(float(it[at] or 0.0)) for it in known.values()]
        table.add_row(str(joint), *row)
    return table
