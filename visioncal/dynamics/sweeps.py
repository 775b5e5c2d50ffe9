"""Planning of sweeps at constant speed, one joint at a time, which show friction.

At constant speed inertia does not contribute to a joint's torque, and gravity cancels between the
two directions: friction remains, speed by speed (Swevers, Verdonck and De Schutter 2007).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from visioncal.core.arguments import check_fields
from visioncal.core.codec import Positive, within
from visioncal.core.errors import DegenerateError
from visioncal.core.types import FloatArray
from visioncal.dynamics.excitation import even_times
from visioncal.dynamics.limits import MotionExtremes, MotionLimits, motion_extremes
from visioncal.dynamics.model import JointMotion

# Least duration of ramps, and of constant speed [s].
_SHORTEST_RAMP_S, _SHORTEST_HOLD_S = 0.15, 0.4
# Share of the greatest speed and acceleration for moves between sweeps.
_UNHURRIED = 0.2
# Step of the search for a joint's free range [rad].
_STEP_RAD = 0.1


@dataclass(frozen=True)
class SweepRequest:
    """Options of planned sweeps."""

    # Number of speeds of each joint, logarithmically spaced.
    speeds: Annotated[int, within(2, 30)] = 6
    slowest_rad_s: Positive = 0.02  # The least of them [rad/s].
    # Duration of constant speed, where the range allows it [s].
    hold_s: Annotated[float, within(_SHORTEST_HOLD_S, 60.0)] = 3.0
    seed: int = 0  # Seed of the random postures.

    def __post_init__(self) -> None:
        check_fields(self, "sweeps")


@dataclass(frozen=True)
class Stroke:
    """One joint's move from rest to rest: a ramp, constant speed, and the ramp back.

    The ramps are fifth-order polynomials without acceleration at both ends. They cover half the
    distance of full speed, whence their highest coefficient is zero.
    """

    joint: int  # Index of the joint, from 0.
    begin: float  # Start position [rad].
    end: float  # End position [rad].
    speed: float  # The constant speed, above zero [rad/s].
    ramp_s: float  # Duration of a ramp [s].
    sweeps: bool  # Whether it is a sweep, or only the move to one.

    @property
    def duration_s(self) -> float:
        """Duration, without the rest after it [s]."""
        return abs(self.end - self.begin) / self.speed + self.ramp_s

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position, speed, acceleration (m,) at times since the beginning; rest after the end."""
        distance, duration, ramp = abs(self.end - self.begin), self.duration_s, self.ramp_s
        second_half = times_s > 0.5 * duration
        # The second half mirrors the first.
        since = np.clip(np.where(second_half, duration - times_s, times_s), 0.0, None)
        share = np.minimum(since / ramp, 1.0)
        covered = self.speed * (ramp * (share**3 - 0.5 * share**4) + np.maximum(since - ramp, 0.0))
        speed = self.speed * share**2 * (3.0 - 2.0 * share)
        acceleration = self.speed / ramp * 6.0 * share * (1.0 - share)
        direction = np.sign(self.end - self.begin)
        position = self.begin + direction * np.where(second_half, distance - covered, covered)
        return (
            position,
            direction * speed,
            direction * np.where(second_half, -acceleration, acceleration),
        )


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Sweeps of all joints, from a posture and back to it."""

    home: FloatArray  # (n,) posture of the other joints [rad].
    strokes: tuple[Stroke, ...]  # The strokes in order.
    extremes: MotionExtremes  # Extremes of the motion.
    left_out: tuple[str, ...]  # Names of joints with too little free range.

    @cached_property
    def begins_s(self) -> FloatArray:
        """(k + 1,) begin of each stroke, and the end of the last [s]."""
        return _begins(self.strokes)

    def sampled(self, rate_hz: float) -> JointMotion:
        """The motion from its beginning to its end, evenly sampled."""
        return _sampled(self.home, self.strokes, rate_hz)


def plan_sweeps(allowed: MotionLimits, request: SweepRequest) -> Sweeps:
    """Plans sweeps of every joint, at several speeds, in both directions.

    The home posture maximises the least free range of the joints, over random postures.

    Args:
        allowed: The limits.
        request: Options.

    Raises:
        DegenerateError: No posture has joints with enough free range.
    """
    rng = np.random.default_rng(request.seed)
    half = np.minimum(np.pi, allowed.half)
    drawn = allowed.middle + rng.uniform(-half, half, (300, len(half)))
    clear, joints = drawn[allowed.collisions.first_contact(drawn) < 0], range(len(half))
    # (k, n, 2) lowest and highest angles of each joint from the clear postures.
    ranges = np.array(
        [
            [[_free_end(allowed, home, joint, sense) for sense in (-1, 1)] for joint in joints]
            for home in clear
        ]
    ).reshape(-1, len(half), 2)
    order = np.argsort(-np.sort(ranges[:, :, 1] - ranges[:, :, 0], axis=1)[:, 0], kind="stable")
    breaches: tuple[str, ...] = ("everywhere something is too near",)
    # The best are planned in full.
    for row in order[:20].tolist():
        home, strokes, left_out = clear[row], list[Stroke](), list[str]()
        for joint, name in enumerate(allowed.robot.joint_names):
            low, high = _checked_range(allowed, home, joint, *ranges[row, joint].tolist())
            # Least range of a joint that is swept [rad].
            if high - low < 0.2:
                left_out.append(name)
                continue
            strokes += _joint_strokes(allowed, request, joint, float(home[joint]), low, high)
        # For torques alone: paths are checked in full, ramps and speeds are exact.
        kept = motion_extremes(allowed, _sampled(home, tuple(strokes), 200.0))
        if strokes and not kept.breaches:
            return Sweeps(home, tuple(strokes), kept, tuple(left_out))
        breaches = kept.breaches or ("no joint has room",)
    raise DegenerateError(
        f"robot {allowed.robot.name}: no posture was found from which its joints could sweep; of "
        f"the last one tried, {breaches[0]}.",
        culprits=breaches,
        next_step="Leave the sweeps more room (--margin-deg, --clearance-mm, --floor), or leave "
        "them out (--no-sweeps).",
    )


def _joint_strokes(
    allowed: MotionLimits, request: SweepRequest, joint: int, home: float, low: float, high: float
) -> Iterator[Stroke]:
    """Strokes there and back at every speed, about the centre of the joint's free range."""
    acceleration, middle = float(allowed.acceleration[joint]), 0.5 * (low + high)
    free_range = high - low
    # The fastest speed with time to hold it; a ramp takes 1.5 times speed over acceleration.
    least = _SHORTEST_RAMP_S + _SHORTEST_HOLD_S
    fastest = (np.sqrt(least**2 + 6.0 * free_range / acceleration) - least) * acceleration / 3.0
    fastest = min(float(fastest), float(allowed.speed[joint]))
    position = home
    for speed in np.geomspace(min(request.slowest_rad_s, fastest), fastest, request.speeds):
        ramp_s = max(_SHORTEST_RAMP_S, 1.5 * float(speed) / acceleration)
        half = 0.5 * min(float(speed) * (ramp_s + request.hold_s), free_range)
        begin, end = middle - half, middle + half
        yield from _move(allowed, joint, position, begin)
        yield Stroke(joint, begin, end, float(speed), ramp_s, sweeps=True)
        yield Stroke(joint, end, begin, float(speed), ramp_s, sweeps=True)
        position = begin
    yield from _move(allowed, joint, position, home)


def _move(allowed: MotionLimits, joint: int, begin: float, end: float) -> Iterator[Stroke]:
    """The move to the start of a sweep, if any."""
    distance, acceleration = abs(end - begin), _UNHURRIED * float(allowed.acceleration[joint])
    if distance == 0.0:
        return
    # A short move is ramps alone, each as long as the distance takes at full speed.
    speed = min(
        _UNHURRIED * float(allowed.speed[joint]),
        float(np.sqrt(distance * acceleration / 1.5)),
        distance / _SHORTEST_RAMP_S,
    )
    ramp_s = max(_SHORTEST_RAMP_S, 1.5 * speed / acceleration)
    yield Stroke(joint, begin, end, speed, ramp_s, sweeps=False)


def _free_end(allowed: MotionLimits, home: FloatArray, joint: int, sense: int) -> float:
    """End of a joint's free range to one side, searched in steps [rad]."""
    limit = (allowed.upper if sense > 0 else allowed.lower)[joint]
    # Half of the greatest range of a sweep [rad].
    distance = min(abs(float(limit - home[joint])), 1.2)
    steps = np.append(np.arange(_STEP_RAD, distance, _STEP_RAD), distance)
    postures = np.repeat(home[None], len(steps), axis=0)
    postures[:, joint] += sense * steps
    hits = np.flatnonzero(allowed.collisions.first_contact(postures) >= 0)
    clear = steps[: hits[0]] if len(hits) else steps
    return float(home[joint] + sense * (clear[-1] if len(clear) else 0.0))


def _checked_range(
    allowed: MotionLimits, home: FloatArray, joint: int, low: float, high: float
) -> tuple[float, float]:
    """A joint's free range, reduced until its path is clear between the steps, too."""
    ends = []
    for end in (low, high):
        posture = home.copy()
        posture[joint] = end
        while posture[joint] != home[joint] and allowed.collisions.path_contact(home, posture) >= 0:
            offset = posture[joint] - home[joint]
            posture[joint] = home[joint] + np.sign(offset) * max(abs(offset) - _STEP_RAD, 0.0)
        ends.append(float(posture[joint]))
    return ends[0], ends[1]


def _begins(strokes: tuple[Stroke, ...]) -> FloatArray:
    # Rest after each stroke [s].
    lengths = [stroke.duration_s + 0.2 for stroke in strokes]
    return np.concatenate([[0.0], np.cumsum(lengths)])


def _sampled(home: FloatArray, strokes: tuple[Stroke, ...], rate_hz: float) -> JointMotion:
    begins = _begins(strokes)
    times = even_times(float(begins[-1]), rate_hz)
    q = np.repeat(np.asarray(home)[None], len(times), axis=0)
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    rows = np.searchsorted(times, begins)
    for place, stroke in enumerate(strokes):
        # The very last sample belongs to the rest after the last stroke.
        stroke_rows = slice(rows[place], rows[place + 1] if place + 1 < len(strokes) else None)
        at = stroke.at(times[stroke_rows] - begins[place])
        (
            q[stroke_rows, stroke.joint],
            dq[stroke_rows, stroke.joint],
            ddq[stroke_rows, stroke.joint],
        ) = at
    return JointMotion(times, q, dq, ddq)
