"""`visioncal dynamics plan`."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.options import AsJson, OutFolder
from visioncal.cli.plan_options import ClearanceOptions

FRICTION = ("coulomb", "viscous", "offset", "motor-inertia")
_motion = partial(typer.Option, rich_help_panel="The motion")
_limits = partial(typer.Option, rich_help_panel="What the arm must keep")
_missing = partial(typer.Option, rich_help_panel="What its description lacks")


@dataclass(frozen=True)
class ExcitationOptions:
    """Options of the motion."""

    duration: Annotated[float, _motion(help="Duration of the exciting motion, in s.")] = 20.0
    harmonics: Annotated[int, _motion(help="Harmonics of that period.")] = 5
    friction: Annotated[
        str,
        _motion(help=f"What is to be identified besides inertias: {', '.join(FRICTION)}; or none."),
    ] = "coulomb,viscous,offset"
    sweep_speeds: Annotated[int, _motion(help="Speeds at which each joint sweeps.")] = 6
    no_sweeps: Annotated[bool, _motion("--no-sweeps", help="Only the exciting motion.")] = False
    rate_hz: Annotated[
        float, _motion("--rate", min=1.0, max=4000.0, help="Sampling rate of the tables, in Hz.")
    ] = 500.0
    starts: Annotated[
        int, _motion(help="Random motions to search from; more take longer and find better ones.")
    ] = 4
    seconds: Annotated[
        float | None,
        _motion(
            help="End the search after this time of one core, in s, once a motion is found; the "
            "result then depends on the computer."
        ),
    ] = None
    seed: Annotated[int, _motion(min=0, help="Random seed of the starts.")] = 0


@dataclass(frozen=True)
class ArmOptions:
    """Limits, payload and fixed joints of the arm."""

    speed: Annotated[float, _limits(help="Fraction of the maximum speeds.")] = 0.9
    acceleration: Annotated[float, _limits(help="Fraction of the maximum accelerations.")] = 0.9
    torque_margin: Annotated[
        float, _limits(help="Safety factor on the torques of the nominal inertias.")
    ] = 1.2
    tool: Annotated[
        str | None,
        _limits(metavar="LENGTH,RADIUS", help="What sticks out of the flange, along its z, in mm."),
    ] = None
    payload: Annotated[
        str | None,
        _limits(
            metavar="KG,X,Y,Z",
            help="What the flange carries: its mass, and its centre in the flange's frame in mm.",
        ),
    ] = None
    range_deg: Annotated[
        float | None, _missing(help="Range to either side of joints without limits.")
    ] = None
    speed_deg: Annotated[float | None, _missing(help="Maximum speed, in deg/s.")] = None
    acceleration_deg: Annotated[
        float | None, _missing(help="Maximum acceleration, in deg/s^2.")
    ] = None


def dynamics_plan_command(
    robot: Annotated[
        str, typer.Argument(help="A built-in robot, or the path of a .urdf, .toml or .json.")
    ],
    motion: ExcitationOptions,
    kept: ClearanceOptions,
    arm_options: ArmOptions,
    out: OutFolder = Path("motions"),
    as_json: AsJson = False,
) -> None:
    """Plan the motions that determine an arm's inertias and friction.

    Writes an exciting motion and sweeps as tables (.csv), plan.json and plan.rrd to look at.
    Nothing is sent to a robot. Exit status 2: the limits allow none.
    """
    # Imported late, so that --help stays fast.
    from visioncal.cli.planned_motions import plan_motions

    plan_motions(robot, motion, kept, arm_options, out, as_json=as_json)
