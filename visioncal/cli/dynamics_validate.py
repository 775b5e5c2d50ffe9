"""`visioncal dynamics validate`."""

import json
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from visioncal.cli.choosing import RobotName
from visioncal.cli.console import messages
from visioncal.cli.dynamics_options import (
    AgainstOption,
    CutoffOption,
    GainsOption,
    SessionArgument,
    StreamOption,
    identified_of,
    number_list,
)
from visioncal.core.number_format import figure
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.run import Request, validate_session
from visioncal.dynamics.validate import Prediction, validate
from visioncal.session import Session


def dynamics_validate_command(
    session: SessionArgument,
    against: AgainstOption = None,
    stream: StreamOption = None,
    cutoff_hz: CutoffOption = None,
    gains: GainsOption = None,
    robot: RobotName = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print figures as JSON.")] = False,
) -> None:
    """Predict the torques of other motions, and say how near that comes.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """
    identified = identified_of(against, "validate")
    request = Request(
        tuple(stream or ()), "", cutoff_hz, number_list(gains, "--gains"), robot=robot
    )
    predictions = validate_session(Session.load(session), identified, request)
    if as_json:
        typer.echo(json.dumps([_figures(it) for it in predictions], indent=2))
        return
    for prediction in predictions:
        messages().print(escape(prediction.label))
        _tell_prediction(identified, prediction)


def _tell_prediction(identified: Identified, prediction: Prediction) -> None:
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
    messages().print(table)


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
