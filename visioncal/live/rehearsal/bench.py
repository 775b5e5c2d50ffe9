"""The devices of a rehearsal: simulated, behind the real client libraries."""

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.capture.live import LiveCell
from visioncal.live.drivers.extras import depthai
from visioncal.live.drivers.oak_hosted import HostedOak
from visioncal.live.drivers.protocols import CameraDevice
from visioncal.live.drivers.ur import UrArm
from visioncal.live.rehearsal.camera import Pace, RehearsalCamera
from visioncal.live.rehearsal.cell import RehearsedCell
from visioncal.live.rehearsal.controller import SimulatedController, spawn
from visioncal.live.rehearsal.machine import ControllerOptions
from visioncal.live.rehearsal.truth import TruthClient

# An OAK's rate and an exposure under bright light.
_PACE = Pace(30.0, 0.008)


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
