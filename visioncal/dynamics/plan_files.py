"""Files of a plan to identify dynamics: tables, programs for a UR, and JSON."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.core.files import one_line
from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.dynamics.excitation import Excitation
from visioncal.dynamics.fourier import Series
from visioncal.dynamics.limits import CHECK_HZ, MotionExtremes, MotionLimits
from visioncal.dynamics.motion import JointMotion
from visioncal.dynamics.sweeps import REST_S, Stroke, Sweeps
from visioncal.robot import Robot, has_ur_axes

SCHEMA = 1
MOTION_FILES = ("sweeps.script", "sweeps.csv", "excitation.script", "excitation.csv")
# Speed [rad/s] and acceleration [rad/s^2] of the move to a motion's start, and rest there [s].
_SPEED, _ACCELERATION, _SETTLING_S = 0.4, 0.6, 1.0
# servoj's lookahead time [s] and its default gain.
_LOOKAHEAD_S, _GAIN = 0.1, 300


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """Motions planned to identify an arm's dynamics; `sweeps` is None where not requested."""

    allowed: MotionLimits
    excitation: Excitation
    sweeps: Sweeps | None


def motion_files(plan: MotionPlan, rate_hz: float) -> dict[str, str]:
    """Tables, and programs if the robot is a UR: content by file name."""
    robot, files = plan.allowed.robot, {}
    programmed = has_ur_axes(robot)
    if plan.sweeps is not None:
        files["sweeps.csv"] = _motion_table(plan.sweeps.sampled(rate_hz))
        if programmed:
            files["sweeps.script"] = sweeps_program(robot, plan.sweeps)
    series = plan.excitation.series
    files["excitation.csv"] = _motion_table(series.sampled(rate_hz))
    if programmed:
        files["excitation.script"] = excitation_program(robot, series)
    return files


def _motion_table(motion: JointMotion) -> str:
    """Writes a motion as a table with the columns of a session's stream."""
    joints = range(1, motion.q.shape[1] + 1)
    columns = [
        "stamp_s",
        *(f"q{joint}_rad" for joint in joints),
        *(f"dq{joint}_rad_s" for joint in joints),
        *(f"ddq{joint}_rad_s2" for joint in joints),
    ]
    text = io.StringIO()
    rows = np.column_stack([motion.times_s, motion.q, motion.dq, motion.ddq])
    # A nanoradian is enough; adding 0.0 removes negative zeros.
    rows = np.round(rows, 9) + 0.0
    np.savetxt(text, rows, fmt="%.10g", delimiter=",", header=",".join(columns), comments="")
    return text.getvalue()


def motion_document(plan: MotionPlan) -> dict[str, Any]:
    """Builds the content of plan.json; fields that do not apply are absent."""
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": "dynamics",
        "visioncal": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "joints": list(plan.allowed.robot.joint_names),
        "excitation": _excitation(plan.excitation),
    }
    if plan.sweeps is not None:
        document["sweeps"] = _sweeps(plan.sweeps)
    if unchecked := plan.allowed.unchecked:
        document["not_checked"] = list(unchecked)
    return document | {
        "limits": _limits(plan.allowed),
        "robot": dict(plan.allowed.robot.document),
    }


def _excitation(excitation: Excitation) -> dict[str, Any]:
    mean, sines, cosines = excitation.series.coefficients
    request = excitation.request
    search = {"seed": request.seed, "seconds": excitation.seconds, "starts": excitation.starts}
    if np.isfinite(request.seconds):
        search["wished_seconds"] = request.seconds
    return {
        "period_s": request.period_s,
        "harmonics": request.harmonics,
        "start_rad": excitation.series.start.tolist(),
        "mean_rad": mean.tolist(),
        "sine_rad": sines.tolist(),
        "cosine_rad": cosines.tolist(),
        "condition": vars(excitation.condition),
        "condition_random": vars(excitation.random),
        "base_parameters": list(excitation.base.names),
        "weights": excitation.weights.tolist(),
        "kept": _kept(excitation.extremes) | {"rate_hz": CHECK_HZ},
        "search": search,
    }


def _sweeps(sweeps: Sweeps) -> dict[str, Any]:
    begins = sweeps.begins_s.tolist()
    document: dict[str, Any] = {
        "duration_s": begins[-1],
        "home_rad": sweeps.home.tolist(),
        "kept": _kept(sweeps.extremes),
        "strokes": [
            {
                "joint": stroke.joint + 1,
                "begin_s": begin,
                "from_rad": stroke.begin,
                "to_rad": stroke.end,
                "speed_rad_s": stroke.speed,
                "ramp_s": stroke.ramp_s,
                "duration_s": stroke.duration_s,
            }
            for stroke, begin in zip(sweeps.strokes, begins[:-1], strict=True)
            if stroke.sweeps
        ],
    }
    if sweeps.left_out:
        document["left_out"] = list(sweeps.left_out)
    return document


def _kept(kept: MotionExtremes) -> dict[str, Any]:
    """Extremes of a motion, and the shares of the limits that they use."""
    document: dict[str, Any] = {
        "lowest_rad": kept.lowest.tolist(),
        "highest_rad": kept.highest.tolist(),
        "speed_rad_s": kept.speed.tolist(),
        "acceleration_rad_s2": kept.acceleration.tolist(),
    }
    if kept.torque is not None:
        document["torque_nm"] = kept.torque.tolist()
    document["share_of_allowed"] = kept.shares
    if kept.nearest:
        document["nearest"] = {
            "mm": 1e3 * kept.clearance_m,
            "between": list(kept.nearest),
            "at_s": kept.nearest_s,
        }
    return document


def _limits(allowed: MotionLimits) -> dict[str, Any]:
    """The limits, margins included."""
    share = allowed.share
    document: dict[str, Any] = {
        "lower_rad": allowed.lower.tolist(),
        "upper_rad": allowed.upper.tolist(),
        "speed_rad_s": allowed.speed.tolist(),
        "acceleration_rad_s2": allowed.acceleration.tolist(),
        "clearance_mm": 1e3 * share.clearance_m,
        "margin_rad": share.margin_rad,
        "speed_share": share.speed,
        "acceleration_share": share.acceleration,
        "torque_margin": share.torque,
        "bodies": [body.name for body in allowed.bodies if not body.of_arm],
    }
    if not allowed.unchecked:
        document["torque_nm"] = allowed.torque.tolist()
    if share.floor_m is not None:
        document["floor_mm"] = 1e3 * share.floor_m
    return document


def excitation_program(robot: Robot, series: Series) -> str:
    """Writes a program that evaluates and drives the series of an exciting motion."""
    mean, sines, cosines = series.coefficients
    orders = range(1, series.harmonics.count + 1)
    lines = [
        *_heading(robot, f"exciting motion of {series.harmonics.period_s:g} s"),
        "def visioncal_excitation():",
        f"  period = {_number(series.harmonics.period_s)}",
        f"  start = {_joints(series.start)}",
        *_begin(),
        "  t = 0.0",
        # Sums of steps are rounded: the last one must not be driven twice.
        "  while t < period - 0.5 * step:",
        "    w = 6.283185307179586 * t / period",
        *(f"    s{order} = sin({order}.0 * w)" for order in orders),
        *(f"    c{order} = cos({order}.0 * w)" for order in orders),
        *(
            f"    q{joint + 1} = {_sum(mean[joint], sines[joint], cosines[joint])}"
            for joint in range(len(mean))
        ),
        f"    {_servo('[q1, q2, q3, q4, q5, q6]')}",
        "    t = t + step",
        "  end",
        *_end(),
        "visioncal_excitation()",
    ]
    return "\n".join(lines) + "\n"


def sweeps_program(robot: Robot, sweeps: Sweeps) -> str:
    """Writes a program that drives sweeps, one line per stroke: joint, ends, speed, ramp."""
    lines = [
        *_heading(robot, f"sweeps at constant speed, {sweeps.begins_s[-1]:.0f} s"),
        "def visioncal_sweeps():",
        f"  start = {_joints(sweeps.home)}",
        *_begin(),
        "  # One joint, counted from 0, from rest to rest.",
        "  def stroke(joint, first, last, speed, ramp):",
        "    sense = 1.0",
        "    if last < first:",
        "      sense = -1.0",
        "    end",
        "    far = sense * (last - first)",
        "    whole = far / speed + ramp",
        "    q = start",
        "    t = 0.0",
        "    while t < whole:",
        "      late = t > 0.5 * whole",
        "      since = t",
        "      if late:",
        "        since = whole - t",
        "      end",
        "      x = since / ramp",
        "      beyond = 0.0",
        "      if x > 1.0:",
        "        beyond = since - ramp",
        "        x = 1.0",
        "      end",
        "      gone = speed * (ramp * x * x * x * (1.0 - 0.5 * x) + beyond)",
        "      if late:",
        "        gone = far - gone",
        "      end",
        "      q[joint] = first + sense * gone",
        f"      {_servo('q')}",
        "      t = t + step",
        "    end",
        "    q[joint] = last",
        "    t = 0.0",
        f"    while t < {_number(REST_S)}:",
        f"      {_servo('q')}",
        "      t = t + step",
        "    end",
        "  end",
        *_strokes(sweeps.strokes),
        *_end(),
        "visioncal_sweeps()",
    ]
    return "\n".join(lines) + "\n"


def _heading(robot: Robot, what: str) -> Iterator[str]:
    name = one_line(robot.name).encode("ascii", "replace").decode()
    yield f"# visioncal {__version__}: {name}, {what}."
    yield "# Look at plan.rrd first, try it in a simulator, and keep a hand on the stop button."
    yield "# While it is recorded the speed slider stands at 100 %: a slower motion is another one."
    yield "# The way from where the arm stands to the first posture was not looked at: bring it"
    yield "# there by hand first. Cables, grippers and people are not known to the plan."


def _begin() -> Iterator[str]:
    yield "  step = get_steptime()"
    yield f"  movej(start, a={_ACCELERATION}, v={_SPEED})"
    yield f"  sleep({_SETTLING_S})"


def _end() -> Iterator[str]:
    yield f"  {_servo('start')}"
    yield "  stopj(2.0)"
    yield "end"
    yield ""


def _strokes(strokes: Sequence[Stroke]) -> Iterator[str]:
    joint = -1
    for stroke in strokes:
        if stroke.joint != joint:
            joint = stroke.joint
            yield f"  # joint {joint + 1}"
        numbers = (stroke.begin, stroke.end, stroke.speed, stroke.ramp_s)
        yield f"  stroke({stroke.joint}, {', '.join(_number(value) for value in numbers)})"


def _servo(q: str) -> str:
    """A servoj command, which also waits for the controller's next step."""
    return f"servoj({q}, 0, 0, step, {_LOOKAHEAD_S}, {_GAIN})"


def _sum(mean: float, sines: FloatArray, cosines: FloatArray) -> str:
    text = _number(mean)
    for letter, sizes in (("s", sines), ("c", cosines)):
        for order, size in enumerate(sizes.tolist(), 1):
            text += f" {'-' if size < 0.0 else '+'} {_number(abs(size))} * {letter}{order}"
    return text


def _joints(q: FloatArray) -> str:
    return f"[{', '.join(_number(value) for value in np.asarray(q).tolist())}]"


def _number(value: float) -> str:
    """Writes a number without exponent, which the controller could not read."""
    return f"{value:.9f}"
