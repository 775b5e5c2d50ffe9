"""`visioncal dynamics plan`."""

import json
from pathlib import Path

import numpy as np
import typer
from rich.markup import escape

from visioncal.cli import motion_options as options
from visioncal.cli.console import messages, tell_written
from visioncal.cli.numbers import numbers_in
from visioncal.cli.plan_options import BoxOption, Clearance, Floor, Margin
from visioncal.cli.planned_cell import box_of, floor_of
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
from visioncal.live.planning.motions import plan_warnings, plan_words
from visioncal.robot import Robot, load_robot
from visioncal.robot.bodies import Body, capsule


def dynamics_plan_command(
    robot: options.RobotName,
    out: options.Out = Path("motions"),
    duration: options.Duration = 20.0,
    harmonics: options.HarmonicsOption = 5,
    friction: options.Friction = "coulomb,viscous,offset",
    sweep_speeds: options.SweepSpeeds = 6,
    no_sweeps: options.NoSweeps = False,
    rate_hz: options.Rate = 500.0,
    starts: options.Starts = 4,
    seconds: options.Seconds = None,
    seed: options.SearchSeed = 0,
    margin_deg: Margin = 3.0,
    speed: options.SpeedShare = 0.9,
    acceleration: options.AccelerationShare = 0.9,
    torque_margin: options.TorqueMargin = 1.2,
    clearance_mm: Clearance = 30.0,
    floor: Floor = "0",
    boxes: BoxOption = None,
    tool: options.Tool = None,
    payload: options.Payload = None,
    range_deg: options.RangeDeg = None,
    speed_deg: options.SpeedDeg = None,
    acceleration_deg: options.AccelerationDeg = None,
    as_json: options.AsJson = False,
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
        floor_of(floor),
    )
    arm = load_robot(robot)
    allowed = allowed_motion(
        arm,
        share,
        missing=Missing(*map(_radians, (range_deg, speed_deg, acceleration_deg))),
        bodies=_bodies(arm, boxes or [], tool),
        payload=None if payload is None else _payload(payload),
    )
    wished = ExcitationRequest(
        duration,
        harmonics,
        _terms(friction),
        starts,
        seed,
        seconds=np.inf if seconds is None else seconds,
    )
    swept = None if no_sweeps else SweepRequest(speeds=sweep_speeds, seed=seed)
    plan = _planned(allowed, wished, swept, quiet=as_json)
    document = motion_document(plan)
    written = write_motions(out, plan, rate_hz, document)
    if as_json:
        typer.echo(json.dumps(document, indent=2, allow_nan=False))
    else:
        _tell(plan)
    tell_written(written, quiet=as_json)


def _tell(plan: MotionPlan) -> None:
    console = messages()
    for words in plan_words(plan):
        console.print(escape(words))
    for words in plan_warnings(plan):
        console.print(f"[bold yellow]warning:[/] {escape(words)}")


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
    unknown = [it for it in wanted if it not in options.FRICTION]
    if unknown:
        raise DataError(
            f"--friction is {words[:80]!r}; of {some_of(options.FRICTION)} is needed, with commas "
            "between, or none.",
            culprits=["--friction"],
        )
    return FrictionTerms(*(it in wanted for it in options.FRICTION))


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
