"""Stream of a UR's states, with detection of silence."""

import time
from collections import deque
from types import ModuleType
from typing import Any

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Safety
from visioncal.live.drivers.stopwatch import Stopwatch
from visioncal.live.drivers.ur_status import safety_of

# Only names in the client's own table of variables: an unknown one would silently shift all that
# follow.
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
# Variables of newer controllers, and the first version, by major version.
_PAYLOAD = ("payload", "payload_cog")
_REPORTS_PAYLOAD = {3: (3, 11, 0), 5: (5, 5, 1)}
# Fast compared with the arm's motion, at a small load of the computer.
_RATE_HZ = 125.0
# Silence after which a controller, which sends every 8 ms, counts as lost [s].
_SILENCE_S = 0.8
_POLL_S = 0.0005
# Time over which the shortest delay from the controller is taken [s]: clocks drift by less than a
# millisecond in it.
_DELAYS_S = 10.0


class StateStream:
    """States of a controller in the order of arrival.

    Args:
        library: The module `rtde_receive`.
        host: The controller's address.
        version: PolyScope's version.
        rate_hz: Requested states per second.
    """

    def __init__(
        self,
        library: ModuleType,
        host: str,
        version: tuple[int, int, int],
        rate_hz: float = _RATE_HZ,
    ) -> None:
        self._host = host
        self.reports_payload = version >= _REPORTS_PAYLOAD[version[0]]
        names = [*_VARIABLES, *(_PAYLOAD if self.reports_payload else ())]
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
        """Whether states arrive."""
        stamp = self.client.getTimestamp()
        if stamp != self._newest:
            self._newest = stamp
            self._silence.restart()
        return bool(self.client.isConnected()) and self._silence.read() < _SILENCE_S

    def check(self) -> None:
        """Checks that states arrive.

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
            The controller's timestamp [s].

        Raises:
            DriverError: None arrives.
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
        """Converts a controller timestamp to the monotonic clock, by the shortest recent delay [s].

        A state may be noticed late, but never early.
        """
        return stamp + min(delay for _, delay in self._delays)

    @property
    def safety(self) -> Safety:
        """State of the safety system."""
        return safety_of(int(self.client.getSafetyStatusBits()))
