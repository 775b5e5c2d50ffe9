"""Luxonis' OAK cameras through depthai: held focus and exposure, factory intrinsics, timestamps."""

import math
import os
import time
import weakref
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from datetime import timedelta
from types import ModuleType

import cv2
import numpy as np

from visioncal.core.extras import Handle, client_library
from visioncal.core.types import Camera, Image, Image16
from visioncal.live.drivers import stream
from visioncal.live.drivers.protocols import DeviceSetup
from visioncal.vision.camera import matrix_3x3

# The camera that every OAK has: the colour camera, or the only one.
_SOCKET = "CAM_A"

_RATE_HZ = 10.0  # Pictures a second.
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


class OakCamera(stream.StreamingCamera):
    """Camera device of one camera of an OAK, by the OAK's id, address or USB path.

    Settings that are not requested are determined once and then held: the focus is that of the
    factory calibration, else that of autofocus; exposure and gain are those of automatic exposure.
    All of them are in `settings`.
    """

    def _open(self, address: str, requested: DeviceSetup, closing: ExitStack) -> stream.Opened:
        dai = depthai()
        device = _open_device(dai, address)
        closing.callback(device.close)
        with stream.being_opened("OAK", RuntimeError, dai.MessageQueue.QueueException):
            sensors = {sensor.socket.name: sensor for sensor in device.getConnectedCameraFeatures()}
            if _SOCKET not in sensors:
                why = f"has no camera on {_SOCKET}; it has {', '.join(sensors) or 'none'}"
                raise stream.camera_error("OAK", why, "Look at the camera's ribbon cable.", _SOCKET)
            sensor = sensors[_SOCKET]
            name = f"{device.getDeviceName()} {_SOCKET} ({sensor.sensorName})"
            # The sensor's whole view, divided by a whole number to a width that USB can carry, in
            # even numbers of pixels.
            parts = math.ceil(sensor.width / 2048)
            whole = sensor.width // parts // 2 * 2, sensor.height // parts // 2 * 2
            resolution = requested.resolution or whole
            calibration = device.readCalibrationOrDefault()
            # The lens position of the factory calibration; None for a fixed lens.
            focus = None
            if sensor.hasAutofocus and calibration.hasCameraCalibration(sensor.socket):
                focus = max(int(calibration.getLensPosition(sensor.socket)), 0) or None
            if requested.focus is None:
                requested = replace(requested, focus=focus)
            pipeline = dai.Pipeline(device)
            node = pipeline.create(dai.node.Camera).build(sensor.socket)
            if requested.focus is not None:
                node.initialControl.setManualFocus(requested.focus)
            if requested.exposure_us is not None and requested.gain is not None:
                node.initialControl.setManualExposure(requested.exposure_us, requested.gain)
            is_colour = dai.CameraSensorType.COLOR in sensor.supportedTypes
            kind = dai.ImgFrame.Type.BGR888i if is_colour else dai.ImgFrame.Type.GRAY8
            # The factory's matrix is for pictures that are scaled and cropped, and still distorted.
            crop = dai.ImgResizeMode.CROP
            output = node.requestOutput(resolution, kind, crop, _RATE_HZ, False)
            control = node.inputControl.createInputQueue()
            queue = output.createOutputQueue(maxSize=4, blocking=False)
            depth = _aligned_depth(dai, device, pipeline, output)
            pipeline.start()
            # A pipeline that still runs when Python ends aborts the process.
            closing.callback(weakref.finalize(self, _stop, pipeline))
            held = _hold_settings(dai, name, requested, sensor, queue, control)
        lens, source = _factory_intrinsics(dai, calibration, sensor.socket, resolution)
        self.factory = lens
        if self.factory is not None and focus is not None:
            source += f", for focus {focus}"
        settings = {"rate_hz": _RATE_HZ, "factory_intrinsics": source, **held}
        if depth is None or lens is None:
            return name, _arrivals(dai, queue), settings
        return name, _arrivals(dai, depth, lens), settings | {"depth_unit_m": 0.001}


def _open_device(dai: ModuleType, address: str) -> Handle:
    try:
        return dai.Device(dai.DeviceInfo(address)) if address else dai.Device()
    except RuntimeError as error:
        raise stream.camera_error(
            f"OAK {address}".rstrip(),
            f"cannot be opened: {error}",
            "Look at its cable (USB 3, in a blue socket) and its power, and whether another "
            "program holds it. On Linux USB needs a rule once: "
            f"echo '{_UDEV_RULE}' | sudo tee /etc/udev/rules.d/80-movidius.rules; "
            "sudo udevadm control --reload-rules; sudo udevadm trigger",
        ) from error


def _hold_settings(
    dai: ModuleType,
    name: str,
    requested: DeviceSetup,
    sensor: Handle,
    queue: Handle,
    control_queue: Handle,
) -> dict[str, str | float]:
    """Fixes the settings that the camera determined by itself, and returns them."""
    frame = queue.get(timedelta(seconds=5))
    until = time.monotonic() + stream.SETTLE_S
    while frame is not None and time.monotonic() < until:
        frame = queue.get(timedelta(seconds=1))
    if frame is None:
        step = "Look at its cable: USB 3 and short; and at its power."
        raise stream.camera_error(name, "starts, but gives no picture", step)
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


def _aligned_depth(
    dai: ModuleType, device: Handle, pipeline: Handle, colour: Handle
) -> Handle | None:
    """The queue of pictures with their depth, aligned to those without distortion."""
    if not dai.node.Depth.getSupportedAlgorithms(device):
        return None
    align, pairs = pipeline.create(dai.node.Align), pipeline.create(dai.node.Sync)
    for node in (align, pairs):
        node.setRunOnHost(True)
    pairs.setSyncThreshold(timedelta(seconds=0.5 / _RATE_HZ))
    pipeline.create(dai.node.Depth).build(_RATE_HZ).depth.link(align.input)
    colour.link(align.inputAlignTo)
    colour.link(pairs.inputs["colour"])
    align.outputAligned.link(pairs.inputs["depth"])
    return pairs.out.createOutputQueue(maxSize=4, blocking=False)


def _arrivals(
    dai: ModuleType, queue: Handle, lens: Camera | None = None
) -> Iterator[stream.Arrival | None]:
    """Pictures; with a lens, those of pairs with their depth."""

    def decode() -> Image:
        return np.array(message.getCvFrame(), dtype=np.uint8)

    def distances() -> Image16:
        found = cv2.remap(pair["depth"].getFrame(), across, down, cv2.INTER_NEAREST)
        return np.asarray(found, dtype=np.uint16)

    if lens is not None:
        # Each pixel's place in a picture without distortion.
        width, height = lens.resolution
        px = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        matrix, by = matrix_3x3(lens), cv2.fisheye if lens.model == "fisheye" else cv2
        places = by.undistortPoints(px.reshape(-1, 1, 2), matrix, lens.distortion, P=matrix)
        across, down = np.moveaxis(places.reshape(px.shape), -1, 0)
    while True:
        message = pair = queue.get(timedelta(seconds=0.1))
        if message is None:
            yield None
            continue
        if lens is not None:
            message = pair["colour"]
        # Depthai's clock is this host's monotonic one.
        middle_s = message.getTimestamp(dai.CameraExposureOffset.MIDDLE).total_seconds()
        began_s = middle_s - 0.5 * message.getExposureTime().total_seconds()
        exposed_s, depth = (began_s, middle_s), None if lens is None else distances
        yield stream.Arrival(time.monotonic(), decode, exposed_s, depth)


def _stop(pipeline: Handle) -> None:
    pipeline.stop()
    pipeline.wait()


def _factory_intrinsics(
    dai: ModuleType, calibration: Handle, socket: Handle, resolution: tuple[int, int]
) -> tuple[Camera | None, str]:
    """A socket's factory intrinsics, and where they are from or why they are not used.

    Depthai's CalibrationHandler uses single precision, and one matrix per camera at one size of the
    sensor, from which others follow by scaling to cover and cropping about the middle; distortion
    is OpenCV's 14 coefficients, or the fisheye's 4.
    """
    try:
        matrix = np.array(calibration.getCameraIntrinsics(socket, *resolution), dtype=float)
        coefficients = np.array(calibration.getDistortionCoefficients(socket), dtype=float)
        model = calibration.getDistortionModel(socket)
    except RuntimeError as error:
        return None, f"not used: the device has no calibration of {_SOCKET}: {error}"
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    source = "read from the device"
    if model == dai.CameraModel.Fisheye:
        return Camera("fisheye", resolution, intrinsics, coefficients[:4]), source
    if model != dai.CameraModel.Perspective:
        return None, f"not used: its model is {model.name}, but must be Perspective or Fisheye"
    tail = coefficients[8:]
    if np.any(tail != 0.0):
        why = f"thin-prism or tilt coefficients up to {np.abs(tail).max():.3g}, but must have zeros"
        return None, f"not used: it has {why}"
    count = 8 if np.any(coefficients[5:8] != 0.0) else 5
    padded = np.pad(coefficients, (0, max(8 - len(coefficients), 0)))
    return Camera("brown", resolution, intrinsics, padded[:count]), source
