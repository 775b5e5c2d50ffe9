"""The stream of a UR's states: what the arm reports, and since when it has been silent."""

import time
from collections import deque
from types import ModuleType
from typing import Any

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Safety
from visioncal.live.drivers.stopwatch import Stopwatch
from visioncal.live.drivers.ur_status import safety_of

# Names that the client's own table of variables has; one that it lacks would shift all that
# follow, without a word.
_VARIABLES = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_current",
    "actual_TCP_pose",
    "joint_temperatures",
    "robot_mode",
    "runtime_state",
    "robot_status_bits",
    "safety_status_bits",
)
# What newer controllers report, and from which version on, by major version.
_LOAD = ("payload", "payload_cog")
_REPORTS_LOAD = {3: (3, 11, 0), 5: (5, 5, 1)}
# The arm's motion is slow beside it, the computer's load is small.
_RATE_HZ = 125.0
# A controller sends every 8 ms; after this silence it is gone [s].
_SILENCE_S = 0.8
_POLL_S = 0.0005
# For how long the shortest delay between controller and here is remembered [s]: clocks drift by
# less than a millisecond in it.
_DELAYS_S = 10.0


class StateStream:
    """States in the order of their arrival.

    Args:
        library: The module `rtde_receive`.
        host: The controller's address.
        version: PolyScope's version.
        rate_hz: How many states a second are asked for.
    """

    def __init__(
        self,
        library: ModuleType,
        host: str,
        version: tuple[int, int, int],
        rate_hz: float = _RATE_HZ,
    ) -> None:
        self._host = host
        self.reports_load = version >= _REPORTS_LOAD[version[0]]
        names = [*_VARIABLES, *(_LOAD if self.reports_load else ())]
        try:
            self.client: Any = library.RTDEReceiveInterface(host, rate_hz, names)
        except RuntimeError as error:
            raise DriverError(
                f"The states of the controller at {host} cannot be read: {error}.", culprits=[host]
            ) from error
        self._newest = self.client.getTimestamp()
        self._silence = Stopwatch()
        self._delays: deque[tuple[float, float]] = deque()

    @property
    def alive(self) -> bool:
        """Whether states come in."""
        stamp = self.client.getTimestamp()
        if stamp != self._newest:
            self._newest = stamp
            self._silence.restart()
        return bool(self.client.isConnected()) and self._silence.read() < _SILENCE_S

    def check(self) -> None:
        """Checks that states come in.

        Raises:
            DriverError: None came for 0.8 s, or the connection is closed.
        """
        if self.alive:
            return
        how = (
            f"it has sent nothing for {self._silence.read():.1f} s"
            if self.client.isConnected()
            else "it closed the connection"
        )
        raise DriverError(
            f"The controller at {self._host} is lost: {how}.",
            culprits=[self._host],
            next_step="Look at the robot: it may be switched off, or its cable is out. Connect "
            "again once the pendant has started.",
        )

    def wait(self) -> float:
        """Waits for a state that is sent after the call.

        Returns:
            The controller's stamp of it [s].

        Raises:
            DriverError: None comes.
        """
        before = self.client.getTimestamp()
        while (stamp := float(self.client.getTimestamp())) == before:
            self.check()
            time.sleep(_POLL_S)
        now = time.monotonic()
        self._newest = stamp
        self._silence.restart()
        self._delays.append((now, now - stamp))
        while self._delays[0][0] < now - _DELAYS_S:
            self._delays.popleft()
        return stamp

    def host_time(self, stamp: float) -> float:
        """Puts a stamp of the controller on the monotonic clock [s].

        A state may be noticed late, never early: the shortest delay of late is the best.
        """
        return stamp + min(delay for _, delay in self._delays)

    @property
    def safety(self) -> Safety:
        """Whether the safety system lets it move."""
        return safety_of(int(self.client.getSafetyStatusBits()))
