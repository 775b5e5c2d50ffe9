"""Interfaces of arms and cameras, and their stopwatch.

The drivers know nothing of sessions or calibration.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from visioncal.core.types import Camera, FloatArray, Image, Image16

# Whether the arm may move; `reduced` still moves, slowly.
Safety = Literal["normal", "reduced", "protective-stop", "emergency-stop", "fault"]
# Outcome of a requested view: go on to the next stop; none was taken, request it again; it was
# the last; it cannot be taken so, and requesting it again would not help.
Answer = Literal["next", "again", "done", "error"]


@dataclass(frozen=True, eq=False)
class ArmState:
    """State of an arm at one moment; what it does not report is None."""

    stamp_s: float  # Time of arrival, on the host's monotonic clock (`time.monotonic`) [s].
    base_from_flange: FloatArray  # (4, 4) flange in the controller's base frame [m].
    q: FloatArray | None = None  # (n,) joint angles [rad].
    dq: FloatArray | None = None  # (n,) joint speeds [rad/s].
    # (4, 4) tool offset that is set in the controller [m].
    flange_from_tool: FloatArray | None = None
    payload_kg: float | None = None  # Payload that is set in the controller [kg].
    payload_m: FloatArray | None = None  # (3,) its centre of mass, in the flange frame [m].
    currents_a: FloatArray | None = None  # (n,) motor currents [A].
    temperatures_c: FloatArray | None = None  # (n,) joint temperatures [C].
    safety: Safety = "normal"  # Whether it may move.
    controller_s: float = 0.0  # Time on the controller's own clock, where it has one [s].
    stop: int | None = None  # Number of the stop by the robot's own program, where it counts them.
    pose_form: str = ""  # Form of `POSE_FORMS` in which the pose was sent; empty where unknown.
    typed: str = ""  # The line in which a person typed the pose; empty for none.


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture."""

    image: Image  # (h, w) grey or (h, w, 3) blue, green, red.
    stamp_s: float  # Middle of the exposure, on the host's monotonic clock [s].
    exposure_s: float | None = None  # Exposure time [s], where the camera reports it.
    name: str = ""  # Name of the file that it was; empty for none.
    # (h, w) its distances in units of the setting `depth_unit_m`, 0 where there is none.
    depth: Image16 | None = None


class Arm(Protocol):
    """An arm that reports its state.

    Every call returns within a second, or raises DriverError: connection lost, stopped, refused.
    """

    @property
    def name(self) -> str:
        """Name in messages: `UR10e at 192.168.0.10`."""

    def state(self) -> ArmState:
        """Returns a state that the controller sent after the call before it."""

    def close(self) -> None:
        """Disconnects, after a halt where it was moving; may be called twice."""


@runtime_checkable
class MovingArm(Arm, Protocol):
    """An arm that can be driven."""

    def start_move(self, q: FloatArray, *, speed: float, acceleration: float) -> None:
        """Starts a motion straight in joint space to a posture, and returns at once.

        Args:
            q: (n,) the posture [rad].
            speed: Speed of the joint that travels farthest [rad/s].
            acceleration: Its acceleration [rad/s^2].

        Raises:
            DriverError: The controller refuses, with the remedy.
        """

    def moving(self) -> bool:
        """Whether the last motion is still in progress."""

    def halt(self) -> None:
        """Brakes at once; harmless where nothing moves or the connection is lost."""


@runtime_checkable
class RequestingArm(Arm, Protocol):
    """An arm of which a person, or the robot's own program, says when it has arrived."""

    @property
    def invitation(self) -> str:
        """How views are requested, to be shown at the beginning; empty where that is plain."""

    def request(self, timeout_s: float, wanted: str = "") -> ArmState | None:
        """Waits until the arm stands at a stop that waits for its view.

        Args:
            timeout_s: Longest time [s]; a person is waited for without a timeout.
            wanted: Which view is wanted, in words for a person: `View 3 (another distance)`.

        Returns:
            The arm's state there; None where nothing was requested in time.

        Raises:
            EOFError: There are no more stops.
            DriverError: Nothing is to be expected any more.
        """

    def reply(self, answer: Answer, reason: str = "") -> None:
        """Says what became of the stop of the last `request`; each gets one reply."""


@runtime_checkable
class CameraDevice(Protocol):
    """A camera."""

    @property
    def name(self) -> str:
        """Name in messages and in `[camera] name`."""

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) of the camera's pictures [px]."""

    @property
    def factory(self) -> Camera | None:
        """Intrinsics that the device itself reports, at this resolution."""

    @property
    def settings(self) -> Mapping[str, str | float]:
        """Settings of the camera, such as `exposure_us` or `focus`, to be recorded."""

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call.

        Raises:
            DriverError: None came in time; it may be unplugged, or at its end.
        """

    def close(self) -> None:
        """Releases the device; may be called twice."""


@runtime_checkable
class StoredPictures(CameraDevice, Protocol):
    """Pictures that another program took, whenever it did: each is given once, in their order."""

    given: set[str]  # Names of those that were given, or are left out.
    chosen: str  # Name of one that comes next whatever the order; empty for none.

    def waiting(self) -> list[str]:
        """Returns the names of those that were not given, the next one first; raises DriverError.

        A picture is whole for `look` once it no longer grew between two calls.
        """

    def look(self, name: str) -> Image | str:
        """Returns a picture without giving it, or why it cannot be read: `unreadable: ...`."""

    def skip(self) -> None:
        """Counts the present pictures as given."""


@dataclass(frozen=True)
class DeviceSetup:
    """Requested settings of a camera; None leaves the choice to the driver, which then holds it."""

    resolution: tuple[int, int] | None = None  # (width, height) [px].
    exposure_us: int | None = None  # Exposure time [us].
    gain: int | None = None  # ISO, or in the device's own unit.
    focus: int | None = None  # Lens position in the device's own unit.


class Stopwatch:
    """Time during which this program ran, since the start.

    It is read repeatedly while waiting for a device. When a virtual machine pauses or a computer
    swaps, all devices seem late at once, though none was silent.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self.restart()

    def restart(self) -> None:
        """Sets the stopwatch to zero."""
        self._read_s, self._sum_s = self._now(), 0.0

    def read(self) -> float:
        """Time since the start, without stalls [s]."""
        now = self._now()
        # Longer is a stall of this computer.
        self._sum_s += min(now - self._read_s, 0.2)
        self._read_s = now
        return self._sum_s
