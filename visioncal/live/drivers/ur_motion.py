"""What the joints of a Universal Robots arm do, at the controller's full rate."""

import threading

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.live.drivers.extras import client_library
from visioncal.live.drivers.protocols import JointSample
from visioncal.live.drivers.ur import check_controller, keep
from visioncal.live.drivers.ur_net import resolve
from visioncal.live.drivers.ur_watch import StateStream

_EXTRA = "ur"
# States a second of the e-Series and of the CB3, by PolyScope's major version.
_RATES_HZ = {3: 125.0, 5: 500.0}
_CLOSE_S = 0.9


class UrMotion:
    """The joints of a UR, which is only watched: who moves it is not asked.

    Args:
        host: The controller's address.

    Raises:
        DriverError: The client library is missing, or the host is unreachable or no UR.
    """

    def __init__(self, host: str) -> None:
        receive = client_library("rtde_receive", _EXTRA)
        address = resolve(host)
        condition = check_controller(address, moves=False)
        self.name = f"{condition.model} at {host}"
        self.model = condition.model.lower()
        self.rate_hz = _RATES_HZ[condition.version[0]]
        self._states = StateStream(receive, address, condition.version, self.rate_hz)

    def sample(self) -> JointSample:
        """Waits for the next state that the controller sends.

        Raises:
            DriverError: None comes for 0.8 s, or the arm was stopped.
        """
        client = self._states.client
        while True:
            stamp_s = self._states.wait()
            q, dq, currents = client.getActualQ(), client.getActualQd(), client.getActualCurrent()
            # Another state that came in between would mix with this one.
            if client.getTimestamp() == stamp_s:
                break
        if self._states.safety not in ("normal", "reduced"):
            raise DriverError(
                f"The {self.name} is stopped: {self._states.safety}.",
                culprits=[self.name],
                next_step="See the pendant, and record the motion again from its beginning.",
            )
        return JointSample(stamp_s, np.array(q), np.array(dq), np.array(currents))

    def close(self) -> None:
        """Lets go of it."""
        keep(self._states.client)
        # A client whose controller is gone may not return at all.
        going = threading.Thread(target=self._states.client.disconnect, daemon=True)
        going.start()
        going.join(_CLOSE_S)
