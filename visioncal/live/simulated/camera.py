"""Camera that observes a simulated cell with the arm's true joints.

It free-runs as a real camera does: exposures start at regular times, whether or not requested.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, FloatArray, Image
from visioncal.live.capture.live import Clock, HostClock
from visioncal.live.drivers.protocols import Frame
from visioncal.simulation import SimulatedCell
from visioncal.simulation.live import LiveView

# Moments of an exposure at which the arm's joints are read, start and end included.
_MOMENTS = 5

# Dark, as the inside of a lens cap [grey level].
_DARK = 12

CameraFault = Literal["none", "unplugged", "covered"]


class SimulatedCamera:
    """Camera device that observes a simulated cell.

    Args:
        cell: The cell: its true arm, edges and lens, its board and its noise. Its true arm must be
            the one whose joints are given.
        true_joints: Returns the arm's true joints, (k, n) [rad], at k past moments of the monotonic
            clock, (k,) [s]. After its DriverError the last known joints are used: a camera goes on
            working when a controller dies.
        rate_hz: Pictures per second.
        exposure_s: Exposure time [s].
        clock: The clock.
    """

    def __init__(
        self,
        cell: SimulatedCell,
        true_joints: Callable[[FloatArray], FloatArray],
        *,
        rate_hz: float = 15.0,
        exposure_s: float = 0.008,
        clock: Clock | None = None,
    ) -> None:
        self._cell = cell
        self._view = LiveView(cell)
        self._true_joints = true_joints
        self._rate_hz, self._exposure_s = rate_hz, exposure_s
        self._clock = clock or HostClock()
        self._start = self._clock.now()
        self._last: FloatArray | None = None
        self.fault: CameraFault = "none"

    @property
    def name(self) -> str:
        """Name in messages."""
        return "simulated camera"

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) of its pictures [px]."""
        return self._cell.camera().camera.resolution

    @property
    def factory(self) -> Camera | None:
        """Stated intrinsics of the cell; None where it states none."""
        return self._cell.stated[""] if self._cell.camera().state_intrinsics else None

    @property
    def settings(self) -> Mapping[str, str | float]:
        """Its exposure and rate."""
        return MappingProxyType({"exposure_us": 1e6 * self._exposure_s, "rate_hz": self._rate_hz})

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call.

        Raises:
            DriverError: It is unplugged, or the next exposure ends after the timeout.
        """
        requested_at = self._clock.now()
        exposure_s, rate_hz = self._exposure_s, self._rate_hz
        start = self._start + np.ceil((requested_at - self._start) * rate_hz) / rate_hz
        is_late = start + exposure_s > requested_at + timeout_s
        if is_late or self.fault == "unplugged":
            self._clock.sleep(timeout_s)
            raise DriverError(
                f"The {self.name} gave no picture within {timeout_s:g} s.",
                culprits=[self.name],
                next_step="Look at its cable and its power, then go on with --resume.",
            )
        self._clock.sleep(max(start + exposure_s - requested_at, 0.0))
        return Frame(self._picture(start), start + 0.5 * exposure_s, exposure_s)

    def close(self) -> None:
        """Holds no resources."""

    def _picture(self, start: float) -> Image:
        if self.fault == "covered":
            return np.full(self.resolution[::-1], _DARK, dtype=np.uint8)
        moments = np.linspace(start, start + self._exposure_s, _MOMENTS)
        try:
            joints = self._true_joints(moments)
        except DriverError:
            if self._last is None:
                raise
            joints = self._last
        self._last = joints[-1:]
        return self._view.picture(joints)
