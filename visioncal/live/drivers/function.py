"""A camera and an arm that are a Python program: a function of pictures, and poses one by one."""

import time
from collections.abc import Callable, Iterable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.errors import DriverError
from visioncal.core.transforms import rigid_fault
from visioncal.core.types import Camera, FloatArray, Image
from visioncal.live.drivers.protocols import Answer, ArmState, DeviceSetup, Frame
from visioncal.live.drivers.stream import camera_error, check_resolution, refuse_settings


class FunctionCamera:
    """Camera device whose pictures a function returns.

    Args:
        grab: Takes a picture when it is called, and returns it: (h, w) grey or (h, w, 3) blue,
            green, red, of uint8.
        requested: The resolution that its pictures must have, by default that of the first.
        factory: Intrinsics that the camera reports; None where it reports none.

    Raises:
        DriverError: It gives no picture, or other settings are requested.
    """

    def __init__(
        self,
        grab: Callable[[], Image],
        requested: DeviceSetup | None = None,
        factory: Camera | None = None,
    ) -> None:
        requested = requested or DeviceSetup()
        self._grab, self.factory = grab, factory
        self.name = f"function {getattr(grab, '__name__', type(grab).__name__)}"
        self.settings = MappingProxyType(dict[str, str | float]())
        refuse_settings(self.name, requested, "in the function")
        height, width = self._picture().shape[:2]
        self.resolution = requested.resolution or (width, height)

    @classmethod
    def of_file(cls, address: str, requested: DeviceSetup) -> "FunctionCamera":
        """The function of a Python file, `FILE.py:NAME`; raises DriverError."""
        file, _, wanted = address.rpartition(":")
        spec = spec_from_file_location(Path(file).stem, file) if Path(file).is_file() else None
        if spec is None or spec.loader is None:
            step = "Give a file and the name of its function, as python:grab.py:picture."
            raise camera_error(
                f"camera python:{address}", "must be a function of a Python file", step
            )
        module = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
            grab = getattr(module, wanted)
        except Exception as error:
            step = "Run the file by itself, and mend it."
            words = f"cannot be loaded: {type(error).__name__}: {error}"
            raise camera_error(f"camera python:{address}", words, step) from error
        return cls(grab, requested)

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture of a call, stamped at its middle; the function has no timeout.

        Raises:
            DriverError: The function raises, or what it returns is no picture of this resolution.
        """
        del timeout_s
        begin_s = time.monotonic()
        image = self._picture()
        check_resolution(self.name, image, self.resolution, "now gives")
        return Frame(image, 0.5 * (begin_s + time.monotonic()))

    def close(self) -> None:
        """Holds no resources."""

    def _picture(self) -> Image:
        try:
            image = np.array(self._grab())
        except Exception as error:
            words = f"raised {type(error).__name__}: {error}"
            raise camera_error(self.name, words, "Mend it, or its camera.") from error
        is_shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if image.dtype != np.uint8 or not is_shaped or not image.size:
            step = "Return (h, w) grey or (h, w, 3) blue, green, red of uint8."
            words = f"must return a picture, but returned {image.dtype} of shape {image.shape}"
            raise camera_error(self.name, words, step)
        return image


class GivenStops:
    """Arm that a program moves: it stands at a stop whenever the next item of an iterable is there.

    Args:
        stops: The flange in the base at each stop: (4, 4) [m], a RigidTransform, or an ArmState
            with joint angles, too. A generator moves the arm, and yields where it stands.
    """

    name, invitation = "the program's arm", ""

    def __init__(self, stops: Iterable[FloatArray | RigidTransform | ArmState]) -> None:
        self._stops, self._state = iter(stops), ArmState(time.monotonic(), np.eye(4))

    def state(self) -> ArmState:
        """The state at the latest stop."""
        return self._state

    def request(self, timeout_s: float, wanted: str = "") -> ArmState | None:
        """The next stop; raises EOFError after the last, and DriverError for what is no pose."""
        del timeout_s, wanted
        try:
            stop = next(self._stops)
        except StopIteration:
            raise EOFError from None
        if isinstance(stop, ArmState):
            self._state = stop
            return stop
        pose = np.asarray(stop.as_matrix() if isinstance(stop, RigidTransform) else stop, float)
        if fault := rigid_fault(pose):
            raise DriverError(
                f"{self.name}: a stop must be the flange's (4, 4) pose in the base in metres, but "
                f"{fault}.",
                culprits=["stops"],
            )
        self._state = ArmState(time.monotonic(), pose)
        return self._state

    def reply(self, answer: Answer, reason: str = "") -> None:
        """A stop without a view is left out; `watch` of the recording says why."""

    def close(self) -> None:
        """Holds no resources."""
