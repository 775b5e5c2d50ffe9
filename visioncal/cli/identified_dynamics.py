"""Identifies, validates, writes and reports dynamics, for `visioncal dynamics`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from visioncal.cli.console import answers, exit_status, print_json, report_written, say
from visioncal.cli.dynamics import StreamOptions, friction_terms, identified_of
from visioncal.cli.dynamics_identify import FRICTION, IdentifyOptions
from visioncal.cli.summary import print_verdict
from visioncal.core.number_format import figure
from visioncal.dynamics.document import stribeck_rows, to_document
from visioncal.dynamics.identified import CLASSES, UNKNOWN, Identified
from visioncal.dynamics.identify import SLOW_RAD_S, Options
from visioncal.dynamics.judge import judge
from visioncal.dynamics.run import identify_session, validate_session
from visioncal.dynamics.validate import Prediction, validate
from visioncal.interchange.outputs import Written, write_dynamics
from visioncal.session import Session


def identify_into(options: IdentifyOptions) -> None:
    """Identifies the dynamics from a session's streams, and writes and reports them.

    Raises:
        DataError: The session cannot be read, its streams determine nothing, or there is no such
            friction term.
    """
    request = replace(
        options.streams.request(),
        validate_on=options.validate_on or "",
        rotors=options.rotors,
        options=Options(
            terms=replace(friction_terms(options.friction, FRICTION), slow_rad_s=SLOW_RAD_S),
            stribeck=options.stribeck,
            checked=not options.unchecked,
        ),
    )
    run = identify_session(Session.load(options.session), request)
    identified = run.identified
    written = Written(()) if options.output is None else write_dynamics(options.output, run)
    if options.as_json:
        print_json(to_document(identified))
    else:
        _report(identified, () if run.predicted is None else run.predicted.notes)
    if options.output is None and not options.as_json:
        say("nothing was written: -o names a folder for it")
    report_written(written, quiet=options.as_json, status=exit_status(judge(identified)))


def print_predictions(
    session: Path, streams: StreamOptions, against: Path | None, *, as_json: bool
) -> None:
    """Predicts the torques of a session's streams, and prints the prediction errors.

    Raises:
        DataError: There are no identified dynamics, or the streams cannot be predicted.
    """
    identified = identified_of(against, "validate")
    predictions = validate_session(Session.load(session), identified, streams.request())
    if as_json:
        print_json([_figures(prediction) for prediction in predictions])
        return
    for prediction in predictions:
        answers().print(escape("\n".join([prediction.label, *prediction.notes])))
        _report_prediction(identified, prediction)


def _report(identified: Identified, validation_notes: Sequence[str]) -> None:
    """Prints the verdict, the fit, and the notes on the validation samples."""
    console = answers()
    print_verdict(judge(identified), f"dynamics of {identified.robot.name}")
    for stream in identified.streams:
        left_out = f", {stream.left_out} torques left out" if stream.left_out else ""
        console.print(
            escape(
                f"{stream.label}: {stream.samples} samples at {figure(2 * stream.cutoff_hz)} Hz of "
                f"a motion up to {figure(stream.band_hz)} Hz{left_out}"
            )
        )
        for note in stream.notes:
            console.print(f"  - {escape(note)}")
    fitted = {note for stream in identified.streams for note in stream.notes}
    for note in (name for name in validation_notes if name not in fitted):
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
    """Table of torque errors and friction by joint."""
    names = [identified.base.model.names[index] for index in identified.base.independent]
    values = dict(zip(names, identified.values.tolist(), strict=True))
    stribeck = {row["joint"]: row for row in stribeck_rows(identified)}
    joints = range(1, identified.robot.joint_count + 1)
    columns: dict[str, list[float | None]] = {"fitted": [*identified.fitted_rms_nm]}
    validation = identified.validation
    if validation is not None:
        columns["predicted"] = [*validation.rms_nm]
        columns["of range, %"] = [*(100.0 * validation.shares)]
        if validation.known_rms_nm is not None:
            columns["before"] = [*validation.known_rms_nm]
    for symbol in ("Fc", "Fv", "Ia"):
        columns[symbol] = [values.get(f"{symbol}{joint}") for joint in joints]
    columns["Fs/Fc"] = [stribeck.get(joint, {}).get("static_over_coulomb") for joint in joints]
    columns["vs"] = [stribeck.get(joint, {}).get("speed_rad_s") for joint in joints]
    filled = {
        name: column
        for name, column in columns.items()
        if any(value is not None for value in column)
    }
    table = Table("joint", *filled, box=None)
    for at, joint in enumerate(joints):
        row = [
            None if group[at] is None else figure(float(group[at] or 0.0))
            for group in filled.values()
        ]
        table.add_row(str(joint), *row)
    return table


def _report_prediction(identified: Identified, prediction: Prediction) -> None:
    validation = validate(identified, prediction)
    fitted = identified.fitted_rms_nm
    table = Table("joint", "predicted to [N m]", "of its range", "fitted to [N m]", box=None)
    for joint, name in enumerate(identified.robot.joint_names):
        table.add_row(
            name,
            figure(float(validation.rms_nm[joint])),
            f"{figure(100.0 * float(validation.shares[joint]))} %",
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
