"""Time by which others are called silent: a stall of this computer does not count."""

import time
from collections.abc import Callable

# Who waits reads the watch at least so often; what a reading takes beyond it, this computer slept
# or was busy elsewhere, and heard nobody [s].
_LONGEST_S = 0.2


class Stopwatch:
    """The time since its start in which this program ran.

    It is read again and again while something is waited for. A virtual machine that pauses, or a
    computer that swaps, sees all its partners late at once: none of them was silent.

    Args:
        now: The clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self.restart()

    def restart(self) -> None:
        """Sets it to zero."""
        self._read_s, self._sum_s = self._now(), 0.0

    def read(self) -> float:
        """The time since its start, what stalls took left out [s]."""
        now = self._now()
        self._sum_s += min(now - self._read_s, _LONGEST_S)
        self._read_s = now
        return self._sum_s
