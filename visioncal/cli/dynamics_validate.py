"""`visioncal dynamics validate`."""

import json
from collections.abc import Sequence

import typer
from rich.markup import escape
from rich.table import Table

from visioncal.cli.console import answers
from visioncal.cli.dynamics_options import (
    AgainstOption,
    MotionsArgument,
    StreamOptions,
    identified_of,
)
from visioncal.cli.options import AsJson
from visioncal.core.number_format import figure
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.run import validate_session
from visioncal.dynamics.validate import Prediction, validate
from visioncal.session import Session


def dynamics_validate_command(
    session: MotionsArgument,
    streams: StreamOptions,
    against: AgainstOption = None,
    as_json: AsJson = False,
) -> None:
    """Predict the torques of other motions, and say how near that comes.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """
    identified = identified_of(against, "validate")
    predictions = validate_session(Session.load(session), identified, streams.request())
    if as_json:
        typer.echo(json.dumps([_figures(it) for it in predictions], indent=2))
        return
    for prediction in predictions:
        answers().print(escape("\n".join([prediction.label, *prediction.notes])))
        _report_prediction(identified, prediction)


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
