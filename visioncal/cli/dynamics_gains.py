"""`visioncal dynamics gains`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.dynamics import CutoffOption, MotionsArgument
from visioncal.cli.options import AsJson, RobotName


@dataclass(frozen=True)
class GainsOptions:
    """Two sessions of an arm, one of them with a known body on the flange."""

    session: MotionsArgument
    loaded: Annotated[Path, typer.Option(help="A session of the same arm with the body on it.")]
    mass_kg: Annotated[float, typer.Option(help="Of the body (kg).")]
    com_mm: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="Its centre of mass in the flange's frame (mm).")
    ]
    inertia: Annotated[
        str,
        typer.Option(metavar="XX,XY,YY,XZ,YZ,ZZ", help="Its inertia about that centre (kg m^2)."),
    ] = "0,0,0,0,0,0"
    cutoff_hz: CutoffOption = None
    named: RobotName = None
    as_json: AsJson = False


def dynamics_gains_command(options: GainsOptions) -> None:
    """Find how much torque a drive's current makes, by a body that is known.

    Exit status 0: there are gains; 2: there are none, for the reason given.
    """
    # Imported late, so that --help stays fast.
    from visioncal.cli.payload_and_gains import print_gains

    print_gains(options)
