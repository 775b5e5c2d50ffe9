"""`visioncal dynamics identify`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.dynamics import MotionsArgument, StreamOptions
from visioncal.cli.options import AsJson
from visioncal.core.choices import DYNAMICS_FILE

FRICTION = ("coulomb", "viscous", "offset")


@dataclass(frozen=True)
class IdentifyOptions:
    """What is identified, and where it is written."""

    session: MotionsArgument
    streams: StreamOptions
    validate_on: Annotated[
        str | None,
        typer.Option(help="A stream to predict. Default: the last 30 % of the fastest motion."),
    ] = None
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            file_okay=False,
            help=f"A folder for {DYNAMICS_FILE}, report and recording.",
        ),
    ] = None
    friction: Annotated[
        str, typer.Option(help=f"Friction terms of the joints: {', '.join(FRICTION)}; or none.")
    ] = "coulomb,viscous,offset"
    rotors: Annotated[
        bool | None,
        typer.Option(
            "--rotors/--no-rotors",
            help="Motors' inertia in the torques, or none in those of sensors behind the gears. "
            "Default: whichever predicts unseen torques better.",
        ),
    ] = None
    stribeck: Annotated[
        bool, typer.Option("--stribeck/--no-stribeck", help="Look for humps of dry friction.")
    ] = True
    unchecked: Annotated[
        bool, typer.Option("--unchecked", help="Take torques that contradict the robot's inertias.")
    ] = False
    as_json: AsJson = False


def dynamics_identify_command(options: IdentifyOptions) -> None:
    """Identify an arm's inertias and friction from the torques of its motions.

    Exit status 0: there is a result to use; 3: its verdict is bad; 2: there is none, for the reason
    given.
    """
    # Imported late, so that --help stays fast.
    from visioncal.cli.identified_dynamics import identify_into

    identify_into(options)
