"""What is asked of an arm and of a camera; the drivers know nothing of sessions or calibration."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

from visioncal.core.types import Camera, FloatArray, Image

# Whether the arm may move; `reduced` still moves, slowly.
Safety = Literal["normal", "reduced", "protective-stop", "emergency-stop", "fault"]


@dataclass(frozen=True, eq=False)
class ArmState:
    """What the arm says of itself at one moment; what it does not report is None.

    Attributes:
        stamp_s: When the host had it, on the host's monotonic clock (`time.monotonic`) [s].
        base_from_flange: (4, 4) the flange in the controller's base frame [m].
        q: (n,) joint angles [rad].
        dq: (n,) joint speeds [rad/s].
        flange_from_tool: (4, 4) the tool offset that the controller is set to [m].
        payload_kg: The load that the controller reckons with [kg].
        payload_m: (3,) the centre of that load, in the flange frame [m].
        currents_a: (n,) motor currents [A].
        temperatures_c: (n,) joint temperatures [C].
        safety: Whether it may move.
    """

    stamp_s: float
    base_from_flange: FloatArray
    q: FloatArray | None = None
    dq: FloatArray | None = None
    flange_from_tool: FloatArray | None = None
    payload_kg: float | None = None
    payload_m: FloatArray | None = None
    currents_a: FloatArray | None = None
    temperatures_c: FloatArray | None = None
    safety: Safety = "normal"


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture.

    Attributes:
        image: (h, w) grey or (h, w, 3) blue, green, red.
        stamp_s: The middle of its exposure, on the host's monotonic clock [s].
        exposure_s: How long it was exposed [s], where the camera reports it.
    """

    image: Image
    stamp_s: float
    exposure_s: float | None = None


@dataclass(frozen=True, eq=False)
class JointSample:
    """What joints do at one moment.

    Attributes:
        stamp_s: When, on the controller's own clock [s].
        q: (n,) joint angles [rad].
        dq: (n,) joint speeds [rad/s].
        currents_a: (n,) motor currents [A].
    """

    stamp_s: float
    q: FloatArray
    dq: FloatArray
    currents_a: FloatArray


class Joints(Protocol):
    """Joints that report what they do, many times a second.

    Attributes:
        name: What and where they are, for people: `UR10e at 192.168.0.10`.
        rate_hz: How often they report it.
    """

    name: str
    rate_hz: float

    def sample(self) -> JointSample:
        """Returns the next sample."""


class Arm(Protocol):
    """An arm that reports where it is.

    Every call returns within a second, or raises DriverError: link lost, stopped, refused.
    """

    @property
    def name(self) -> str:
        """What and where it is, for people: `UR10e at 192.168.0.10`."""

    def state(self) -> ArmState:
        """Returns a state that the controller sent after the call before it."""

    def close(self) -> None:
        """Lets go of it, after a halt where it was moving; may be called twice."""


@runtime_checkable
class MovingArm(Arm, Protocol):
    """An arm that can be sent somewhere."""

    def start_move(self, q: FloatArray, *, speed: float, acceleration: float) -> None:
        """Starts towards a posture, every joint straight to its goal, and returns at once.

        Args:
            q: (n,) the posture [rad].
            speed: Of the joint that turns farthest [rad/s].
            acceleration: Likewise [rad/s^2].

        Raises:
            DriverError: The controller refuses, with what it needs.
        """

    def moving(self) -> bool:
        """Tells whether the last motion is still going on."""

    def halt(self) -> None:
        """Brakes at once; harmless where nothing moves or the link is gone."""


@runtime_checkable
class CameraDevice(Protocol):
    """A camera that gives picture after picture."""

    @property
    def name(self) -> str:
        """What it is, for people and for `[camera] name`."""

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) of its pictures [px]."""

    @property
    def factory(self) -> Camera | None:
        """The intrinsics that the device itself reports, at this resolution."""

    @property
    def settings(self) -> Mapping[str, str | float]:
        """What it is set to, as `exposure_us` or `focus`, to be recorded."""

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call.

        Raises:
            DriverError: None came in time: unplugged, or at its end.
        """

    def close(self) -> None:
        """Lets go of it; may be called twice."""


@dataclass(frozen=True)
class DeviceSetup:
    """What a user may ask of a camera; what is None is the driver's choice, then held.

    Attributes:
        resolution: (width, height) [px].
        exposure_us: Exposure time [us].
        gain: ISO or the device's own unit.
        focus: Lens position in the device's own unit.
        more: The driver's own options.
    """

    resolution: tuple[int, int] | None = None
    exposure_us: int | None = None
    gain: int | None = None
    focus: int | None = None
    more: Mapping[str, str] = field(default_factory=dict)
