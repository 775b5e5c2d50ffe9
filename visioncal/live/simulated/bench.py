"""A running simulated cell behind the real client library, and faults of its devices."""

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np

from visioncal.core.choices import Faults
from visioncal.core.types import FloatArray
from visioncal.live.capture.core import CaptureEvent
from visioncal.live.capture.live import LiveCell
from visioncal.live.drivers.ur import UrArm
from visioncal.live.simulated.camera import CameraFault, SimulatedCamera
from visioncal.live.simulated.cell import LiveSimulation
from visioncal.live.simulated.controller import Fault, SimulatedController, spawn

# An OAK's rate [1/s].
_RATE_HZ = 30.0
_AT_CONTROLLER: Mapping[str, Fault] = {
    "protective-stop": "protective-stop",
    "emergency-stop": "emergency-stop",
    "remote-off": "local-control",
    "link-lost": "die",
    "silent": "freeze",
}
_AT_CAMERA: Mapping[str, CameraFault] = {"unplugged": "unplugged", "covered": "covered"}
# Joint speeds above which the arm counts as moving, and below which as stopped [rad/s].
_MOVING_SPEED, _STOPPED_SPEED = 0.05, 1e-3
# Polling interval, delay of a fault after the start of a motion, and more than any motion between
# two stops takes, even on a busy computer [s].
_POLL_S, _INTO_MOTION_S, _PATIENCE_S = 0.02, 0.2, 60.0


class Bench:
    """A running simulated cell: its controller is another process, its camera renders the truth.

    Attributes:
        camera: The camera that observes the true arm.
    """

    def __init__(self, simulation: LiveSimulation, start_q: FloatArray) -> None:
        """Starts the controller, its arm at a posture [rad].

        Raises:
            DriverError: It does not start.
        """
        self._options, self._q = simulation.controller, start_q
        self.controller: SimulatedController = self._spawned(None)
        self.camera = SimulatedCamera(
            simulation.truth,
            lambda at_s: self.controller.state(at_s.tolist()).q,
            rate_hz=_RATE_HZ,
        )

    @contextmanager
    def connected(self) -> Iterator[LiveCell]:
        """Opens the arm as a recording does, and closes it.

        Raises:
            DriverError: It cannot be opened.
        """
        with closing(UrArm(self.controller.host)) as arm:
            yield LiveCell(arm, self.camera)

    def close(self) -> None:
        """Ends the controller."""
        self.controller.close()

    def inject(self, fault: Faults) -> None:
        """Lets a fault happen: of the controller in the next motion, of the camera after it."""
        self._wait(moving=True)
        if fault in _AT_CAMERA:
            self._wait(moving=False)
            self.camera.fault = _AT_CAMERA[fault]
            return
        time.sleep(_INTO_MOTION_S)
        # Where a controller that is restarted has its arm.
        self._q = self.controller.state([time.monotonic()]).q[0]
        self.controller.inject(_AT_CONTROLLER[fault])

    def mend(self, fault: Faults) -> None:
        """Ends a fault, as a person would do in the cell before going on."""
        self.camera.fault = "none"
        if fault == "link-lost":
            self.close()
            self.controller = self._spawned(self.controller.host)
        elif fault in _AT_CONTROLLER:
            for remedy in ("thaw", "release", "remote-control"):
                self.controller.inject(remedy)

    def _spawned(self, host: str | None) -> SimulatedController:
        return spawn(replace(self._options, q=tuple(self._q.tolist())), host)

    def _wait(self, *, moving: bool) -> None:
        """Waits until the arm moves, or has stopped."""
        ends_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < ends_s:
            speed = float(np.abs(self.controller.state([time.monotonic()]).dq).max())
            if (speed > _MOVING_SPEED) if moving else (speed < _STOPPED_SPEED):
                return
            time.sleep(_POLL_S)


class FaultAfter:
    """Watcher that lets a fault happen after a number of stops."""

    def __init__(self, bench: Bench, fault: Faults, after: int) -> None:
        self._thread = threading.Thread(target=bench.inject, args=(fault,), daemon=True)
        self._after = after

    def stepped(self, step: CaptureEvent) -> None:
        """Starts the fault once that number of stops was visited."""
        if step.place == self._after:
            self._thread.start()
