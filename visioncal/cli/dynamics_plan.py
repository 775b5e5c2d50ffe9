"""`visioncal dynamics plan`."""

import json
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
import typer
from rich.markup import escape

from visioncal.cli.console import messages, shown_progress
from visioncal.cli.numbers import numbers_in
from visioncal.cli.planned_cell import box_of
from visioncal.cli.stdout import write_stdout
from visioncal.dynamics.excitation import ExcitationRequest, excite
from visioncal.dynamics.friction import FrictionTerms
from visioncal.dynamics.limits import Allowed, Missing, Share, allowed_motion
from visioncal.dynamics.planned import MotionPlan
from visioncal.dynamics.sweeps import SweepRequest, plan_sweeps
from visioncal.dynamics.written import motion_document
from visioncal.errors import DataError
from visioncal.files import some_of
from visioncal.outputs import write_motions
from visioncal.planning.motions import plan_warnings, plan_words
from visioncal.robot import Robot, load_robot
from visioncal.robot.bodies import Body, capsule
from visioncal.types import FloatArray

_MOTION, _LIMITS = "The motion", "What the arm must keep"
_FRICTION = ("coulomb", "viscous", "offset", "motor-inertia")


def _option(*names: str, panel: str, words: str, metavar: str | None = None) -> object:
    return typer.Option(
        *names, help=words, rich_help_panel=panel, show_default=False, metavar=metavar
    )


_Degrees: TypeAlias = float | None


def dynamics_plan_command(
    robot: Annotated[str, typer.Argument(help="A built-in robot, or a .urdf, .toml or .json.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for tables, programs and preview.")
    ] = Path("motions"),
    duration: Annotated[
        float,
        typer.Option(help="How long the exciting motion lasts, in s.", rich_help_panel=_MOTION),
    ] = 20.0,
    harmonics: Annotated[
        int, typer.Option(help="Harmonics of that period.", rich_help_panel=_MOTION)
    ] = 5,
    friction: Annotated[
        str,
        typer.Option(
            help=f"What is to be told besides inertias: {', '.join(_FRICTION)}; or none.",
            rich_help_panel=_MOTION,
        ),
    ] = "coulomb,viscous,offset",
    sweep_speeds: Annotated[
        int, typer.Option(help="Speeds at which each joint sweeps.", rich_help_panel=_MOTION)
    ] = 6,
    no_sweeps: Annotated[
        bool, typer.Option("--no-sweeps", help="No sweeps.", rich_help_panel=_MOTION)
    ] = False,
    rate_hz: Annotated[
        float,
        typer.Option(
            "--rate",
            min=1.0,
            max=4000.0,
            help="Rows a second of the tables.",
            rich_help_panel=_MOTION,
        ),
    ] = 500.0,
    seconds: Annotated[
        float,
        typer.Option(help="How long to search, in s of one core.", rich_help_panel=_MOTION),
    ] = 25.0,
    seed: Annotated[
        int, typer.Option(min=0, help="Of the random starts.", rich_help_panel=_MOTION)
    ] = 0,
    margin_deg: Annotated[
        float, typer.Option(help="To the ends of the joints' ranges.", rich_help_panel=_LIMITS)
    ] = 3.0,
    speed: Annotated[
        float, typer.Option(help="Share of the greatest speeds.", rich_help_panel=_LIMITS)
    ] = 0.9,
    acceleration: Annotated[
        float, typer.Option(help="Share of the greatest accelerations.", rich_help_panel=_LIMITS)
    ] = 0.9,
    torque_margin: Annotated[
        float,
        typer.Option(
            help="Torques may be so many times larger than predicted.", rich_help_panel=_LIMITS
        ),
    ] = 1.2,
    clearance_mm: Annotated[
        float, typer.Option(help="Distance that all keep.", rich_help_panel=_LIMITS)
    ] = 30.0,
    floor: Annotated[
        str,
        typer.Option(
            help="Height of the floor in the base, in mm; or none.", rich_help_panel=_LIMITS
        ),
    ] = "0",
    boxes: Annotated[
        list[str] | None,
        _option(
            "--box",
            panel=_LIMITS,
            metavar="NAME:X,Y,Z:SX,SY,SZ",
            words="Something in the way: centre in the base and lengths, in mm; may be repeated.",
        ),
    ] = None,
    tool: Annotated[
        str | None,
        _option(
            "--tool",
            panel=_LIMITS,
            metavar="LENGTH,RADIUS",
            words="What sticks out of the flange, along its z, in mm.",
        ),
    ] = None,
    payload: Annotated[
        str | None,
        _option(
            "--payload",
            panel=_LIMITS,
            metavar="KG,X,Y,Z",
            words="What the flange carries: mass, and its centre in the flange in mm.",
        ),
    ] = None,
    range_deg: Annotated[
        _Degrees,
        _option("--range-deg", panel=_LIMITS, words="To either side, for joints without limits."),
    ] = None,
    speed_deg: Annotated[
        _Degrees,
        _option("--speed-deg", panel=_LIMITS, words="In deg/s, where the robot tells none."),
    ] = None,
    acceleration_deg: Annotated[
        _Degrees,
        _option("--acceleration-deg", panel=_LIMITS, words="In deg/s^2, where it tells none."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print plan.json to stdout.")] = False,
) -> None:
    """Plan the motions that tell an arm's inertias and friction.

    Writes an exciting motion and sweeps as tables (.csv), programs for a UR (.script), plan.json
    and plan.rrd to look at. Nothing is sent to a robot. Exit status 2: the limits allow none.
    """
    share = Share(
        float(np.deg2rad(margin_deg)),
        speed,
        acceleration,
        torque_margin,
        1e-3 * clearance_mm,
        None if floor.strip().lower() == "none" else 1e-3 * numbers_in(floor, "--floor", "z")[0],
    )
    arm = load_robot(robot)
    allowed = allowed_motion(
        arm,
        share,
        missing=Missing(*map(_radians, (range_deg, speed_deg, acceleration_deg))),
        bodies=_bodies(arm, boxes or [], tool),
        payload=None if payload is None else _payload(payload),
    )
    wished = ExcitationRequest(duration, harmonics, _terms(friction), seconds, seed)
    swept = None if no_sweeps else SweepRequest(speeds=sweep_speeds, seed=seed)
    plan = _planned(allowed, wished, swept, quiet=as_json)
    document = motion_document(plan)
    files = write_motions(out, plan, rate_hz, document)
    if as_json:
        write_stdout(json.dumps(document, indent=2, allow_nan=False) + "\n")
        return
    console = messages()
    for words in plan_words(plan):
        console.print(escape(words))
    for words in plan_warnings(plan):
        console.print(f"[bold yellow]warning:[/] {escape(words)}")
    for file in files:
        console.print(escape(f"wrote {file}"))


def _planned(
    allowed: Allowed, wished: ExcitationRequest, swept: SweepRequest | None, *, quiet: bool
) -> MotionPlan:
    with shown_progress(quiet=quiet) as told:
        # The sweeps first: they are quick, and fail for the same reasons.
        sweeps = None if swept is None else plan_sweeps(allowed, swept)
        return MotionPlan(allowed, excite(allowed, wished, told), sweeps)


def _radians(degrees: float | None) -> float | None:
    if degrees is None:
        return None
    if not 0.0 < degrees < np.inf:
        raise DataError(
            f"a limit of {degrees:g} deg is given; a number above zero is needed.",
            culprits=["--range-deg", "--speed-deg", "--acceleration-deg"],
        )
    return float(np.deg2rad(degrees))


def _terms(words: str) -> FrictionTerms:
    wanted = [] if words.strip().lower() == "none" else [it.strip() for it in words.split(",")]
    unknown = [it for it in wanted if it not in _FRICTION]
    if unknown:
        raise DataError(
            f"--friction is {words[:80]!r}; of {some_of(_FRICTION)} is needed, with commas "
            "between, or none.",
            culprits=["--friction"],
        )
    return FrictionTerms(*(it in wanted for it in _FRICTION))


def _bodies(arm: Robot, boxes: list[str], tool: str | None) -> tuple[Body, ...]:
    found = [Body(box.name, 0, "box", box.size_m, box.base_from_box) for box in map(box_of, boxes)]
    if tool is not None:
        length, radius = (1e-3 * it for it in numbers_in(tool, "--tool", "length,radius"))
        if min(length, radius) <= 0.0:
            raise DataError(
                f"--tool is {tool!r}; a length and a radius above zero [mm] are needed.",
                culprits=["--tool"],
            )
        flange = arm.chain.placements[-1]
        tip = flange[:3, 3] + flange[:3, 2] * max(length - radius, 0.0)
        found.append(capsule("tool", arm.joint_count, flange[:3, 3], tip, radius))
    return tuple(found)


def _payload(words: str) -> FloatArray:
    """(10,) inertial parameters of a point mass, in the flange's frame."""
    kg, *centre_mm = numbers_in(words, "--payload", "kg,x,y,z")
    if kg < 0.0:
        raise DataError(
            f"--payload is {words!r}; a mass of 0 kg or more is needed.", culprits=["--payload"]
        )
    x, y, z = (1e-3 * it for it in centre_mm)
    about = [y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y]
    return kg * np.array([1.0, x, y, z, *about])
