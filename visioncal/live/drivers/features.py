"""Features of GenICam cameras by their standard names (SFNC), whichever library gives access."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.extras import Handle
from visioncal.core.types import Image
from visioncal.live.drivers import stream
from visioncal.live.drivers.protocols import DeviceSetup

# Pixel formats and their OpenCV codes, in the order in which they are chosen. SFNC names a Bayer
# pattern by its first two pixels, as OpenCV's names of four letters do.
_FORMATS: dict[str, int | None] = {
    **dict.fromkeys(("Mono8", "BGR8", "BGR8Packed")),
    **dict.fromkeys(("RGB8", "RGB8Packed"), cv2.COLOR_RGB2BGR),
    "BayerRG8": cv2.COLOR_BayerRGGB2BGR,
    "BayerGR8": cv2.COLOR_BayerGRBG2BGR,
    "BayerGB8": cv2.COLOR_BayerGBRG2BGR,
    "BayerBG8": cv2.COLOR_BayerBGGR2BGR,
}
# Older cameras have the second names.
_EXPOSURE, _GAIN = ("ExposureTime", "ExposureTimeAbs"), ("Gain", "GainRaw")


@dataclass(frozen=True)
class Features:
    """Features of an opened camera."""

    name: str  # Name of the camera in messages.
    node: Callable[[str], Handle]  # Gives a feature's node by its name.
    value: str  # Attribute of a node that is its value.
    # Errors of the library for features that are absent, locked, or out of range.
    errors: tuple[type[Exception], ...]

    def get(self, *names: str) -> str | float | None:
        """Value of the first of these features that there is; None for none."""
        for name in names:
            try:
                value: str | float = getattr(self.node(name), self.value)
            except self.errors:
                continue
            return value
        return None

    def _why_not(self, value: str | float, *names: str) -> str:
        """Sets the first of these features that there is; else why not, in words."""
        name = next((name for name in names if self.get(name) is not None), names[0])
        try:
            setattr(self.node(name), self.value, value)
        except self.errors as error:
            # Behind the colon stands where in the library it was raised.
            return f"{name}: {str(error).split(' : ')[0] or 'it has no such feature'}"
        return ""

    def configure(self, requested: DeviceSetup) -> None:
        """Sets what is requested, and free running acquisition; before this starts.

        Raises:
            DriverError: The camera does not take a setting, or has no pixel format of ours.
        """
        sent = self.get("PixelFormat")
        if sent not in _FORMATS and all(self._why_not(name, "PixelFormat") for name in _FORMATS):
            why = f"sends {sent}, but must send one of {', '.join(_FORMATS)}"
            raise stream.camera_error(self.name, why, "Set its PixelFormat in its maker's viewer.")
        for name, value in (
            ("AcquisitionMode", "Continuous"),
            ("TriggerSelector", "FrameStart"),
            ("TriggerMode", "Off"),
        ):
            self._why_not(value, name)
        width, height = requested.resolution or (None, None)
        # Features that keep others from being set, and their values that do not.
        for option, number, names, (guard, free) in (
            ("--resolution", width, ("Width",), ("OffsetX", 0)),
            ("--resolution", height, ("Height",), ("OffsetY", 0)),
            ("--exposure-us", requested.exposure_us, _EXPOSURE, ("ExposureAuto", "Off")),
            ("--gain", requested.gain, _GAIN, ("GainAuto", "Off")),
            ("--focus", requested.focus, ("FocusPosition",), ("FocusAuto", "Off")),
        ):
            if number is not None:
                self._why_not(free, guard)
                if why := self._why_not(number, *names).rstrip("."):
                    step = f"Give one that it takes, or leave {option} out."
                    why = f"does not take {option} {number}: {why}"
                    raise stream.camera_error(self.name, why, step)

    def held(self, arrivals: Iterator[stream.Arrival | None]) -> dict[str, str | float]:
        """Lets automatic functions that are on settle, and holds what they found: the settings."""
        names = ("ExposureAuto", "GainAuto", "BalanceWhiteAuto")
        automatic = [name for name in names if self.get(name) not in (None, "Off")]
        until = time.monotonic() + stream.SETTLE_S
        while automatic and time.monotonic() < until:
            next(arrivals, None)
        for name in automatic:
            self._why_not("Off", name)
        settings = {"exposure_us": _EXPOSURE, "gain": _GAIN, "pixel_format": ("PixelFormat",)}
        values = {name: self.get(*features) for name, features in settings.items()}
        return {name: value for name, value in values.items() if value is not None}


def bgr_or_grey(pixels: npt.NDArray[np.uint8], pixel_format: str) -> Image:
    """Converts pixels (h, w) or (h, w, channels) of a pixel format to grey or blue, green, red."""
    code = _FORMATS[pixel_format]
    return np.array(pixels if code is None else cv2.cvtColor(pixels, code), dtype=np.uint8)
