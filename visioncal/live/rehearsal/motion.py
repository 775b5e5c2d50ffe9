"""How simulated joints move: straight ways with trapezoidal speed, and braking.

A motion is a function of time, not a table of ticks: where the joints stand is known at any moment,
however late the process that simulates them gets the processor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from visioncal.core.types import FloatArray


class Motion(Protocol):
    """Joints as a function of the time since the motion began."""

    @property
    def duration_s(self) -> float:
        """When it ends [s]; from then on, the joints stand."""

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) joint angles [rad] and (n,) speeds [rad/s]."""


@dataclass(frozen=True, eq=False)
class Rest:
    """Joints that stand."""

    q: FloatArray
    duration_s: float = 0.0

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002
        """The same posture at any time."""
        return self.q, np.zeros_like(self.q)


@dataclass(frozen=True)
class Profile:
    """A way from rest to rest, its speed a trapezoid or, on a short way, a triangle.

    Attributes:
        distance: Length of the way [rad or m].
        speed: Greatest speed.
        acceleration: Of speeding up and of braking.
    """

    distance: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """The greatest speed that is reached."""
        return min(self.speed, float(np.sqrt(self.distance * self.acceleration)))

    @property
    def duration_s(self) -> float:
        """How long the way takes [s]."""
        if self.distance == 0.0:
            return 0.0
        return self.distance / self.peak + self.peak / self.acceleration

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """The way that is behind and the speed."""
        left = self.duration_s - elapsed_s
        if left <= 0.0:
            return self.distance, 0.0
        ramp = self.peak / self.acceleration
        if elapsed_s < ramp:
            return 0.5 * self.acceleration * elapsed_s**2, self.acceleration * elapsed_s
        if left < ramp:
            return self.distance - 0.5 * self.acceleration * left**2, self.acceleration * left
        return self.peak * (elapsed_s - 0.5 * ramp), self.peak


@dataclass(frozen=True, eq=False)
class Way:
    """Joints on straight lines from posture to posture, in one sweep.

    Attributes:
        knots: (k, n) the postures, from the first to the last [rad].
        places: (k,) how far along the way each lies, from 0 to the profile's distance.
        profile: The progress along it.
    """

    knots: FloatArray
    places: FloatArray
    profile: Profile

    @property
    def duration_s(self) -> float:
        """When it ends [s]."""
        return self.profile.duration_s

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) joint angles [rad] and (n,) speeds [rad/s]."""
        if self.profile.distance == 0.0:
            return self.knots[-1], np.zeros(self.knots.shape[1])
        place, speed = self.profile.at(max(0.0, elapsed_s))
        after = int(np.clip(np.searchsorted(self.places, place), 1, len(self.places) - 1))
        span = self.places[after] - self.places[after - 1]
        slope = (self.knots[after] - self.knots[after - 1]) / span
        return self.knots[after - 1] + slope * (place - self.places[after - 1]), slope * speed


def joint_way(start: FloatArray, goal: FloatArray, *, speed: float, acceleration: float) -> Way:
    """All joints together, straight from posture to posture.

    Args:
        start: (n,) from here [rad].
        goal: (n,) to here [rad].
        speed: Of the joint that turns farthest [rad/s].
        acceleration: Likewise [rad/s^2].
    """
    distance = float(np.abs(goal - start).max())
    return Way(
        np.array([start, goal]),
        np.array([0.0, distance]),
        Profile(distance, speed, acceleration),
    )


def sampled_way(
    knots: Sequence[FloatArray], distance: float, *, speed: float, acceleration: float
) -> Way:
    """A way through postures that lie evenly along it, as those under a straight line of the tool.

    Args:
        knots: The postures [rad].
        distance: Length of the way [m].
        speed: [m/s].
        acceleration: [m/s^2].
    """
    places = np.linspace(0.0, distance, len(knots))
    return Way(np.array(knots), places, Profile(distance, speed, acceleration))


@dataclass(frozen=True, eq=False)
class Brake:
    """Joints that slow down together, each in its direction.

    Attributes:
        q: (n,) where it begins [rad].
        dq: (n,) the speeds there [rad/s].
        deceleration: Of the fastest joint [rad/s^2].
    """

    q: FloatArray
    dq: FloatArray
    deceleration: float

    @property
    def duration_s(self) -> float:
        """When all joints stand [s]."""
        return float(np.abs(self.dq).max()) / self.deceleration

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) joint angles [rad] and (n,) speeds [rad/s]."""
        whole = self.duration_s
        if whole == 0.0:
            return self.q, np.zeros_like(self.q)
        share = min(max(elapsed_s, 0.0) / whole, 1.0)
        return self.q + self.dq * whole * share * (1.0 - 0.5 * share), self.dq * (1.0 - share)
