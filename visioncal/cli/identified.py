"""The dynamics of `visioncal dynamics identify` and `validate`: found, written and reported."""

import json
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.markup import escape
from rich.table import Table

from visioncal.cli.console import answers, messages, report_written
from visioncal.cli.dynamics import StreamOptions, identified_of
from visioncal.cli.dynamics_identify import FRICTION
from visioncal.cli.summary import print_verdict
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.dynamics.document import stribeck_rows, to_document
from visioncal.dynamics.identified import CLASSES, UNKNOWN, Identified
from visioncal.dynamics.identify import SLOW_RAD_S, Options
from visioncal.dynamics.judge import judge
from visioncal.dynamics.model import FrictionTerms
from visioncal.dynamics.run import Request, identify_session, validate_session
from visioncal.dynamics.validate import Prediction, validate
from visioncal.interchange.outputs import write_dynamics
from visioncal.session import Session


def options_of(friction: str, *, stribeck: bool, checked: bool) -> Options:
    """How the dynamics are identified.

    Raises:
        DataError: There is no such term of friction.
    """
    return Options(terms=_terms(friction), stribeck=stribeck, checked=checked)


def identify_into(output: Path | None, session: Path, request: Request, *, as_json: bool) -> None:
    """Identifies the dynamics by a session's streams, writes them where asked, and reports them.

    Raises:
        DataError: The session cannot be read, or its streams determine nothing.
    """
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


def print_predictions(
    session: Path, streams: StreamOptions, against: Path | None, *, as_json: bool
) -> None:
    """Predicts the torques of a session's streams, and says how near that comes.

    Raises:
        DataError: Nothing was identified, or the streams cannot be predicted from.
    """
    identified = identified_of(against, "validate")
    predictions = validate_session(Session.load(session), identified, streams.request())
    if as_json:
        typer.echo(json.dumps([_figures(it) for it in predictions], indent=2))
        return
    for prediction in predictions:
        answers().print(escape("\n".join([prediction.label, *prediction.notes])))
        _report_prediction(identified, prediction)


def _terms(words: str) -> FrictionTerms:
    """The terms of friction that the user names."""
    names = [] if words == "none" else [it.strip() for it in words.split(",")]
    wrong = [it for it in names if it not in FRICTION]
    if wrong:
        raise DataError(
            f"--friction names {', '.join(wrong)}; the terms are {', '.join(FRICTION)}, or none.",
            culprits=["--friction"],
        )
    coulomb, viscous, offset = (it in names for it in FRICTION)
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


def _report_prediction(identified: Identified, prediction: Prediction) -> None:
    found = validate(identified, prediction)
    fitted = identified.fitted_rms_nm
    table = Table("joint", "predicted to [N m]", "of its range", "fitted to [N m]", box=None)
    for joint, name in enumerate(identified.robot.joint_names):
        table.add_row(
            name,
            figure(float(found.rms_nm[joint])),
            f"{figure(100.0 * float(found.shares[joint]))} %",
            figure(float(fitted[joint])),
        )
    answers().print(table)


def _figures(prediction: Prediction) -> dict[str, str | Sequence[float]]:
    rms_nm = prediction.rms_nm(prediction.predicted_nm)
    figures: dict[str, str | Sequence[float]] = {
        "stream": prediction.label,
        "rms_nm": rms_nm.tolist(),
        "torque_nm": prediction.torque_nm.tolist(),
    }
    if prediction.consistent_nm is not None:
        figures["consistent_rms_nm"] = prediction.rms_nm(prediction.consistent_nm).tolist()
    return figures
