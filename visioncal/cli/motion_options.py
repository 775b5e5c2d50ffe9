"""The options of `visioncal dynamics plan`, as types of its parameters."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

FRICTION = ("coulomb", "viscous", "offset", "motor-inertia")
_MOTION, _LIMITS, _MISSING = "The motion", "What the arm must keep", "What its description lacks"


def _number(*names: str, panel: str, words: str, metavar: str | None = None) -> object:
    return typer.Option(
        *names, help=words, rich_help_panel=panel, show_default=False, metavar=metavar
    )


RobotName: TypeAlias = Annotated[
    str, typer.Argument(help="A built-in robot, or the path of a .urdf, .toml or .json.")
]
Out: TypeAlias = Annotated[
    Path, typer.Option("-o", "--out", help="Folder for tables, programs and preview.")
]
AsJson: TypeAlias = Annotated[bool, typer.Option("--json", help="Print plan.json to stdout.")]

Duration: TypeAlias = Annotated[
    float,
    typer.Option(
        "--duration", help="How long the exciting motion lasts, in s.", rich_help_panel=_MOTION
    ),
]
HarmonicsOption: TypeAlias = Annotated[
    int, typer.Option("--harmonics", help="Harmonics of that period.", rich_help_panel=_MOTION)
]
Friction: TypeAlias = Annotated[
    str,
    typer.Option(
        "--friction",
        help=f"What is to be told besides inertias: {', '.join(FRICTION)}; or none.",
        rich_help_panel=_MOTION,
    ),
]
SweepSpeeds: TypeAlias = Annotated[
    int,
    typer.Option(
        "--sweep-speeds", help="Speeds at which each joint sweeps.", rich_help_panel=_MOTION
    ),
]
NoSweeps: TypeAlias = Annotated[
    bool, typer.Option("--no-sweeps", help="The exciting motion alone.", rich_help_panel=_MOTION)
]
Rate: TypeAlias = Annotated[
    float,
    typer.Option(
        "--rate", min=1.0, max=4000.0, help="Rows a second of the tables.", rich_help_panel=_MOTION
    ),
]
Starts: TypeAlias = Annotated[
    int,
    typer.Option(
        "--starts",
        help="Random motions to search from; more take longer and find better ones.",
        rich_help_panel=_MOTION,
    ),
]
Seconds: TypeAlias = Annotated[
    float | None,
    _number(
        "--seconds",
        panel=_MOTION,
        words="End the search after so many s of one core, once a motion is found; what is found "
        "then depends on the computer.",
    ),
]
SearchSeed: TypeAlias = Annotated[
    int,
    typer.Option(
        "--seed", min=0, help="Other random starts for every number.", rich_help_panel=_MOTION
    ),
]

SpeedShare: TypeAlias = Annotated[
    float, typer.Option("--speed", help="Share of the greatest speeds.", rich_help_panel=_LIMITS)
]
AccelerationShare: TypeAlias = Annotated[
    float,
    typer.Option(
        "--acceleration", help="Share of the greatest accelerations.", rich_help_panel=_LIMITS
    ),
]
TorqueMargin: TypeAlias = Annotated[
    float,
    typer.Option(
        "--torque-margin",
        help="Torques may be so many times larger than the nominal inertias have them.",
        rich_help_panel=_LIMITS,
    ),
]
Tool: TypeAlias = Annotated[
    str | None,
    _number(
        "--tool",
        panel=_LIMITS,
        metavar="LENGTH,RADIUS",
        words="What sticks out of the flange, along its z, in mm.",
    ),
]
Payload: TypeAlias = Annotated[
    str | None,
    _number(
        "--payload",
        panel=_LIMITS,
        metavar="KG,X,Y,Z",
        words="What the flange carries: its mass, and its centre in the flange's frame in mm.",
    ),
]
RangeDeg: TypeAlias = Annotated[
    float | None,
    _number("--range-deg", panel=_MISSING, words="Range to either side of joints without limits."),
]
SpeedDeg: TypeAlias = Annotated[
    float | None, _number("--speed-deg", panel=_MISSING, words="Greatest speed, in deg/s.")
]
AccelerationDeg: TypeAlias = Annotated[
    float | None,
    _number("--acceleration-deg", panel=_MISSING, words="Greatest acceleration, in deg/s^2."),
]
