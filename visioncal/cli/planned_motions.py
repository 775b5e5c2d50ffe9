"""Plans, writes and reports the motions of `visioncal dynamics plan`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.markup import escape

from visioncal.cli.console import answers, print_json, report_written
from visioncal.cli.dynamics import friction_terms
from visioncal.cli.dynamics_plan import FRICTION, ArmOptions, ExcitationOptions
from visioncal.cli.parsing import numbers_in
from visioncal.cli.plan_options import ClearanceOptions
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.dynamics.excitation import ExcitationRequest, excite
from visioncal.dynamics.limits import DefaultLimits, MotionMargins, motion_limits
from visioncal.dynamics.plan_files import MotionPlan, motion_document
from visioncal.dynamics.sweeps import SweepRequest, plan_sweeps
from visioncal.interchange.outputs import write_motions
from visioncal.live.planning.cell import Box
from visioncal.live.planning.messages import plan_warnings, plan_words
from visioncal.robot import Robot, load_robot
from visioncal.robot.bodies import Body, capsule


def plan_motions(
    robot: str,
    motion: ExcitationOptions,
    kept: ClearanceOptions,
    arm_options: ArmOptions,
    out: Path,
    *,
    as_json: bool,
) -> None:
    """Plans an exciting motion and sweeps, writes them into a folder, and reports them.

    Raises:
        DataError: The robot cannot be read, an option is invalid, or the limits allow no motion.
    """
    share = MotionMargins(
        float(np.deg2rad(kept.margin_deg)),
        arm_options.speed,
        arm_options.acceleration,
        arm_options.torque_margin,
        1e-3 * kept.clearance_mm,
        kept.floor_m,
    )
    arm = load_robot(robot)
    missing = (arm_options.range_deg, arm_options.speed_deg, arm_options.acceleration_deg)
    allowed = motion_limits(
        arm,
        share,
        missing=DefaultLimits(*map(_radians, missing)),
        bodies=_bodies(arm, kept.bodies, arm_options.tool),
        payload=None if arm_options.payload is None else _payload(arm_options.payload),
    )
    request = ExcitationRequest(
        motion.duration,
        motion.harmonics,
        friction_terms(motion.friction, FRICTION),
        motion.starts,
        motion.seed,
        seconds=np.inf if motion.seconds is None else motion.seconds,
    )
    sweep_request = None
    if not motion.no_sweeps:
        sweep_request = SweepRequest(speeds=motion.sweep_speeds, seed=motion.seed)
    with shown_progress(quiet=as_json) as progress:
        # The sweeps first: they are quick, and fail for the same reasons.
        sweeps = None if sweep_request is None else plan_sweeps(allowed, sweep_request)
        plan = MotionPlan(allowed, excite(allowed, request, progress), sweeps)
    document = motion_document(plan)
    written = write_motions(out, plan, motion.rate_hz, document)
    if as_json:
        print_json(document)
    else:
        _report(plan)
    report_written(written, quiet=as_json)


def _report(plan: MotionPlan) -> None:
    console = answers()
    for words in plan_words(plan):
        console.print(escape(words))
    for words in plan_warnings(plan):
        console.print(f"[bold yellow]warning:[/] {escape(words)}")


def _radians(degrees: float | None) -> float | None:
    if degrees is None:
        return None
    if not 0.0 < degrees < np.inf:
        raise DataError(
            f"a limit of {degrees:g} deg is given; a number above zero is needed.",
            culprits=["--range-deg", "--speed-deg", "--acceleration-deg"],
        )
    return float(np.deg2rad(degrees))


def _bodies(arm: Robot, boxes: Sequence[Box], tool: str | None) -> tuple[Body, ...]:
    bodies = [Body(box.name, 0, "box", box.size_m, box.base_from_box) for box in boxes]
    if tool is not None:
        length, radius = (1e-3 * number for number in numbers_in(tool, "--tool", "length,radius"))
        if min(length, radius) <= 0.0:
            raise DataError(
                f"--tool is {tool!r}; a length and a radius above zero [mm] are needed.",
                culprits=["--tool"],
            )
        flange = arm.chain.placements[-1]
        tip = flange[:3, 3] + flange[:3, 2] * max(length - radius, 0.0)
        bodies.append(capsule("tool", arm.joint_count, flange[:3, 3], tip, radius))
    return tuple(bodies)


def _payload(words: str) -> FloatArray:
    """(10,) inertial parameters of a point mass, in the flange's frame."""
    kg, *centre_mm = numbers_in(words, "--payload", "kg,x,y,z")
    if kg < 0.0:
        raise DataError(
            f"--payload is {words!r}; a mass of 0 kg or more is needed.", culprits=["--payload"]
        )
    x, y, z = (1e-3 * value for value in centre_mm)
    about = [y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y]
    return kg * np.array([1.0, x, y, z, *about])
