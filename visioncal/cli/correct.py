"""`visioncal correct`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.options import AsJson, ForceBoth, OutFile, PartOptions
from visioncal.core.choices import WIDEST_RAD


@dataclass(frozen=True)
class CorrectOptions:
    """Options of the targets, their frame, and the arm's payload and temperature."""

    targets: Annotated[
        Path,
        typer.Argument(
            help="A table with the columns of views.csv: x_m, y_m, z_m, qx, qy, qz, qw of "
            "base_from_flange; q1_rad ... may say which posture is meant; others are kept."
        ),
    ]
    calibration: Annotated[
        Path,
        typer.Option(
            "-c",
            "--against",
            "--calibration",
            help="Of the calibrated arm: an output folder of calibrate, or its .rrd.",
        ),
    ]
    part: PartOptions
    out: OutFile = None
    tool: Annotated[
        str | None,
        typer.Option(
            help="Frame of the targets and of the corrected ones: a tool of the calibration, or "
            "cam; by default the flange."
        ),
    ] = None
    seed_joints: Annotated[
        str | None,
        typer.Option(
            metavar="Q1,Q2,...",
            help="Joint angles near which the first target is reached, in radians; else the "
            "middle of the joints' limits. Each further target is reached near to the one before.",
        ),
    ] = None
    payload_kg: Annotated[
        float, typer.Option(help="Payload on the flange, for joints that bend (kg).")
    ] = 0.0
    payload_m: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="Its centre of mass in the flange's frame (m).")
    ] = "0,0,0"
    widest_deg: Annotated[
        float,
        typer.Option(
            help="Warn where a joint turns farther than this from one target to the next."
        ),
    ] = math.degrees(WIDEST_RAD)
    temperatures: Annotated[
        str | None,
        typer.Option(
            metavar="T1,T2,...",
            help="Temperatures of the links behind the joints, in degrees Celsius, for an arm "
            "whose drift was calibrated; else as warm as it was when its session began.",
        ),
    ] = None
    skip: Annotated[
        bool,
        typer.Option("--skip-unreachable", help="Write the other targets where some are refused."),
    ] = False
    force: ForceBoth = False
    as_json: AsJson = False

    @property
    def file(self) -> Path | None:
        """The file to write; None to print the table."""
        return None if self.out == Path("-") else self.out


def correct_command(options: CorrectOptions) -> None:
    """Correct targets so that the arm reaches them by its nominal controller.

    Exit status 2: nothing was written, for the reason given; targets out of reach are named. Exit
    status 3: nothing was, as the calibration's verdict is bad.
    """
    # Imported late, so that --help stays fast.
    from visioncal.cli.corrected_targets import correct_table

    correct_table(options)
