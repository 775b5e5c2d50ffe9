"""Motions of simulated joints: straight paths with a trapezoidal speed profile, and braking.

A motion is a function of time, not a table of ticks: the joints are defined at any moment, however
late the simulating process is scheduled.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from visioncal.core.types import FloatArray


class Motion(Protocol):
    """Joints as a function of the time since the start of a motion."""

    @property
    def duration_s(self) -> float:
        """Duration [s]; afterwards the joints are at rest."""

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s]."""


@dataclass(frozen=True, eq=False)
class Rest:
    """Joints at rest."""

    q: FloatArray
    duration_s: float = 0.0

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002
        """The same posture at any time."""
        return self.q, np.zeros_like(self.q)


@dataclass(frozen=True)
class Profile:
    """Trapezoidal speed profile from rest to rest; a triangle over a short distance.

    Attributes:
        distance: Length of the path [rad or m].
        speed: Speed limit.
        acceleration: Acceleration and deceleration.
    """

    distance: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """Greatest speed that is reached."""
        return min(self.speed, float(np.sqrt(self.distance * self.acceleration)))

    @property
    def duration_s(self) -> float:
        """Duration [s]."""
        if self.distance == 0.0:
            return 0.0
        return self.distance / self.peak + self.peak / self.acceleration

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Distance travelled and speed."""
        remaining_s = self.duration_s - elapsed_s
        if remaining_s <= 0.0:
            return self.distance, 0.0
        ramp = self.peak / self.acceleration
        if elapsed_s < ramp:
            return 0.5 * self.acceleration * elapsed_s**2, self.acceleration * elapsed_s
        if remaining_s < ramp:
            return (
                self.distance - 0.5 * self.acceleration * remaining_s**2,
                self.acceleration * remaining_s,
            )
        return self.peak * (elapsed_s - 0.5 * ramp), self.peak


@dataclass(frozen=True, eq=False)
class JointPath:
    """Path of the joints through postures, straight in between, without stops.

    Attributes:
        knots: (k, n) postures, from the first to the last [rad].
        distances: (k,) distance along the path of each, from 0 to the profile's distance.
    """

    knots: FloatArray
    distances: FloatArray
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
        after = int(np.clip(np.searchsorted(self.distances, place), 1, len(self.distances) - 1))
        span = self.distances[after] - self.distances[after - 1]
        slope = (self.knots[after] - self.knots[after - 1]) / span
        return self.knots[after - 1] + slope * (place - self.distances[after - 1]), slope * speed


def joint_path(
    start: FloatArray, goal: FloatArray, *, speed: float, acceleration: float
) -> JointPath:
    """Straight path of all joints between postures (n,) [rad].

    Speed [rad/s] and acceleration [rad/s^2] are of the joint that travels farthest.
    """
    distance = float(np.abs(goal - start).max())
    return JointPath(
        np.array([start, goal]),
        np.array([0.0, distance]),
        Profile(distance, speed, acceleration),
    )


def sampled_way(
    knots: Sequence[FloatArray], distance: float, *, speed: float, acceleration: float
) -> JointPath:
    """Path of a length [m] through evenly spaced postures (n,) [rad], at most at a speed [m/s]."""
    distances = np.linspace(0.0, distance, len(knots))
    return JointPath(np.array(knots), distances, Profile(distance, speed, acceleration))


@dataclass(frozen=True, eq=False)
class Brake:
    """Joints that brake together in proportion to their speeds.

    Attributes:
        q: (n,) joint angles at the start [rad].
        dq: (n,) speeds at the start [rad/s].
        deceleration: Deceleration of the fastest joint [rad/s^2].
    """

    q: FloatArray
    dq: FloatArray
    deceleration: float

    @property
    def duration_s(self) -> float:
        """Time until all joints are at rest [s]."""
        return float(np.abs(self.dq).max()) / self.deceleration

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) joint angles [rad] and (n,) speeds [rad/s]."""
        duration_s = self.duration_s
        if duration_s == 0.0:
            return self.q, np.zeros_like(self.q)
        share = min(max(elapsed_s, 0.0) / duration_s, 1.0)
        return self.q + self.dq * duration_s * share * (1.0 - 0.5 * share), self.dq * (1.0 - share)
