"""Driving an arm from posture to posture, under a watchdog."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.capture.live import Clock, LiveArm
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.drivers.protocols import MovingArm

# Polling interval of the arm while it moves [s].
_POLL_S = 0.02
# Polling interval of camera and disk [s]: a failure is noticed within a second.
_GLANCE_S = 0.3
# A motion has failed after this factor times its expected duration plus this [s].
_DURATION_FACTOR, _DURATION_EXTRA_S = 1.5, 3.0
# Largest joint error at the end of a motion [rad]; an arm that was stopped nearer to its goal gives
# as good a view.
_ARRIVED_RAD = 2e-2


@dataclass(frozen=True)
class JointPace:
    """Speed of a synchronised joint motion, led by the joint that travels farthest."""

    speed: float  # Speed of that joint [rad/s].
    acceleration: float  # Its acceleration [rad/s^2].

    @classmethod
    def of(cls, options: CaptureOptions) -> "JointPace":
        """The pace of a recording."""
        return cls(options.speed, options.acceleration)

    def travel_s(self, start: FloatArray, end: FloatArray) -> float:
        """Duration of a motion with a trapezoidal or triangular speed profile [s]."""
        distance = float(np.abs(np.asarray(end) - start).max(initial=0.0))
        if distance * self.acceleration < self.speed**2:
            return float(2.0 * np.sqrt(distance / self.acceleration))
        return distance / self.speed + self.speed / self.acceleration

    def path_duration_s(self, postures: Iterable[FloatArray]) -> float:
        """Duration of a path from posture to posture [s]."""
        return sum(self.travel_s(start, end) for start, end in pairwise(postures))


def wait_until_stopped(
    arm: MovingArm,
    expected_s: float,
    clock: Clock,
    state: Callable[[], object],
    glance: Callable[[], None] = lambda: None,
) -> None:
    """Waits until a started arm has stopped; `glance` is called periodically.

    Raises:
        DriverError: The motion takes much longer than expected [s]; or from `state` or `glance`.
    """
    start = last_glance = clock.now()
    while True:
        # The time is read before the state: during a stall of this computer or a slow picture the
        # arm moves on by itself, so that only a newer state can show that it is late.
        elapsed_s = clock.now() - start
        state()
        if not arm.moving():
            return
        if elapsed_s > _DURATION_FACTOR * expected_s + _DURATION_EXTRA_S:
            raise DriverError(
                f"{arm.name}: still moving after {elapsed_s:.1f} s, where {expected_s:.1f} s were "
                "expected.",
                culprits=[arm.name],
                next_step="Check the speed slider on the pendant, and whether somebody holds the "
                "arm.",
            )
        if clock.now() - last_glance > _GLANCE_S:
            glance()
            last_glance = clock.now()
        clock.sleep(_POLL_S)


def drive(
    live: LiveArm,
    arm: MovingArm,
    postures: Iterable[FloatArray],
    pace: JointPace,
    *,
    look: Callable[[], None],
) -> None:
    """Drives through postures (n,) [rad] and waits until the arm has arrived at the last.

    Only `Gate.move` calls it. The arm's state is monitored throughout, and `look` is called
    periodically. An exception leaves the arm moving; `LiveArm.halting` around it stops it.

    Raises:
        DriverError: The arm was stopped, its connection is lost, it takes too long, or it did not
            reach its goal.
        VisioncalError: From `look`.
    """
    for goal in postures:
        expected_s = pace.travel_s(joints_of(live), goal)
        arm.start_move(goal, speed=pace.speed, acceleration=pace.acceleration)
        wait_until_stopped(arm, expected_s, live.clock, live.state, look)
        off_rad = np.abs(joints_of(live) - goal)
        if off_rad.max() > _ARRIVED_RAD:
            joint = int(off_rad.argmax())
            raise DriverError(
                f"{arm.name}: the motion ended {np.rad2deg(off_rad[joint]):.1f} deg before its "
                f"goal in joint {joint + 1}; within {np.rad2deg(_ARRIVED_RAD):.1f} deg is needed.",
                culprits=[arm.name],
                next_step="Was it stopped on the pendant? Start it again there, and go on with "
                "--resume.",
            )


def joints_of(live: LiveArm) -> FloatArray:
    """Present joint angles (n,) [rad].

    Raises:
        DriverError: The arm reports no state, or is stopped.
    """
    q = live.state().q
    if q is None:
        raise DriverError(
            f"{live.arm.name}: it does not report its joint angles, and cannot be driven by them.",
            culprits=[live.arm.name],
            next_step="Guide it by hand: --follow.",
        )
    return q
