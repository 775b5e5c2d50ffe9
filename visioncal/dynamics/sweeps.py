"""Sweeps at constant speed, one joint at a time: what friction is made of.

At constant speed there is no inertia in a joint's torque, and between both directions gravity
cancels: what is left is friction, speed by speed (Swevers, Verdonck and De Schutter 2007).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.types import FloatArray
from visioncal.dynamics.fourier import even_times
from visioncal.dynamics.limits import Allowed, Kept, kept_limits
from visioncal.dynamics.motion import JointMotion

# Ramps last at least, and constant speed is held at least [s].
_SHORTEST_RAMP_S, _SHORTEST_HOLD_S = 0.15, 0.4
# The arm rests after each stroke [s].
REST_S = 0.2
# Ways to where a sweep begins are driven at this share of the greatest speed.
_UNHURRIED = 0.2
# A joint sweeps at most so far [rad]; its room is felt for in steps [rad].
_WIDEST_RAD, _FEELER_RAD = 2.4, 0.1
# Postures that are tried, and those of them that are looked at closely.
_POSTURES, _CLOSELY = 300, 20
# A joint with less room cannot be swept [rad].
_LEAST_RAD = 0.2
# Ways are looked at all along, ramps and speeds are exact: torques are what is left to look at.
_FIGURES_HZ = 200.0


@dataclass(frozen=True)
class SweepRequest:
    """What sweeps are wished.

    Attributes:
        speeds: How many speeds a joint, evenly spaced in their logarithms.
        slowest_rad_s: The least of them [rad/s].
        hold_s: How long each is held, where there is room [s].
        seed: Of the postures that are tried.
    """

    speeds: int = 6
    slowest_rad_s: float = 0.02
    hold_s: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (2 <= self.speeds <= 30 and self.slowest_rad_s > 0.0):
            raise DataError(
                f"sweeps at {self.speeds} speeds from {self.slowest_rad_s:g} rad/s are wished; 2 "
                "to 30 speeds above zero are needed.",
                culprits=["--sweep-speeds"],
            )
        if not _SHORTEST_HOLD_S <= self.hold_s <= 60.0:
            raise DataError(
                f"sweeps of {self.hold_s:g} s are wished; {_SHORTEST_HOLD_S} to 60 s are needed.",
                culprits=["hold_s"],
            )


@dataclass(frozen=True)
class Stroke:
    """One joint's way from rest to rest: a ramp, constant speed, and the ramp back.

    The ramps are the fifth-order polynomials without acceleration at both ends, whose highest
    coefficient vanishes as they reach full speed half as far as that speed would have gone.

    Attributes:
        joint: Which one, counted from 0.
        begin: Where it begins [rad].
        end: Where it ends [rad].
        speed: The constant speed, above zero [rad/s].
        ramp_s: How long it takes to reach it [s].
        sweeps: Whether it is a sweep, or only the way to one.
    """

    joint: int
    begin: float
    end: float
    speed: float
    ramp_s: float
    sweeps: bool

    @property
    def duration_s(self) -> float:
        """How long it takes, without the rest after it [s]."""
        return abs(self.end - self.begin) / self.speed + self.ramp_s

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position, speed and acceleration (m,) at times from its beginning; rest after its end."""
        far, whole, ramp = abs(self.end - self.begin), self.duration_s, self.ramp_s
        late = times_s > 0.5 * whole
        # The second half is the first one backwards.
        since = np.clip(np.where(late, whole - times_s, times_s), 0.0, None)
        share = np.minimum(since / ramp, 1.0)
        gone = self.speed * (ramp * (share**3 - 0.5 * share**4) + np.maximum(since - ramp, 0.0))
        speed = self.speed * share**2 * (3.0 - 2.0 * share)
        rising = self.speed / ramp * 6.0 * share * (1.0 - share)
        sense = np.sign(self.end - self.begin)
        position = self.begin + sense * np.where(late, far - gone, gone)
        return position, sense * speed, sense * np.where(late, -rising, rising)


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Sweeps of all joints, from a posture and back to it.

    Attributes:
        home: (n,) the posture that the other joints stay in [rad].
        strokes: In their order.
        kept: What they use of the limits.
        left_out: Names of joints that have too little room.
    """

    home: FloatArray
    strokes: tuple[Stroke, ...]
    kept: Kept
    left_out: tuple[str, ...]

    @cached_property
    def begins_s(self) -> FloatArray:
        """(k + 1,) when each stroke begins, and when all is done [s]."""
        return _begins(self.strokes)

    def sampled(self, rate_hz: float) -> JointMotion:
        """The motion from its beginning to its end, evenly sampled."""
        return _sampled(self.home, self.strokes, rate_hz)


def plan_sweeps(allowed: Allowed, request: SweepRequest) -> Sweeps:
    """Plans sweeps of every joint, at several speeds, in both directions.

    The posture is, of many random ones, that in which the joint with the least room has most.

    Args:
        allowed: What they must keep.
        request: What is wished.

    Raises:
        DegenerateError: No posture leaves any joint room.
    """
    rng = np.random.default_rng(request.seed)
    turn = np.minimum(np.pi, allowed.half)
    drawn = allowed.middle + rng.uniform(-turn, turn, (_POSTURES, len(turn)))
    clear = drawn[allowed.collisions.first_contact(drawn) < 0]
    rooms = np.array([_room(allowed, value) for value in clear]).reshape(-1, len(turn), 2)
    order = np.argsort(-np.sort(rooms[:, :, 1] - rooms[:, :, 0], axis=1)[:, 0], kind="stable")
    breaches: tuple[str, ...] = ("everywhere something is too near",)
    for row in order[:_CLOSELY].tolist():
        found = _in_posture(allowed, request, clear[row], rooms[row])
        if found.strokes and not found.kept.breaches:
            return found
        breaches = found.kept.breaches or ("no joint has room",)
    raise DegenerateError(
        f"robot {allowed.robot.name}: no posture was found from which its joints could sweep; of "
        f"the last one tried, {breaches[0]}.",
        culprits=breaches,
        next_step="Leave the sweeps more room (--margin-deg, --clearance-mm, --floor), or leave "
        "them out (--no-sweeps).",
    )


def _in_posture(
    allowed: Allowed, request: SweepRequest, home: FloatArray, room: FloatArray
) -> Sweeps:
    strokes: list[Stroke] = []
    left_out = []
    for joint, name in enumerate(allowed.robot.joint_names):
        low, high = _surely(allowed, home, joint, *room[joint].tolist())
        if high - low < _LEAST_RAD:
            left_out.append(name)
            continue
        strokes += _joint_strokes(allowed, request, joint, float(home[joint]), low, high)
    kept = kept_limits(allowed, _sampled(home, tuple(strokes), _FIGURES_HZ))
    return Sweeps(home, tuple(strokes), kept, tuple(left_out))


def _joint_strokes(
    allowed: Allowed, request: SweepRequest, joint: int, home: float, low: float, high: float
) -> Iterator[Stroke]:
    """There and back at every speed, about the middle of the joint's room, and home again."""
    hardest, middle, room = float(allowed.acceleration[joint]), 0.5 * (low + high), high - low
    # The fastest that still leaves time between its ramps, each of 1.5 speeds per acceleration.
    least = _SHORTEST_RAMP_S + _SHORTEST_HOLD_S
    fastest = (np.sqrt(least**2 + 6.0 * room / hardest) - least) * hardest / 3.0
    fastest = min(float(fastest), float(allowed.speed[joint]))
    here = home
    for speed in np.geomspace(min(request.slowest_rad_s, fastest), fastest, request.speeds):
        ramp_s = max(_SHORTEST_RAMP_S, 1.5 * float(speed) / hardest)
        half = 0.5 * min(float(speed) * (ramp_s + request.hold_s), room)
        begin, end = middle - half, middle + half
        yield from _way(allowed, joint, here, begin)
        yield Stroke(joint, begin, end, float(speed), ramp_s, sweeps=True)
        yield Stroke(joint, end, begin, float(speed), ramp_s, sweeps=True)
        here = begin
    yield from _way(allowed, joint, here, home)


def _way(allowed: Allowed, joint: int, begin: float, end: float) -> Iterator[Stroke]:
    """The way to where a sweep begins, if there is one."""
    far, hardest = abs(end - begin), _UNHURRIED * float(allowed.acceleration[joint])
    if far == 0.0:
        return
    # On a short way all is ramp, which takes as long as the way at full speed.
    speed = min(
        _UNHURRIED * float(allowed.speed[joint]),
        float(np.sqrt(far * hardest / 1.5)),
        far / _SHORTEST_RAMP_S,
    )
    ramp_s = max(_SHORTEST_RAMP_S, 1.5 * speed / hardest)
    yield Stroke(joint, begin, end, speed, ramp_s, sweeps=False)


def _room(allowed: Allowed, home: FloatArray) -> FloatArray:
    """(n, 2) how far each joint can turn from a clear posture, as lowest and highest [rad]."""
    joints = range(len(home))
    return np.array([[_feel(allowed, home, joint, sense) for sense in (-1, 1)] for joint in joints])


def _feel(allowed: Allowed, home: FloatArray, joint: int, sense: int) -> float:
    """Where a joint stops on its way to one side, felt for in steps [rad]."""
    limit = (allowed.upper if sense > 0 else allowed.lower)[joint]
    far = min(abs(float(limit - home[joint])), 0.5 * _WIDEST_RAD)
    steps = np.append(np.arange(_FEELER_RAD, far, _FEELER_RAD), far)
    postures = np.repeat(home[None], len(steps), axis=0)
    postures[:, joint] += sense * steps
    hits = np.flatnonzero(allowed.collisions.first_contact(postures) >= 0)
    clear = steps[: hits[0]] if len(hits) else steps
    return float(home[joint] + sense * (clear[-1] if len(clear) else 0.0))


def _surely(
    allowed: Allowed, home: FloatArray, joint: int, low: float, high: float
) -> tuple[float, float]:
    """What is left of a joint's room where nothing is in the way between the steps either."""
    ends = []
    for end in (low, high):
        far = home.copy()
        far[joint] = end
        while far[joint] != home[joint] and allowed.collisions.on_the_way(home, far) >= 0:
            left = far[joint] - home[joint]
            far[joint] = home[joint] + np.sign(left) * max(abs(left) - _FEELER_RAD, 0.0)
        ends.append(float(far[joint]))
    return ends[0], ends[1]


def _begins(strokes: tuple[Stroke, ...]) -> FloatArray:
    lengths = [stroke.duration_s + REST_S for stroke in strokes]
    return np.concatenate([[0.0], np.cumsum(lengths)])


def _sampled(home: FloatArray, strokes: tuple[Stroke, ...], rate_hz: float) -> JointMotion:
    begins = _begins(strokes)
    times = even_times(float(begins[-1]), rate_hz)
    q = np.repeat(np.asarray(home)[None], len(times), axis=0)
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    rows = np.searchsorted(times, begins)
    for place, stroke in enumerate(strokes):
        # The last sample of all belongs to the rest after the last stroke.
        own = slice(rows[place], rows[place + 1] if place + 1 < len(strokes) else None)
        at = stroke.at(times[own] - begins[place])
        q[own, stroke.joint], dq[own, stroke.joint], ddq[own, stroke.joint] = at
    return JointMotion(times, q, dq, ddq)
