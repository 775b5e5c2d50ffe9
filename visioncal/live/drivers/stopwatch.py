"""Stopwatch for timeouts that ignores stalls of this computer."""

import time
from collections.abc import Callable

# Most time that counts between two readings [s]: waiting callers read more often, and anything
# longer is a stall of this computer.
_LONGEST_S = 0.2


class Stopwatch:
    """Time since its start during which this program ran.

    It is read repeatedly while waiting for a device. When a virtual machine pauses or a computer
    swaps, all devices seem late at once, though none was silent.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self.restart()

    def restart(self) -> None:
        """Sets it to zero."""
        self._read_s, self._sum_s = self._now(), 0.0

    def read(self) -> float:
        """Time since its start without stalls [s]."""
        now = self._now()
        self._sum_s += min(now - self._read_s, _LONGEST_S)
        self._read_s = now
        return self._sum_s
