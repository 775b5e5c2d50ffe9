"""Devices of a live cell and their clock."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.drivers.protocols import Arm, ArmState, CameraDevice, MovingArm, StoredPictures

# Greatest age of a state [s].
_STALE_S = 1.0
_STOPPED = {
    "protective-stop": "Look at what the arm ran into, clear the stop on the pendant (Enable "
    "Robot),",
    "emergency-stop": "Make sure that nobody is near, release the stop button, start the robot on "
    "the pendant,",
    "fault": "Read the fault on the pendant, restart the robot there,",
}


class HostClock:
    """The host's monotonic clock, by which arm and camera stamp."""

    def now(self) -> float:
        """The time [s]."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Waits."""
        time.sleep(seconds)

    def unix_offset_s(self) -> float:
        """Offset from this clock to UNIX time [s]."""
        return time.time() - time.monotonic()


@dataclass(frozen=True, eq=False)
class LiveCell:
    """An arm, the camera on it or beside it, and the clock by which they stamp."""

    arm: Arm
    camera: CameraDevice
    clock: HostClock = field(default_factory=HostClock)

    @property
    def is_stored(self) -> bool:
        """Whether each picture is another view's, and is taken without waiting for rest."""
        return isinstance(self.camera, StoredPictures)

    def state(self) -> ArmState:
        """Reads the arm's state; raises DriverError."""
        state = self.arm.state()
        age_s = self.clock.now() - state.stamp_s
        if age_s > _STALE_S:
            # This computer may have been suspended in between.
            state = self.arm.state()
            age_s = self.clock.now() - state.stamp_s
        if state.safety in _STOPPED:
            words = state.safety.replace("-", " ")
            raise DriverError(
                f"{self.arm.name}: {words}: the arm stands still, and no view was taken there.",
                culprits=[self.arm.name],
                next_step=f"{_STOPPED[state.safety]} and go on.",
            )
        if age_s > _STALE_S:
            raise DriverError(
                f"{self.arm.name}: its newest state is {age_s:.1f} s old, but must be "
                f"of the last {_STALE_S:g} s.",
                culprits=[self.arm.name],
                next_step="Check the network cable to the controller.",
            )
        return state

    def joints(self) -> FloatArray:
        """Present joint angles (n,) [rad]; raises DriverError."""
        q = self.state().q
        if q is None:
            raise DriverError(
                f"{self.arm.name}: it does not report its joint angles, and cannot be driven by "
                "them.",
                culprits=[self.arm.name],
                next_step="Guide it by hand: --follow.",
            )
        return q

    @contextmanager
    def halting(self) -> Iterator[None]:
        """Runs a block, and halts the arm if it raises."""
        try:
            yield
        except BaseException:
            if isinstance(self.arm, MovingArm):
                self.arm.halt()
            raise
