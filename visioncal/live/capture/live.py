"""The devices of a live cell and its clock, and what holds of every moment of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Arm, ArmState, CameraDevice, MovingArm

# A state older than this is no news [s].
_STALE_S = 1.0
_STOPPED = {
    "protective-stop": "Look at what the arm ran into, clear the stop on the pendant (Enable "
    "Robot),",
    "emergency-stop": "Make sure that nobody is near, release the stop button, start the robot on "
    "the pendant,",
    "fault": "Read the fault on the pendant, restart the robot there,",
}


class Clock(Protocol):
    """A clock that never goes back, and a way to wait by it."""

    def now(self) -> float:
        """The time, on the clock by which arm and camera stamp [s]."""

    def sleep(self, seconds: float) -> None:
        """Waits."""

    def unix_offset_s(self) -> float:
        """What makes a time of this clock a UNIX time [s]."""


class HostClock:
    """The host's monotonic clock."""

    def now(self) -> float:
        """The time [s]."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Waits."""
        time.sleep(seconds)

    def unix_offset_s(self) -> float:
        """What makes a time of this clock a UNIX time [s]."""
        return time.time() - time.monotonic()


@dataclass(frozen=True, eq=False)
class LiveCell:
    """An arm and a camera, and the clock by which they stamp."""

    arm: Arm
    camera: CameraDevice
    clock: Clock = field(default_factory=HostClock)

    def state(self) -> ArmState:
        """Asks the arm where it is, and whether it may move.

        Raises:
            DriverError: It is stopped, its link is lost, or what it says is old.
        """
        state = self.arm.state()
        old_s = self.clock.now() - state.stamp_s
        if old_s > _STALE_S:
            # This computer may have slept in between.
            state = self.arm.state()
            old_s = self.clock.now() - state.stamp_s
        if state.safety in _STOPPED:
            words = state.safety.replace("-", " ")
            raise DriverError(
                f"{self.arm.name}: {words}: the arm stands still, and no view was taken there.",
                culprits=[self.arm.name],
                next_step=f"{_STOPPED[state.safety]} and go on with --resume.",
            )
        if old_s > _STALE_S:
            raise DriverError(
                f"{self.arm.name}: its newest state is {old_s:.1f} s old; one of the last "
                f"{_STALE_S:g} s is needed.",
                culprits=[self.arm.name],
                next_step="Check the network cable to the controller.",
            )
        return state

    @contextmanager
    def halting(self) -> Iterator[None]:
        """Runs a block after which the arm stands still, however the block ends."""
        try:
            yield
        except BaseException:
            if isinstance(self.arm, MovingArm):
                self.arm.halt()
            raise
