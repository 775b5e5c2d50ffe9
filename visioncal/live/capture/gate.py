"""The gate that every command passes before it moves an arm: limits, collisions, consent."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import pose_difference
from visioncal.core.types import FloatArray
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.drivers.protocols import MovingArm
from visioncal.planning.cell import PlanCell
from visioncal.planning.path import order_stops
from visioncal.robot import Robot

# Largest joint error at the end of a motion [rad]; an arm that was stopped nearer to its goal gives
# as good a view.
_ARRIVED_RAD = 2e-2
# Greatest flange difference between a nominal model and its own arm; beyond, the paths were checked
# for another arm or another base.
_SAME_ARM_MM = 50.0


def travel_s(pace: CaptureOptions, start: FloatArray, end: FloatArray) -> float:
    """Duration of a motion with a trapezoidal or triangular speed profile [s]."""
    distance = float(np.abs(np.asarray(end) - start).max(initial=0.0))
    if distance * pace.acceleration < pace.speed**2:
        return float(2.0 * np.sqrt(distance / pace.acceleration))
    return distance / pace.speed + pace.speed / pace.acceleration


@dataclass(eq=False)
class Consent:
    """A person's consent to motions: to all by `--yes`, else asked for at a terminal."""

    # Asks, and returns the typed line; None once all motions are allowed.
    ask: Callable[[str], str] | None

    @classmethod
    def of(cls, ask: Callable[[str], str], *, yes: bool) -> Self:
        """How `record` gets consent; raises DataError."""
        if not (yes or sys.stdin.isatty()):
            raise DataError(
                "record: nobody can be asked whether the arm may move, as stdin is not a terminal.",
                culprits=["--yes"],
                next_step="Give --yes where the cell is clear and somebody holds the stop button.",
            )
        return cls(None if yes else ask)

    def to(self, motion: str) -> None:
        """Asks for consent to one motion; `a` allows all that follow, too; raises DataError."""
        while self.ask is not None:
            question = (
                f"{motion}. Is the cell clear, and a hand on the stop button? "
                "[y]es, [a]ll that follow, [n]o: "
            )
            try:
                answer = self.ask(question).strip().lower()
            except EOFError:
                answer = "n"
            if answer in ("n", "no", "q"):
                raise DataError(
                    f"not driven without consent: {motion}. The arm stands still.",
                    culprits=["stdin"],
                    next_step="Look at the cell, and run the command again.",
                )
            if answer in ("a", "all"):
                self.ask = None
            if answer in ("y", "yes"):
                return


@dataclass(frozen=True, eq=False)
class Gate:
    """The one way by which a command moves an arm."""

    live: LiveCell
    robot: Robot  # The arm's model, as in its controller.
    consent: Consent
    pace: CaptureOptions  # Its speed and acceleration.

    def move(
        self, postures: Sequence[FloatArray], motion: str, look: Callable[[], None] = lambda: None
    ) -> None:
        """Drives through checked postures (n,) [rad], with consent, until it is at the last.

        The arm's state is monitored throughout. An exception leaves the arm moving;
        `LiveCell.halting` around it stops it.

        Args:
            postures: The postures, as from `clear_path`.
            motion: What is about to happen, for the question.
            look: Called periodically on the way.

        Raises:
            DataError: There is no consent, or a posture is beyond the joints' limits.
            DriverError: The arm cannot be driven, was stopped, its connection is lost, it takes too
                long, or it did not reach its goal.
            VisioncalError: From `look`.
        """
        live, name = self.live, self.live.arm.name
        for posture in postures:
            check_limits(self.robot, posture)
        self.consent.to(f"{name} will move {motion}")
        if not isinstance(live.arm, MovingArm):
            raise DriverError(
                f"{name} cannot be driven.", culprits=[name], next_step="Guide it by hand."
            )
        for goal in postures:
            expected_s = travel_s(self.pace, live.joints(), goal)
            live.arm.start_move(goal, speed=self.pace.speed, acceleration=self.pace.acceleration)
            self._wait(live.arm, expected_s, look)
            off_rad = np.abs(live.joints() - goal)
            if off_rad.max() > _ARRIVED_RAD:
                joint = int(off_rad.argmax())
                raise DriverError(
                    f"{name}: the motion ended {np.rad2deg(off_rad[joint]):.1f} deg before its "
                    f"goal in joint {joint + 1}; within {np.rad2deg(_ARRIVED_RAD):.1f} deg is "
                    "needed.",
                    culprits=[name],
                    next_step="Was it stopped on the pendant? Start it again there.",
                )

    def _wait(self, arm: MovingArm, expected_s: float, look: Callable[[], None]) -> None:
        """Waits until a started arm has stopped, which it should after the expected time [s]."""
        clock = self.live.clock
        start = last_look = clock.now()
        while True:
            # The time is read before the state: during a stall of this computer or a slow picture
            # the arm moves on by itself, so that only a newer state can show that it is late.
            elapsed_s = clock.now() - start
            self.live.state()
            if not arm.moving():
                return
            # Half as long again, and three seconds: then it has failed.
            if elapsed_s > 1.5 * expected_s + 3.0:
                raise DriverError(
                    f"{arm.name}: still moving after {elapsed_s:.1f} s, where {expected_s:.1f} s "
                    "were expected.",
                    culprits=[arm.name],
                    next_step="Check the speed slider on the pendant, and whether somebody holds "
                    "the arm.",
                )
            # A failure of camera or disk is noticed within a second.
            if clock.now() - last_look > 0.3:
                look()
                last_look = clock.now()
            clock.sleep(0.02)


def check_same_arm(live: LiveCell, robot: Robot, q: FloatArray) -> None:
    """Checks that an arm at joint angles (n,) is the one whose paths were checked, in that base.

    Raises:
        DataError: It has other joints, or its flange is elsewhere.
    """
    if len(q) != robot.joint_count:
        raise DataError(
            f"{live.arm.name} has {len(q)} joints, and its model {robot.name} has "
            f"{robot.joint_count}.",
            culprits=["--arm", "--plan"],
            next_step="Name the arm that is connected; a plan is of one arm.",
        )
    reported = live.state().base_from_flange
    off_mm, off_deg = pose_difference(robot.base_from_flange(q[None])[0], reported)
    if off_mm > _SAME_ARM_MM:
        raise DataError(
            f"{live.arm.name}: its flange is {off_mm:.0f} mm and {off_deg:.0f} deg from where the "
            f"model {robot.name} has it at these joints (limit {_SAME_ARM_MM:.0f} mm).",
            culprits=["--plan"],
            next_step="Name the arm that is connected, in its controller's base; a plan is of one "
            "arm.",
        )


def check_limits(robot: Robot, q: FloatArray) -> None:
    """Checks joint angles (n,) [rad] against the arm's limits; raises DataError."""
    outside = (q < robot.lower_rad) | (q > robot.upper_rad)
    if outside.any():
        joint = robot.joint_names[int(np.argmax(outside))]
        raise DataError(
            f"{joint} stands at {np.rad2deg(q[np.argmax(outside)]):.1f} deg, outside the limits of "
            f"{robot.name}.",
            culprits=[joint],
            next_step="Turn it back by hand.",
        )


def clear_path(
    cell: PlanCell, q: FloatArray, goal: FloatArray, name: str
) -> tuple[FloatArray, ...]:
    """Finds postures (n,) to a goal (n,) [rad], clear of everything declared; the goal is last.

    Args:
        cell: The cell.
        q: (n,) where the arm stands [rad].
        goal: (n,) where it shall go [rad].
        name: What the goal is, for messages.

    Raises:
        DataError: There is none, or the arm stands too near to something or beyond its limits.
    """
    check_limits(cell.robot, q)
    route = order_stops(cell, q, goal[None])
    if route.unreachable:
        (obstacle,) = route.unreachable.values()
        angles = ", ".join(f"{value:.0f}" for value in np.rad2deg(q))
        raise DataError(
            f"{name}: no clear way leads there from where the arm stands ({angles} deg): in the "
            f"way are {obstacle}.",
            culprits=[name],
            next_step="Bring the arm near to it by hand, or plan anew with --start-joints as it "
            "stands.",
        )
    return (*route.segments[0], goal)
