"""Luxonis' OAK cameras through depthai: held focus and exposure, factory intrinsics, timestamps."""

import math
import os
import time
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import timedelta
from types import MappingProxyType, ModuleType

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.extras import Handle, client_library
from visioncal.core.types import Camera
from visioncal.live.drivers.protocols import DeviceSetup, Frame, Stopwatch

# The camera that every OAK has: the colour camera, or the only one.
_SOCKET = "CAM_A"

_RATE_HZ = 10.0
# Time for automatic exposure and focus before they are held [s].
_SETTLE_S = 1.5
_UDEV_RULE = 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"'


def depthai() -> ModuleType:
    """Imports depthai.

    It reads its environment once, on import; by default it sends telemetry.

    Raises:
        DriverError: It is not installed, with the command that installs it.
    """
    os.environ["DEPTHAI_TELEMETRY"] = "0"
    # Hides warnings about USB in containers.
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    # By default it searches for a device for 10 s; one that is connected is found within one.
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "3000")
    return client_library("depthai", "oak")


class OakCamera:
    """One camera of an OAK, as a camera device.

    Settings that are not requested are determined once and then held: the focus is that of the
    factory calibration, else that of autofocus; exposure and gain are those of automatic exposure.
    All of them are in `settings`.

    Args:
        requested: Requested settings.
        device: Id, address or USB path of the OAK; None for the only one.

    Raises:
        DriverError: Depthai or the device is missing, or the device has no such camera.
    """

    def __init__(self, requested: DeviceSetup | None = None, *, device: str | None = None) -> None:
        dai = self._dai = depthai()
        requested = requested or DeviceSetup()
        with ExitStack() as closing:
            opened = _open_device(dai, device)
            closing.callback(opened.close)
            with _worded(dai, "The OAK", "does not start"):
                sensor = _sensor(opened)
                self.name = f"{opened.getDeviceName()} {_SOCKET} ({sensor.sensorName})"
                # The sensor's whole view, divided by a whole number to a width that USB can carry,
                # in even numbers of pixels.
                parts = math.ceil(sensor.width / 2048)
                whole = sensor.width // parts // 2 * 2, sensor.height // parts // 2 * 2
                self.resolution = requested.resolution or whole
                calibration = opened.readCalibrationOrDefault()
                if requested.focus is None and sensor.hasAutofocus:
                    requested = replace(requested, focus=_calibrated_focus(calibration, sensor))
                pipeline = dai.Pipeline(opened)
                node = pipeline.create(dai.node.Camera).build(sensor.socket)
                output = self._output(dai, node, requested, sensor)
                control = node.inputControl.createInputQueue()
                self._queue = output.createOutputQueue(maxSize=4, blocking=False)
                pipeline.start()
            # A pipeline that still runs when Python ends aborts the process.
            closing.callback(weakref.finalize(self, _stop, pipeline))
            held = self._hold_settings(dai, requested, sensor, control)
            self.factory, provenance = self._intrinsics(calibration, sensor)
            self.settings = MappingProxyType({"rate_hz": _RATE_HZ, **provenance, **held})
            self._closing = closing.pop_all()

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call; raises DriverError."""
        requested_at = time.monotonic()
        waiting = Stopwatch()
        with _worded(self._dai, self.name):
            self._queue.tryGetAll()
        while True:
            message = self._message(min(timeout_s, 0.05))
            if message is None:
                if waiting.read() > timeout_s:
                    raise DriverError(
                        f"{self.name} gave no picture within {timeout_s:g} s.",
                        culprits=[self.name],
                        next_step="Look at its cable and its power.",
                    )
                continue
            # Depthai's clock is this host's monotonic one.
            middle_s = message.getTimestamp(self._dai.CameraExposureOffset.MIDDLE).total_seconds()
            exposure_s = message.getExposureTime().total_seconds()
            if middle_s - 0.5 * exposure_s >= requested_at:
                image = np.array(message.getCvFrame(), dtype=np.uint8)
                return Frame(image, middle_s, exposure_s or None)

    def close(self) -> None:
        """Stops and releases the device; may be called twice."""
        self._closing.close()

    def _message(self, timeout_s: float) -> Handle | None:
        """Depthai's message of the next frame; None where there is none in time."""
        with _worded(self._dai, self.name):
            return self._queue.get(timedelta(seconds=timeout_s))

    def _output(
        self, dai: ModuleType, node: Handle, requested: DeviceSetup, sensor: Handle
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
        return node.requestOutput(self.resolution, kind, crop, _RATE_HZ, False)

    def _hold_settings(
        self, dai: ModuleType, requested: DeviceSetup, sensor: Handle, control_queue: Handle
    ) -> dict[str, str | float]:
        """Fixes the settings that the camera determined by itself, and returns them."""
        frame = self._message(5.0)
        until = time.monotonic() + _SETTLE_S
        while frame is not None and time.monotonic() < until:
            frame = self._message(1.0)
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
            camera = _factory_intrinsics(calibration, _SOCKET, self.resolution)
        except DriverError as error:
            return None, {"factory_intrinsics": f"not used: {error.message}"}
        focus = _calibrated_focus(calibration, sensor)
        suffix = "" if focus is None else f", for focus {focus}"
        return camera, {"factory_intrinsics": f"read from the device{suffix}"}


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


def _sensor(device: Handle) -> Handle:
    """The device's description of its camera's sensor."""
    sensors = {feature.socket.name: feature for feature in device.getConnectedCameraFeatures()}
    if _SOCKET not in sensors:
        raise DriverError(
            f"The OAK has no camera on {_SOCKET}; it has {', '.join(sensors) or 'none'}.",
            culprits=[_SOCKET],
            next_step="Look at the camera's ribbon cable.",
        )
    return sensors[_SOCKET]


def _calibrated_focus(calibration: Handle, sensor: Handle) -> int | None:
    """Lens position of the factory calibration; None for a fixed lens."""
    if not sensor.hasAutofocus or not calibration.hasCameraCalibration(sensor.socket):
        return None
    position = int(calibration.getLensPosition(sensor.socket))
    return position if position > 0 else None


@contextmanager
def _worded(dai: ModuleType, name: str, what: str = "gives no frames any more") -> Iterator[None]:
    """Translates depthai's exceptions of devices, pipelines and closed queues.

    Raises:
        DriverError: Depthai raised one.
    """
    try:
        yield
    except (RuntimeError, dai.MessageQueue.QueueException) as error:
        raise DriverError(
            f"{name} {what}: {error}.",
            culprits=[name],
            next_step="Look at its cable and its power.",
        ) from error


def _stop(pipeline: Handle) -> None:
    pipeline.stop()
    pipeline.wait()


def _factory_intrinsics(handler: Handle, socket: str, resolution: tuple[int, int]) -> Camera:
    """Reads a camera's intrinsics from a device's calibration; raises DriverError.

    Depthai's CalibrationHandler uses single precision, and one matrix per camera at one size of the
    sensor, from which others follow by scaling to cover and cropping about the middle; distortion
    is OpenCV's 14 coefficients, or the fisheye's 4.
    """
    dai = depthai()
    board_socket = getattr(dai.CameraBoardSocket, socket)
    try:
        matrix = np.array(handler.getCameraIntrinsics(board_socket, *resolution), dtype=float)
        coefficients = np.array(handler.getDistortionCoefficients(board_socket), dtype=float)
        model = handler.getDistortionModel(board_socket)
    except RuntimeError as error:
        raise DriverError(
            f"The device has no calibration of {socket}: {error}.",
            culprits=[socket],
            next_step="Leave the intrinsics out: they are then estimated from the images.",
        ) from error
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    if model == dai.CameraModel.Fisheye:
        return Camera("fisheye", resolution, intrinsics, coefficients[:4])
    if model == dai.CameraModel.Perspective:
        tail = coefficients[8:]
        if np.any(tail != 0.0):
            raise DriverError(
                f"The device's lens {socket} has thin-prism or tilt coefficients up to "
                f"{np.abs(tail).max():.3g}, which our model has not; zeros are needed.",
                culprits=[socket],
                next_step="Leave the intrinsics out: they are then estimated from the images.",
            )
        count = 8 if np.any(coefficients[5:8] != 0.0) else 5
        padded = np.pad(coefficients, (0, max(8 - len(coefficients), 0)))
        return Camera("brown", resolution, intrinsics, padded[:count])
    raise DriverError(
        f"The device's lens {socket} is of the model {model.name}; Perspective or Fisheye is "
        "needed.",
        culprits=[socket],
        next_step="Leave the intrinsics out: they are then estimated from the images.",
    )
