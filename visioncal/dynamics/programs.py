"""Motions as programs for a UR's controller: they evaluate the motion themselves, step by step."""

from collections.abc import Iterator, Sequence

import numpy as np

from visioncal.core.files import one_line
from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.dynamics.fourier import Series
from visioncal.dynamics.sweeps import REST_S, Stroke, Sweeps
from visioncal.robot import Robot

# To where a motion begins the arm drives slowly, and rests there before it begins [rad/s, rad/s^2].
_SPEED, _ACCELERATION, _SETTLING_S = 0.4, 0.6, 1.0
# Of servoj: it looks ahead so far [s], and follows as stiffly as the controller allows by default.
_LOOKAHEAD_S, _GAIN = 0.1, 300


def excitation_program(robot: Robot, series: Series) -> str:
    """Writes a program that drives an exciting motion: the series itself, not a table of it."""
    mean, sines, cosines = series.coefficients
    orders = range(1, series.harmonics.count + 1)
    lines = [
        *_heading(robot, f"exciting motion of {series.harmonics.period_s:g} s"),
        "def visioncal_excitation():",
        f"  period = {_number(series.harmonics.period_s)}",
        f"  start = {_joints(series.start)}",
        *_begin(),
        "  t = 0.0",
        # Sums of steps round: the last one must not be driven twice.
        "  while t < period - 0.5 * step:",
        "    w = 6.283185307179586 * t / period",
        *(f"    s{it} = sin({it}.0 * w)" for it in orders),
        *(f"    c{it} = cos({it}.0 * w)" for it in orders),
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
    """Writes a program that drives sweeps: each is a line with its joint, ends, speed and ramp."""
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
    for it in strokes:
        if it.joint != joint:
            joint = it.joint
            yield f"  # joint {joint + 1}"
        numbers = (it.begin, it.end, it.speed, it.ramp_s)
        yield f"  stroke({it.joint}, {', '.join(_number(value) for value in numbers)})"


def _servo(q: str) -> str:
    """Sends the joints there, and waits for the controller's next step."""
    return f"servoj({q}, 0, 0, step, {_LOOKAHEAD_S}, {_GAIN})"


def _sum(mean: float, sines: FloatArray, cosines: FloatArray) -> str:
    text = _number(mean)
    for letter, sizes in (("s", sines), ("c", cosines)):
        for order, size in enumerate(sizes.tolist(), 1):
            text += f" {'-' if size < 0.0 else '+'} {_number(abs(size))} * {letter}{order}"
    return text


def _joints(q: FloatArray) -> str:
    return f"[{', '.join(_number(it) for it in np.asarray(q).tolist())}]"


def _number(value: float) -> str:
    """A nanoradian does not matter to an arm; an exponent would to its controller."""
    return f"{value:.9f}"
