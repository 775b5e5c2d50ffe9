"""Simulated devices of a rehearsal behind the real client libraries, and fault injection."""

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
from visioncal.live.rehearsal.camera import Fault as CameraFault
from visioncal.live.rehearsal.camera import Pace, RehearsalCamera
from visioncal.live.rehearsal.cell import RehearsedCell
from visioncal.live.rehearsal.controller import SimulatedController, spawn
from visioncal.live.rehearsal.machine import ControllerOptions
from visioncal.live.rehearsal.truth import Fault, TruthClient

# An OAK's rate and an exposure under bright light.
_PACE = Pace(30.0, 0.008)

_AT_CONTROLLER: Mapping[str, Fault] = {
    "protective-stop": "protective-stop",
    "emergency-stop": "emergency-stop",
    "remote-off": "local-control",
    "link-lost": "die",
    "silent": "freeze",
}
_AT_CAMERA: Mapping[str, CameraFault] = {"unplugged": "unplugged", "covered": "covered"}
_REMEDIES: Mapping[str, Fault] = {
    "protective-stop": "release",
    "emergency-stop": "release",
    "remote-off": "remote-control",
    "silent": "thaw",
}
# Joint speeds above which the arm counts as moving, and below which as stopped [rad/s].
_MOVING_SPEED, _STOPPED_SPEED = 0.05, 1e-3
_POLL_S = 0.02
# Delay of a fault after the start of a motion [s].
_INTO_MOTION_S = 0.2
# Longer than any motion between two stops, even on a busy computer [s].
_PATIENCE_S = 60.0
# How long and at which interval an arm is observed after a stop [s].
_OBSERVED_S, _SAMPLING_S = 2.0, 0.01


class Bench:
    """A running simulated cell: its controller is another process, its camera renders the truth.

    Attributes:
        camera: The camera that observes the true arm.
    """

    def __init__(self, cell: RehearsedCell, start_q: FloatArray) -> None:
        """Starts the controller, its arm at a posture [rad].

        Raises:
            DriverError: It does not start.
        """
        self.cell = cell
        self.controller: SimulatedController = spawn(_options_at(cell, start_q))
        # The camera asks from the pipeline's thread, and needs a connection of its own.
        self._truth = TruthClient(self.controller.host)
        self.camera = RehearsalCamera(
            cell.truth, lambda at_s: self._truth.state(at_s.tolist()).q, pace=_PACE
        )

    @contextmanager
    def connected(self) -> Iterator[LiveCell]:
        """Opens arm and camera as a recording does, and closes them.

        Raises:
            DriverError: One of them cannot be opened.
        """
        with closing(UrArm(self.controller.host)) as arm:
            yield LiveCell(arm, self.camera)

    def restart(self, q: FloatArray) -> None:
        """Restarts a controller that has died, with the arm at its last posture [rad]."""
        host = self.controller.host
        self.close()
        self.controller = spawn(_options_at(self.cell, q), host)
        self._truth = TruthClient(host)

    def close(self) -> None:
        """Ends the controller."""
        self._truth.close()
        self.controller.close()


def _options_at(cell: RehearsedCell, q: FloatArray) -> ControllerOptions:
    return replace(cell.controller, q=tuple(np.asarray(q).tolist()))


class FaultInjection:
    """Watcher that injects a fault after a number of views.

    Faults of the controller occur during a motion, those of the camera at a stop.

    Attributes:
        injected_s: Time of the fault on the monotonic clock [s]; None before.
        q: (n,) joint angles at the fault [rad]; empty before.
    """

    def __init__(self, bench: Bench, fault: Faults, after: int) -> None:
        self._bench, self._fault, self._after = bench, fault, after
        self.injected_s: float | None = None
        self.q: FloatArray = np.zeros(0)

    def stepped(self, step: CaptureEvent) -> None:
        """Starts the injection once that number of stops was visited."""
        if step.place == self._after:
            threading.Thread(target=self._inject, daemon=True).start()

    def stood_after_s(self) -> float | None:
        """Time from the fault until the arm stopped [s].

        None where the simulated arm ends with its controller, or goes on to the next stop.
        """
        if self.injected_s is None or self._fault in ("link-lost", "covered"):
            return None
        times = self.injected_s + np.arange(0.0, _OBSERVED_S, _SAMPLING_S)
        time.sleep(max(0.0, float(times[-1]) - time.monotonic()))
        with closing(TruthClient(self._bench.controller.host)) as truth:
            speeds = np.abs(truth.state(times.tolist()).dq).max(axis=1)
        moving = np.flatnonzero(speeds > _STOPPED_SPEED)
        return 0.0 if not len(moving) else _SAMPLING_S * float(moving[-1] + 1)

    def clear_fault(self) -> None:
        """Clears the fault, as a person would do in the cell before going on."""
        if self._fault == "link-lost":
            self._bench.restart(self.q)
        elif self._fault in _REMEDIES:
            self._bench.controller.truth.inject(_REMEDIES[self._fault])
        else:
            self._bench.camera.fault = "none"

    def _inject(self) -> None:
        with closing(TruthClient(self._bench.controller.host)) as truth:
            _wait(truth, moving=True)
            if self._fault in _AT_CONTROLLER:
                time.sleep(_INTO_MOTION_S)
                self.q, self.injected_s = truth.state([time.monotonic()]).q[0], time.monotonic()
                truth.inject(_AT_CONTROLLER[self._fault])
                return
            _wait(truth, moving=False)
        self.injected_s = time.monotonic()
        self._bench.camera.fault = _AT_CAMERA[self._fault]


def _wait(truth: TruthClient, *, moving: bool) -> None:
    """Waits until the arm moves, or has stopped."""
    ends_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < ends_s:
        speed = float(np.abs(truth.state([time.monotonic()]).dq).max())
        if (speed > _MOVING_SPEED) if moving else (speed < _STOPPED_SPEED):
            return
        time.sleep(_POLL_S)
