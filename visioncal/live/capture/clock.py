"""The clock by which a recording goes."""

import time
from typing import Protocol


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
