"""OAK cameras: the device's settings, its frames and its calibration."""

import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.refusals import raised

from visioncal.core.errors import DriverError
from visioncal.live.drivers import oak, stream
from visioncal.live.drivers.oak import OakCamera, depthai
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup

try:
    dai = depthai()
except DriverError:
    pytest.skip("depthai, which the extra oak brings, is not installed", allow_module_level=True)

PERSPECTIVE = dai.CameraModel.Perspective
PINHOLE = [[250, 0, 159.5], [0, 250, 99.5], [0, 0, 1]]
# A busy machine may take its time; nothing here is about speed.
PATIENT_S = 20.0


class CameraNode(dai.node.ThreadedHostNode):
    """A camera node that runs on this host: it takes pictures all the time, on automatic."""

    def __init__(self, seen):
        dai.node.ThreadedHostNode.__init__(self)
        self.out, self.seen = self.createOutput(), seen
        self.initialControl = seen.initial = dai.CameraControl()
        queue = SimpleNamespace(send=seen.sent.append)
        self.inputControl = SimpleNamespace(createInputQueue=lambda: queue)

    def build(self, socket):
        """Belongs to a socket."""
        self.seen.socket = socket.name
        return self

    def requestOutput(self, *options):  # noqa: N802
        """Tells what was asked for."""
        self.seen.level = options
        return self.out

    def run(self):
        """Sends pictures."""
        (width, height), kind = self.seen.level[:2]
        shape = (height, width) if kind == dai.ImgFrame.Type.GRAY8 else (height, width, 3)
        while self.isRunning():
            message = dai.ImgFrame()
            message.setCvFrame(np.zeros(shape, np.uint8), kind)
            message.cam.exposureTimeUs, message.cam.sensitivityIso = 6000, 320
            message.cam.lensPosition = 131
            message.setTimestamp(dai.Clock.now())
            if self.seen.transformation is not None:
                message.setTransformation(self.seen.transformation)
            self.out.send(message)
            time.sleep(0.02)


class DepthNode(dai.node.ThreadedHostNode):
    """A stereo pair's depth, on this host: a near square before a wall, 30 mm beside the colour."""

    def __init__(self, seen):
        dai.node.ThreadedHostNode.__init__(self)
        self.depth, self.seen = self.createOutput(), seen

    def build(self, rate_hz):
        """Has a rate."""
        self.seen.depth_hz = rate_hz
        return self

    getSupportedAlgorithms = staticmethod(lambda device: device.depths)  # noqa: N815

    def run(self):
        """Sends distances [mm]."""
        distances = np.full((200, 320), 800, np.uint16)
        distances[90:130, 220:260] = 500
        shift = dai.Extrinsics(
            [[1, 0, 0, -3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dai.CameraBoardSocket.CAM_A
        )
        while self.isRunning():
            message = dai.ImgFrame()
            message.setCvFrame(distances, dai.ImgFrame.Type.RAW16)
            message.setTransformation(
                dai.ImgTransformation(320, 200, PINHOLE, PERSPECTIVE, [0.0] * 14, shift)
            )
            message.setTimestamp(dai.Clock.now())
            self.depth.send(message)
            time.sleep(0.02)


def a_device(monkeypatch, *, lens=0, coefficients=(), is_colour=True, has_autofocus=True):
    """Puts a device in depthai's place: its pipeline is real, its camera is a node of the host."""
    camera = dai.CameraBoardSocket.CAM_A
    handler = dai.CalibrationHandler()
    matrix = [[3000.5, 0, 2030.25], [0, 3001.5, 1518.5], [0, 0, 1]]
    handler.setCameraIntrinsics(camera, matrix, 4056, 3040)
    handler.setDistortionCoefficients(camera, [*coefficients, *[0.0] * (14 - len(coefficients))])
    handler.setCameraType(camera, dai.CameraModel.Perspective)
    handler.setLensPosition(camera, lens)
    kind = dai.CameraSensorType.COLOR if is_colour else dai.CameraSensorType.MONO
    sensor = SimpleNamespace(
        socket=camera,
        sensorName="IMX378",
        width=4056,
        height=3040,
        hasAutofocus=has_autofocus,
        supportedTypes=[kind],
    )
    device = SimpleNamespace(sensor=sensor, is_closed=False, depths=[])
    seen = SimpleNamespace(sent=[], transformation=None)
    device.getDeviceName, device.readCalibrationOrDefault = (lambda: "OAK-D"), (lambda: handler)
    device.getConnectedCameraFeatures = lambda: [device.sensor]
    device.close = lambda: setattr(device, "is_closed", True)

    class Pipeline:
        """A pipeline without a device."""

        def __init__(self, _):
            self.real = dai.Pipeline(createImplicitDevice=False)

        def create(self, node):
            """Makes a node; the device's own tell what they are asked."""
            is_faked = node in (CameraNode, DepthNode)
            return self.real.create(node, seen) if is_faked else self.real.create(node)

        def __getattr__(self, name):
            return getattr(self.real, name)

    library = SimpleNamespace(**{name: getattr(dai, name) for name in dir(dai) if name[0] != "_"})
    library.Device, library.Pipeline = lambda *_: device, Pipeline
    library.node = SimpleNamespace(
        Camera=CameraNode, Depth=DepthNode, Align=dai.node.Align, Sync=dai.node.Sync
    )
    monkeypatch.setattr(oak, "depthai", lambda: library)
    # Long enough for a picture or two.
    monkeypatch.setattr(stream, "SETTLE_S", 0.1)
    return device, seen


def test_a_device_is_held_where_automatic_exposure_and_focus_went(monkeypatch):
    device, seen = a_device(monkeypatch)
    camera = OakCamera()
    assert isinstance(camera, CameraDevice)
    assert camera.name == "OAK-D CAM_A (IMX378)"
    assert (camera.settings["exposure_us"], camera.settings["gain"]) == (6000, 320)
    assert camera.settings["focus"] == 131
    (control,) = seen.sent
    assert control.getExposureTime().total_seconds() == pytest.approx(6e-3)
    assert (control.getSensitivity(), control.getLensPosition()) == (320, 131)
    request_s = time.monotonic()
    frame = camera.frame(timeout_s=PATIENT_S)
    assert frame.image.shape == (1520, 2028, 3)
    assert frame.stamp_s - 0.003 >= request_s
    # Never undistorted by the device: the lens is ours to calibrate.
    assert seen.level[-1] is False
    camera.close()
    assert device.is_closed


def test_requested_settings_are_made_from_the_start(monkeypatch):
    _, seen = a_device(monkeypatch, is_colour=False)
    requested = DeviceSetup((640, 400), 5000, 200, 90)
    camera = OakCamera("", requested)
    camera.close()
    assert seen.initial.getExposureTime().total_seconds() == pytest.approx(5e-3)
    assert (seen.initial.getSensitivity(), seen.initial.getLensPosition()) == (200, 90)
    held = {"rate_hz": 10.0, "exposure_us": 5000, "gain": 200, "focus": 90}
    assert held.items() <= camera.settings.items()
    assert camera.resolution == (640, 400)
    assert seen.level[1] == dai.ImgFrame.Type.GRAY8


def test_the_factorys_intrinsics_are_scaled_and_cropped(monkeypatch):
    a_device(monkeypatch, coefficients=(-0.1, 0.05, 1e-3, -1e-3, 0.01))
    camera = OakCamera("", DeviceSetup((2028, 1140)))
    camera.close()
    # Half the size; 1520 rows are cropped to 1140 about the middle.
    assert camera.factory.matrix == pytest.approx([1500.25, 1500.75, 1015.125, 569.25], abs=1e-3)
    assert camera.factory.distortion == pytest.approx([-0.1, 0.05, 1e-3, -1e-3, 0.01], abs=1e-8)
    assert camera.settings["factory_intrinsics"] == "read from the device"


def test_a_lens_that_no_model_of_ours_describes_is_not_taken(monkeypatch):
    a_device(monkeypatch, coefficients=[0.1] * 9)
    camera = OakCamera("", DeviceSetup((640, 400)))
    camera.close()
    assert camera.factory is None
    assert "thin-prism" in camera.settings["factory_intrinsics"]


def test_depth_is_that_of_each_pixel_of_a_distorted_picture(monkeypatch):
    coefficients = (-0.3, 0.1, 0.0, 0.0, 0.0)
    device, seen = a_device(monkeypatch, coefficients=coefficients)
    device.depths, matrix = ["stereo"], np.array([[250, 0, 159.5], [0, 250, 99.5], [0, 0, 1.0]])
    handler = device.readCalibrationOrDefault()
    handler.setCameraIntrinsics(device.sensor.socket, matrix.tolist(), 320, 200)
    extrinsics = dai.Extrinsics(np.eye(4).tolist(), device.sensor.socket)
    distortion = [*coefficients, *[0.0] * 9]
    seen.transformation = dai.ImgTransformation(
        320, 200, PINHOLE, PERSPECTIVE, distortion, extrinsics
    )
    camera = OakCamera("", DeviceSetup((320, 200)))
    frame = camera.frame(timeout_s=PATIENT_S)
    camera.close()
    assert device.is_closed
    assert camera.settings["depth_unit_m"] == 0.001
    assert frame.depth.shape == frame.image.shape[:2]
    assert set(np.unique(frame.depth)) == {0, 500, 800}
    # The near square's corners, as OpenCV has them in the colour camera's picture.
    corners = np.array([[u, v, 1.0] for u in (220, 259) for v in (90, 129)]) - [159.5, 99.5, 0.0]
    corners = 0.5 * corners / [250, 250, 1] - [0.03, 0.0, 0.0]
    px = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0]
    v, u = np.nonzero(frame.depth == 500)
    assert [u.min(), v.min()] == pytest.approx(px[:, 0].min(axis=0), abs=1.5)
    assert [u.max(), v.max()] == pytest.approx(px[:, 0].max(axis=0), abs=1.5)
    # Without the distortion it would be elsewhere by more than that.
    straight = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), matrix, None)[0]
    assert np.abs(straight.max(axis=0) - px.max(axis=0)).max() > 2.5


def test_a_device_without_that_camera_is_refused_and_let_go(monkeypatch):
    device, _ = a_device(monkeypatch)
    device.sensor.socket = dai.CameraBoardSocket.CAM_B
    raised(DriverError, "no camera on CAM_A; it has CAM_B", OakCamera)
    assert device.is_closed


def test_a_missing_device_is_reported_with_cable_and_rule(monkeypatch):
    def none(*_):
        raise RuntimeError("No available devices")

    monkeypatch.setattr(oak, "depthai", lambda: SimpleNamespace(Device=none))
    caught = raised(DriverError, "No available devices", OakCamera)
    assert "cable" in caught.next_step
    assert "03e7" in caught.next_step
