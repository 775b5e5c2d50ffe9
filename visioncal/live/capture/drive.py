"""Driving an arm from posture to posture, under a watchdog."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.capture.live import Clock, LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.drivers.protocols import MovingArm

# How often the arm is asked while it moves [s].
_POLL_S = 0.02
# How often the camera and the disk are, and for how long a picture is waited for [s]; what fails
# is noticed within a second.
_GLANCE_S, _FRAME_S = 0.3, 0.5
# A motion may take so many times its time, and so much longer [s], before something is wrong.
_TIMES, _MORE_S = 1.5, 3.0
# An arm may tremble about its goal so far when it has arrived; one that was stopped is farther off,
# or stands where a view is as good [rad].
_ARRIVED_RAD = 2e-2


@dataclass(frozen=True)
class JointPace:
    """How fast joints turn together: the one that turns farthest leads.

    Attributes:
        speed: Of that joint [rad/s].
        acceleration: Likewise [rad/s^2].
    """

    speed: float
    acceleration: float

    @classmethod
    def of(cls, options: CaptureOptions) -> "JointPace":
        """That of a recording."""
        return cls(options.speed, options.acceleration)

    def travel_s(self, start: FloatArray, end: FloatArray) -> float:
        """How long they turn from one posture to another, by a trapezoid or a triangle [s]."""
        far = float(np.abs(np.asarray(end) - start).max(initial=0.0))
        if far * self.acceleration < self.speed**2:
            return float(2.0 * np.sqrt(far / self.acceleration))
        return far / self.speed + self.speed / self.acceleration

    def way_s(self, way: Iterable[FloatArray]) -> float:
        """How long they turn on a way from posture to posture [s]."""
        return sum(self.travel_s(start, end) for start, end in pairwise(way))


def watched(
    arm: MovingArm,
    expected_s: float,
    clock: Clock,
    state: Callable[[], object],
    glance: Callable[[], None] = lambda: None,
) -> None:
    """Waits until an arm that was started stands.

    Args:
        arm: The arm.
        expected_s: How long its motion should take [s].
        clock: The time.
        state: Asks the arm for its state; raises where it is stopped or lost.
        glance: Called every now and then while it moves.

    Raises:
        DriverError: It takes too long; or from `state` or `glance`.
    """
    begun = glanced = clock.now()
    while True:
        # It is late where it still moves after this moment, by a state that is newer: what a stall
        # of this computer or a slow picture takes, it moves on by itself.
        took = clock.now() - begun
        state()
        if not arm.moving():
            return
        if took > _TIMES * expected_s + _MORE_S:
            raise DriverError(
                f"{arm.name}: still moving after {took:.1f} s, where {expected_s:.1f} s were "
                "expected.",
                culprits=[arm.name],
                next_step="Check the speed slider on the pendant, and whether somebody holds the "
                "arm.",
            )
        if clock.now() - glanced > _GLANCE_S:
            glance()
            glanced = clock.now()
        clock.sleep(_POLL_S)


def drive(
    cell: LiveCell,
    arm: MovingArm,
    postures: Iterable[FloatArray],
    options: CaptureOptions,
    *,
    look: Callable[[], None],
) -> None:
    """Drives through postures and waits until the arm has arrived at the last.

    The arm's state is watched all along. What is raised leaves the arm moving; `LiveCell.halting`
    around the recording stops it.

    Args:
        cell: The devices.
        arm: Its arm.
        postures: (n,) joint angles each [rad].
        options: Speed and acceleration.
        look: Called every now and then on the way; raises where it makes no sense to go on.

    Raises:
        DriverError: The arm was stopped, its link is lost, it takes too long, or it ended
            elsewhere.
        VisioncalError: From `look`.
    """

    def glance() -> None:
        # What is gone is reported now, not at the end of a long way.
        cell.camera.frame(timeout_s=_FRAME_S)
        look()

    for posture in postures:
        _move(cell, arm, posture, options, glance)


def _move(
    cell: LiveCell,
    arm: MovingArm,
    goal: FloatArray,
    options: CaptureOptions,
    glance: Callable[[], None],
) -> None:
    pace = JointPace.of(options)
    expected_s = pace.travel_s(joints_of(cell), goal)
    arm.start_move(goal, speed=pace.speed, acceleration=pace.acceleration)
    watched(arm, expected_s, cell.clock, cell.state, glance)
    off = np.abs(joints_of(cell) - goal)
    if off.max() > _ARRIVED_RAD:
        joint = int(off.argmax())
        raise DriverError(
            f"{arm.name}: the motion ended {np.rad2deg(off[joint]):.1f} deg before its goal in "
            f"joint {joint + 1}; within {np.rad2deg(_ARRIVED_RAD):.1f} deg is needed.",
            culprits=[arm.name],
            next_step="Was it stopped on the pendant? Start it again there, and go on with "
            "--resume.",
        )


def joints_of(cell: LiveCell) -> FloatArray:
    """(n,) where the joints are [rad].

    Raises:
        DriverError: The arm reports no state, or is stopped.
    """
    q = cell.state().q
    if q is None:
        raise DriverError(
            f"{cell.arm.name}: it does not report its joint angles, and cannot be driven by them.",
            culprits=[cell.arm.name],
            next_step="Guide it by hand: --follow.",
        )
    return q
