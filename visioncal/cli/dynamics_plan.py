"""`visioncal dynamics plan`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape

from visioncal.cli.console import answers, report_written
from visioncal.cli.numbers import numbers_in
from visioncal.cli.options import AsJson, OutFolder
from visioncal.cli.plan_options import ClearanceOptions
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.types import FloatArray
from visioncal.dynamics.excitation import ExcitationRequest, excite
from visioncal.dynamics.friction import FrictionTerms
from visioncal.dynamics.limits import Allowed, Missing, Share, allowed_motion
from visioncal.dynamics.planned import MotionPlan
from visioncal.dynamics.sweeps import SweepRequest, plan_sweeps
from visioncal.dynamics.written import motion_document
from visioncal.interchange.outputs import write_motions
from visioncal.live.planning.cell import Box
from visioncal.live.planning.motions import plan_warnings, plan_words
from visioncal.robot import Robot, load_robot
from visioncal.robot.bodies import Body, capsule

_FRICTION = ("coulomb", "viscous", "offset", "motor-inertia")
_motion = partial(typer.Option, rich_help_panel="The motion")
_limits = partial(typer.Option, rich_help_panel="What the arm must keep")
_missing = partial(typer.Option, rich_help_panel="What its description lacks")


@dataclass(frozen=True)
class ExcitationOptions:
    """The motion."""

    duration: Annotated[
        float,
        _motion("--duration", help="How long the exciting motion lasts, in s."),
    ] = 20.0
    harmonics: Annotated[int, _motion("--harmonics", help="Harmonics of that period.")] = 5
    friction: Annotated[
        str,
        _motion(
            "--friction",
            help=f"What is to be identified besides inertias: {', '.join(_FRICTION)}; or none.",
        ),
    ] = "coulomb,viscous,offset"
    sweep_speeds: Annotated[
        int,
        _motion("--sweep-speeds", help="Speeds at which each joint sweeps."),
    ] = 6
    no_sweeps: Annotated[bool, _motion("--no-sweeps", help="The exciting motion alone.")] = False
    rate_hz: Annotated[
        float,
        _motion("--rate", min=1.0, max=4000.0, help="Rows a second of the tables."),
    ] = 500.0
    starts: Annotated[
        int,
        _motion(
            "--starts",
            help="Random motions to search from; more take longer and find better ones.",
        ),
    ] = 4
    seconds: Annotated[
        float | None,
        _motion(
            "--seconds",
            help="End the search after so many s of one core, once a motion is found; what is "
            "found then depends on the computer.",
        ),
    ] = None
    seed: Annotated[
        int,
        _motion("--seed", min=0, help="Other random starts for every number."),
    ] = 0


@dataclass(frozen=True)
class ArmOptions:
    """What the arm may do, carries and lacks."""

    speed: Annotated[float, _limits("--speed", help="Share of the greatest speeds.")] = 0.9
    acceleration: Annotated[
        float,
        _limits("--acceleration", help="Share of the greatest accelerations."),
    ] = 0.9
    torque_margin: Annotated[
        float,
        _limits(
            "--torque-margin",
            help="Torques may be so many times larger than the nominal inertias have them.",
        ),
    ] = 1.2
    tool: Annotated[
        str | None,
        _limits(
            "--tool",
            metavar="LENGTH,RADIUS",
            help="What sticks out of the flange, along its z, in mm.",
        ),
    ] = None
    payload: Annotated[
        str | None,
        _limits(
            "--payload",
            metavar="KG,X,Y,Z",
            help="What the flange carries: its mass, and its centre in the flange's frame in mm.",
        ),
    ] = None
    range_deg: Annotated[
        float | None,
        _missing("--range-deg", help="Range to either side of joints without limits."),
    ] = None
    speed_deg: Annotated[
        float | None, _missing("--speed-deg", help="Greatest speed, in deg/s.")
    ] = None
    acceleration_deg: Annotated[
        float | None,
        _missing("--acceleration-deg", help="Greatest acceleration, in deg/s^2."),
    ] = None


def dynamics_plan_command(
    robot: Annotated[
        str, typer.Argument(help="A built-in robot, or the path of a .urdf, .toml or .json.")
    ],
    motion: ExcitationOptions,
    kept: ClearanceOptions,
    able: ArmOptions,
    out: OutFolder = Path("motions"),
    as_json: AsJson = False,
) -> None:
    """Plan the motions that determine an arm's inertias and friction.

    Writes an exciting motion and sweeps as tables (.csv), programs for a UR (.script), plan.json
    and plan.rrd to look at. Nothing is sent to a robot. Exit status 2: the limits allow none.
    """
    share = Share(
        float(np.deg2rad(kept.margin_deg)),
        able.speed,
        able.acceleration,
        able.torque_margin,
        1e-3 * kept.clearance_mm,
        kept.floor_m,
    )
    arm = load_robot(robot)
    missing = (able.range_deg, able.speed_deg, able.acceleration_deg)
    allowed = allowed_motion(
        arm,
        share,
        missing=Missing(*map(_radians, missing)),
        bodies=_bodies(arm, kept.bodies, able.tool),
        payload=None if able.payload is None else _payload(able.payload),
    )
    wished = ExcitationRequest(
        motion.duration,
        motion.harmonics,
        _terms(motion.friction),
        motion.starts,
        motion.seed,
        seconds=np.inf if motion.seconds is None else motion.seconds,
    )
    swept = None
    if not motion.no_sweeps:
        swept = SweepRequest(speeds=motion.sweep_speeds, seed=motion.seed)
    plan = _planned(allowed, wished, swept, quiet=as_json)
    document = motion_document(plan)
    written = write_motions(out, plan, motion.rate_hz, document)
    if as_json:
        typer.echo(json.dumps(document, indent=2, allow_nan=False))
    else:
        _report(plan)
    report_written(written, quiet=as_json)


def _report(plan: MotionPlan) -> None:
    console = answers()
    for words in plan_words(plan):
        console.print(escape(words))
    for words in plan_warnings(plan):
        console.print(f"[bold yellow]warning:[/] {escape(words)}")


def _planned(
    allowed: Allowed, wished: ExcitationRequest, swept: SweepRequest | None, *, quiet: bool
) -> MotionPlan:
    with shown_progress(quiet=quiet) as progress:
        # The sweeps first: they are quick, and fail for the same reasons.
        sweeps = None if swept is None else plan_sweeps(allowed, swept)
        return MotionPlan(allowed, excite(allowed, wished, progress), sweeps)


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


def _bodies(arm: Robot, boxes: Sequence[Box], tool: str | None) -> tuple[Body, ...]:
    found = [Body(box.name, 0, "box", box.size_m, box.base_from_box) for box in boxes]
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
