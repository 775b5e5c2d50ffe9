"""The devices of a rehearsal: simulated, behind the real client libraries; their faults."""

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import replace

import numpy as np

from visioncal.core.choices import Faults
from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.capture.core import CaptureEvent
from visioncal.live.capture.live import LiveCell
from visioncal.live.drivers.extras import depthai
from visioncal.live.drivers.oak_hosted import HostedOak
from visioncal.live.drivers.protocols import CameraDevice
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
_MENDED: Mapping[str, Fault] = {
    "protective-stop": "release",
    "emergency-stop": "release",
    "remote-off": "remote-control",
    "silent": "thaw",
}
# Faster joints move, slower ones stand [rad/s].
_MOVES, _STANDS = 0.05, 1e-3
_POLL_S = 0.02
# A way is under way when this much of it is behind [s].
_UNDER_WAY_S = 0.2
# Longer than any way between two stops takes, on a busy computer too [s].
_PATIENCE_S = 60.0
# Until an arm stands that was stopped: how long and how finely it is looked at [s].
_LOOKED_S, _FINE_S = 2.0, 0.01


class Bench:
    """A simulated cell that runs: its controller is another process, its camera draws the truth.

    Attributes:
        cell: What it is made of.
        controller: The controller's process.
        camera: The camera that sees the true arm.
        through_depthai: Whether its pictures go through depthai's pipeline.
    """

    def __init__(self, cell: RehearsedCell, start_q: FloatArray) -> None:
        """Starts the controller, its arm at a posture [rad].

        Raises:
            DriverError: It does not start.
        """
        self.cell = cell
        self.controller: SimulatedController = spawn(_standing(cell, start_q))
        # The camera asks from the pipeline's thread, so it has a connection of its own.
        self._eyes = TruthClient(self.controller.host)
        self.camera = RehearsalCamera(cell.truth, self._true_joints, pace=_PACE)
        self.through_depthai = _has_depthai()

    @contextmanager
    def connected(self) -> Iterator[LiveCell]:
        """Opens arm and camera as a recording does, and lets go of them.

        Raises:
            DriverError: One of them cannot be opened.
        """
        with closing(UrArm(self.controller.host)) as arm, closing(self._device()) as camera:
            yield LiveCell(arm, camera)

    def restart(self, q: FloatArray) -> None:
        """Starts a controller that has died anew, with the arm where it stood [rad]."""
        host = self.controller.host
        self.close()
        self.controller = spawn(_standing(self.cell, q), host)
        self._eyes = TruthClient(host)

    def close(self) -> None:
        """Ends the controller."""
        self._eyes.close()
        self.controller.close()

    def _true_joints(self, at_s: FloatArray) -> FloatArray:
        return self._eyes.state(at_s.tolist()).q

    def _device(self) -> CameraDevice:
        if not self.through_depthai:
            return self.camera
        seen = self.camera
        return HostedOak(seen.frame, seen.resolution, factory=seen.factory, settings=seen.settings)


def _standing(cell: RehearsedCell, q: FloatArray) -> ControllerOptions:
    return replace(cell.controller, q=tuple(np.asarray(q).tolist()))


def _has_depthai() -> bool:
    with suppress(DriverError):
        depthai()
        return True
    return False


class FaultInjection:
    """A watcher that lets a fault happen after so many views.

    Those of the controller come while the arm moves, those of the camera when it stands at a stop.

    Attributes:
        injected_s: When it happened, on the monotonic clock [s]; None before.
        q: (n,) where the arm was then [rad]; empty before.
    """

    def __init__(self, bench: Bench, fault: Faults, after: int) -> None:
        self._bench, self._fault, self._after = bench, fault, after
        self.injected_s: float | None = None
        self.q: FloatArray = np.zeros(0)

    def stepped(self, step: CaptureEvent) -> None:
        """Prepares the fault once so many views were tried."""
        if step.place == self._after:
            threading.Thread(target=self._inject, daemon=True).start()

    def stood_after_s(self) -> float | None:
        """How long the arm still moved after the fault [s].

        None where the simulated arm is gone with its controller, or goes on to the next stop.
        """
        if self.injected_s is None or self._fault in ("link-lost", "covered"):
            return None
        times = self.injected_s + np.arange(0.0, _LOOKED_S, _FINE_S)
        time.sleep(max(0.0, float(times[-1]) - time.monotonic()))
        with closing(TruthClient(self._bench.controller.host)) as truth:
            speeds = np.abs(truth.state(times.tolist()).dq).max(axis=1)
        moving = np.flatnonzero(speeds > _STANDS)
        return 0.0 if not len(moving) else _FINE_S * float(moving[-1] + 1)

    def mend(self) -> None:
        """Does what a person would do in the cell before going on."""
        if self._fault == "link-lost":
            self._bench.restart(self.q)
        elif self._fault in _MENDED:
            self._bench.controller.truth.inject(_MENDED[self._fault])
        else:
            self._bench.camera.fault = "none"

    def _inject(self) -> None:
        with closing(TruthClient(self._bench.controller.host)) as truth:
            _wait(truth, moving=True)
            if self._fault in _AT_CONTROLLER:
                time.sleep(_UNDER_WAY_S)
                self.q, self.injected_s = truth.state([time.monotonic()]).q[0], time.monotonic()
                truth.inject(_AT_CONTROLLER[self._fault])
                return
            _wait(truth, moving=False)
        self.injected_s = time.monotonic()
        self._bench.camera.fault = _AT_CAMERA[self._fault]


def _wait(truth: TruthClient, *, moving: bool) -> None:
    """Waits until the arm moves, or stands."""
    until = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until:
        speed = float(np.abs(truth.state([time.monotonic()]).dq).max())
        if (speed > _MOVES) if moving else (speed < _STANDS):
            return
        time.sleep(_POLL_S)
