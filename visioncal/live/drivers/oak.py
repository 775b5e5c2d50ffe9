"""Luxonis' OAK cameras through depthai: held focus and exposure, factory intrinsics, timestamps."""

import math
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, ModuleType

from visioncal.core.errors import DriverError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Camera
from visioncal.live.drivers.extras import Handle, depthai
from visioncal.live.drivers.oak_calibration import SOCKETS, factory_intrinsics
from visioncal.live.drivers.oak_frames import FrameEnd, began_after, worded
from visioncal.live.drivers.protocols import DeviceSetup, Frame
from visioncal.live.drivers.stopwatch import Stopwatch

# The default resolution is the sensor's, divided by a whole number to at most this width [px].
_WIDTH_PX = 2048
_RATE_HZ = 10.0
# Time for automatic exposure and focus before they are held, and timeout of the first picture [s].
_SETTLE_S, _FIRST_S = 1.5, 5.0
# Polling interval of waiting callers [s].
_GLANCE_S = 0.05
_UDEV_RULE = 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"'
_OPTIONS = ("socket", "rate_hz", "raw")


class OakCamera:
    """One camera of an OAK, as a camera device.

    Settings that are not requested are determined once and then held: the focus is that of the
    factory calibration, else that of autofocus; exposure and gain are those of automatic exposure.
    All of them are in `settings`.

    Args:
        requested: Requested settings; `more` may name the `socket` (CAM_A), `rate_hz`, and `raw`, a
            file to record every frame into, `.avi` or `.mkv`.
        device: Id, address or USB path of the OAK; None for the only one.

    Raises:
        DriverError: Depthai or the device is missing, or the device has no such camera.
        DataError: Frames cannot be recorded into that file.
    """

    def __init__(self, requested: DeviceSetup | None = None, *, device: str | None = None) -> None:
        dai = depthai()
        requested = requested or DeviceSetup()
        self._socket, rate_hz = _options(requested.more)
        with ExitStack() as closing:
            opened = _open_device(dai, device)
            closing.callback(opened.close)
            with worded(dai, "The OAK", "does not start"):
                sensor = _sensor(opened, self._socket)
                self.name = f"{opened.getDeviceName()} {self._socket} ({sensor.sensorName})"
                self.resolution = requested.resolution or _default_resolution(
                    sensor.width, sensor.height
                )
                calibration = opened.readCalibrationOrDefault()
                requested = _with_focus(requested, calibration, sensor)
                pipeline = dai.Pipeline(opened)
                node = pipeline.create(dai.node.Camera).build(sensor.socket)
                output = self._output(dai, node, requested, sensor, rate_hz)
                control = node.inputControl.createInputQueue()
            raw = requested.more.get("raw")
            self._end = FrameEnd(
                dai, pipeline, output, self.name, raw=None if raw is None else Path(raw)
            )
            closing.callback(self._end.close)
            held = self._hold_settings(dai, requested, sensor, control)
            self.factory, provenance = self._intrinsics(calibration, sensor)
            self.settings = MappingProxyType({"rate_hz": rate_hz, **provenance, **held})
            self._closing = closing.pop_all()

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call.

        Raises:
            DriverError: None came in time; it may be unplugged.
        """
        requested_at = time.monotonic()
        waiting = Stopwatch()
        self._end.drop_old()
        while True:
            frame = self._end.next(min(timeout_s, _GLANCE_S))
            if frame is None and waiting.read() > timeout_s:
                raise DriverError(
                    f"{self.name} gave no picture within {timeout_s:g} s.",
                    culprits=[self.name],
                    next_step="Look at its cable and its power; then go on with --resume.",
                )
            if frame is not None and began_after(frame, requested_at):
                return frame

    def close(self) -> None:
        """Stops and releases the device; may be called twice."""
        self._closing.close()

    def _output(
        self, dai: ModuleType, node: Handle, requested: DeviceSetup, sensor: Handle, rate_hz: float
    ) -> Handle:
        """Sets what is requested, and creates the camera node's output."""
        if requested.focus is not None:
            node.initialControl.setManualFocus(requested.focus)
        if requested.exposure_us is not None and requested.gain is not None:
            node.initialControl.setManualExposure(requested.exposure_us, requested.gain)
        is_colour = dai.CameraSensorType.COLOR in sensor.supportedTypes
        kind = dai.ImgFrame.Type.BGR888i if is_colour else dai.ImgFrame.Type.GRAY8
        # The factory's matrix is for pictures that are scaled and cropped, and still distorted.
        crop = dai.ImgResizeMode.CROP
        return node.requestOutput(self.resolution, kind, crop, rate_hz, False)

    def _hold_settings(
        self, dai: ModuleType, requested: DeviceSetup, sensor: Handle, control_queue: Handle
    ) -> dict[str, str | float]:
        """Fixes the settings that the camera determined by itself, and returns them."""
        frame = self._end.message(_FIRST_S)
        until = time.monotonic() + _SETTLE_S
        while frame is not None and time.monotonic() < until:
            frame = self._end.message(1.0)
        if frame is None:
            raise DriverError(
                f"{self.name} starts, but gives no picture.",
                culprits=[self.name],
                next_step="Look at its cable: USB 3 and short; and at its power.",
            )
        found_us = round(1e6 * frame.getExposureTime().total_seconds())
        exposure_us = found_us if requested.exposure_us is None else requested.exposure_us
        gain = frame.getSensitivity() if requested.gain is None else requested.gain
        held: dict[str, str | float] = {"exposure_us": exposure_us, "gain": gain}
        control = dai.CameraControl()
        control.setManualExposure(exposure_us, gain)
        control.setAutoWhiteBalanceLock(True)
        if sensor.hasAutofocus:
            held["focus"] = frame.getLensPosition() if requested.focus is None else requested.focus
            control.setManualFocus(int(held["focus"]))
        control_queue.send(control)
        return held

    def _intrinsics(
        self, calibration: Handle, sensor: Handle
    ) -> tuple[Camera | None, dict[str, str | float]]:
        """Factory intrinsics, with a setting that states their source or why they are not used."""
        try:
            camera = factory_intrinsics(calibration, self._socket, self.resolution)
        except DriverError as error:
            return None, {"factory_intrinsics": f"not used: {error.message}"}
        focus = _calibrated_focus(calibration, sensor)
        suffix = "" if focus is None else f", for focus {focus}"
        return camera, {"factory_intrinsics": f"read from the device{suffix}"}


def _options(more: Mapping[str, str]) -> tuple[str, float]:
    """Socket and rate [Hz] from a user's options."""
    for name in more:
        if name not in _OPTIONS:
            raise DriverError(
                f"The OAK has no option {name!r}; {', '.join(_OPTIONS)} are there.",
                culprits=[name],
                next_step=did_you_mean(name, _OPTIONS),
            )
    socket = more.get("socket", SOCKETS[0])
    if socket not in SOCKETS:
        raise DriverError(
            f"The OAK has no socket {socket!r}; {SOCKETS[0]} to {SOCKETS[-1]} are the names.",
            culprits=["socket"],
        )
    try:
        rate_hz = float(more.get("rate_hz", _RATE_HZ))
    except ValueError:
        rate_hz = math.nan
    if not 0.0 < rate_hz < 1e3:
        raise DriverError(
            f"rate_hz is {more['rate_hz']!r}; pictures a second are needed, as 10.",
            culprits=["rate_hz"],
        )
    return socket, rate_hz


def _open_device(dai: ModuleType, device: str | None) -> Handle:
    try:
        return dai.Device() if device is None else dai.Device(dai.DeviceInfo(device))
    except RuntimeError as error:
        raise DriverError(
            f"{'An OAK' if device is None else f'The OAK {device}'} cannot be opened: {error}.",
            culprits=["oak" if device is None else device],
            next_step="Look at its cable (USB 3, in a blue socket) and its power, and whether "
            "another program holds it. On Linux USB needs a rule once: "
            f"echo '{_UDEV_RULE}' | sudo tee /etc/udev/rules.d/80-movidius.rules; "
            "sudo udevadm control --reload-rules; sudo udevadm trigger",
        ) from error


def _sensor(device: Handle, socket: str) -> Handle:
    """The device's description of the sensor on a socket."""
    sensors = {feature.socket.name: feature for feature in device.getConnectedCameraFeatures()}
    if socket not in sensors:
        raise DriverError(
            f"The OAK has no camera on {socket}; it has {', '.join(sensors) or 'none'}.",
            culprits=[socket],
            next_step="Name another socket, or look at the camera's ribbon cable.",
        )
    return sensors[socket]


def _default_resolution(width: int, height: int) -> tuple[int, int]:
    """Resolution of the sensor's whole view that USB can carry, in even numbers of pixels."""
    parts = math.ceil(width / _WIDTH_PX)
    return width // parts // 2 * 2, height // parts // 2 * 2


def _with_focus(requested: DeviceSetup, calibration: Handle, sensor: Handle) -> DeviceSetup:
    """Adds the factory calibration's focus, unless another one is requested."""
    if requested.focus is not None or not sensor.hasAutofocus:
        return requested
    return replace(requested, focus=_calibrated_focus(calibration, sensor))


def _calibrated_focus(calibration: Handle, sensor: Handle) -> int | None:
    """Lens position of the factory calibration; None for a fixed lens."""
    if not sensor.hasAutofocus or not calibration.hasCameraCalibration(sensor.socket):
        return None
    position = int(calibration.getLensPosition(sensor.socket))
    return position if position > 0 else None
