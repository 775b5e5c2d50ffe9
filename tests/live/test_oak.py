"""OAK cameras: the host pipeline, raw frames, the device's settings and its calibration."""

import json
import time
from dataclasses import replace
from datetime import timedelta
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.samples import made_up

from visioncal.core.errors import DataError, DriverError
from visioncal.core.types import Camera
from visioncal.interchange.exports import Selection, document
from visioncal.live.drivers import oak
from visioncal.live.drivers.extras import depthai
from visioncal.live.drivers.oak import OakCamera
from visioncal.live.drivers.oak_calibration import calibration_json, factory_intrinsics
from visioncal.live.drivers.oak_hosted import HostedOak
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup, Frame
from visioncal.live.rehearsal.camera import RehearsalCamera
from visioncal.results import CameraResult
from visioncal.simulation import CellOptions, fisheye_camera, simulate, wide_camera

try:
    dai = depthai()
except DriverError:
    pytest.skip("depthai, which the extra oak brings, is not installed", allow_module_level=True)

RNG = np.random.default_rng(5)
# A busy machine may take its time; nothing here is about speed.
PATIENT_S = 20.0
# Single precision has 24 bits: half of the last of a focal length under 4096 px is 1.2e-4.
SINGLE_PX = 1.3e-4


class Source:
    """Pictures of noise, exposed for 8 ms from when they are asked for."""

    def __init__(self, count=100, shape=(48, 64), error=None):
        self.left, self.shape, self.error, self.sent = count, shape, error, []

    def __call__(self):
        """Takes one."""
        if self.error is not None:
            raise self.error
        if self.left == 0:
            return None
        self.left -= 1
        image = RNG.integers(0, 255, self.shape, dtype=np.uint8)
        self.sent.append(Frame(image, time.monotonic() + 0.004, 0.008))
        return self.sent[-1]


def same(frame, sent):
    # depthai keeps times in nanoseconds, Python's timedelta in microseconds.
    return (
        np.array_equal(frame.image, sent.image)
        and abs(frame.stamp_s - sent.stamp_s) < 2e-6
        and abs(frame.exposure_s - sent.exposure_s) < 1e-6
    )


def replayed(raw):
    """The frames of a file of raw frames, in colours, as depthai replays them."""
    video = cv2.VideoCapture(str(raw))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    pipeline = dai.Pipeline(createImplicitDevice=False)
    node = pipeline.create(dai.node.ReplayVideo)
    node.setReplayVideoFile(raw)
    node.setReplayMetadataFile(raw.with_suffix(".mcap"))
    node.setOutFrameType(dai.ImgFrame.Type.BGR888i)
    # At the end of a file the pipeline stops, often before its last frame is taken.
    node.setLoop(True)
    # It waits for whoever takes its frames: none is dropped.
    queue = node.out.createOutputQueue(maxSize=4, blocking=True)
    pipeline.start()
    frames = []
    for _ in range(count):
        message = queue.get(timedelta(seconds=PATIENT_S))
        middle = message.getTimestamp(dai.CameraExposureOffset.MIDDLE).total_seconds()
        exposure_s = message.getExposureTime().total_seconds()
        frames.append(Frame(message.getCvFrame().copy(), middle, exposure_s))
    pipeline.stop()
    pipeline.wait()
    return frames


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_pictures_go_through_the_pipeline_as_they_are(shape):
    source = Source(shape=shape)
    camera = HostedOak(source, (64, 48), factory=wide_camera(), settings={"rate_hz": 10.0})
    assert isinstance(camera, CameraDevice)
    for _ in range(3):
        asked = time.monotonic()
        frame = camera.frame(timeout_s=PATIENT_S)
        assert same(frame, source.sent[-1])
        assert frame.stamp_s - 0.5 * frame.exposure_s >= asked
    # Nobody's pictures are taken for nothing.
    assert len(source.sent) == 3
    camera.close()
    camera.close()
    with pytest.raises(DriverError, match="no frames any more"):
        camera.frame()


def test_the_end_and_the_errors_of_a_source_are_told():
    camera = HostedOak(Source(0), (64, 48))
    with pytest.raises(DriverError, match="at its end"):
        camera.frame(timeout_s=PATIENT_S)
    camera.close()
    source = Source(error=DriverError("unplugged"))
    camera = HostedOak(source, (64, 48))
    with pytest.raises(DriverError, match="unplugged"):
        camera.frame(timeout_s=PATIENT_S)
    # Plugged in again it goes on.
    source.error = None
    assert same(camera.frame(timeout_s=PATIENT_S), source.sent[-1])
    camera.close()
    camera = HostedOak(Source(), (640, 480))
    with pytest.raises(DriverError, match="64x48; 640x480 was promised"):
        camera.frame(timeout_s=PATIENT_S)
    camera.close()


@pytest.mark.parametrize("ending", [".avi", ".mkv"])
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_raw_frames_come_back_bit_for_bit_with_their_times_and_all_of_them(tmp_path, shape, ending):
    source, raw = Source(shape=shape), tmp_path / f"raw{ending}"
    camera = HostedOak(source, (64, 48), raw=raw)
    for _ in range(6):
        camera.frame(timeout_s=PATIENT_S)
    camera.close()
    for kept, sent in zip(replayed(raw), source.sent, strict=True):
        grey = kept.image[..., 0] if sent.image.ndim == 2 else kept.image
        assert same(replace(kept, image=grey), sent)


def test_raw_files_that_lose_or_replace_something_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"\.avi or \.mkv"):
        HostedOak(Source(), (64, 48), raw=tmp_path / "raw.mp4")
    (tmp_path / "raw.mcap").write_text("mine")
    with pytest.raises(DataError, match=r"raw\.mcap"):
        HostedOak(Source(), (64, 48), raw=tmp_path / "raw.avi")


class Device:
    """What an OAK says of itself."""

    def __init__(self, calibration, sensor):
        self.calibration, self.sensor, self.is_closed = calibration, sensor, False

    def getDeviceName(self):  # noqa: N802
        """As depthai names it."""
        return "OAK-D"

    def getConnectedCameraFeatures(self):  # noqa: N802
        """Its sensors."""
        return [self.sensor]

    def readCalibrationOrDefault(self):  # noqa: N802
        """What its factory wrote."""
        return self.calibration

    def close(self):
        """Lets go of it."""
        self.is_closed = True


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

    def requestOutput(self, *asked):  # noqa: N802
        """Tells what was asked for."""
        self.seen.level = asked
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
            self.out.send(message)
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
    device, seen = Device(handler, sensor), SimpleNamespace(sent=[])

    class Pipeline:
        """A pipeline without a device."""

        def __init__(self, _):
            self.real = dai.Pipeline(createImplicitDevice=False)

        def create(self, node):
            """Makes a node; the camera's tells what it is asked."""
            return self.real.create(node, seen) if node is CameraNode else self.real.create(node)

        def __getattr__(self, name):
            return getattr(self.real, name)

    library = SimpleNamespace(**{name: getattr(dai, name) for name in dir(dai) if name[0] != "_"})
    library.Device, library.Pipeline = lambda *_: device, Pipeline
    library.node = SimpleNamespace(Camera=CameraNode, RecordVideo=dai.node.RecordVideo)
    monkeypatch.setattr(oak, "depthai", lambda: library)
    # Long enough for a picture or two.
    monkeypatch.setattr(oak, "_SETTLE_S", 0.1)
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
    asked = time.monotonic()
    frame = camera.frame(timeout_s=PATIENT_S)
    assert frame.image.shape == (1520, 2028, 3)
    assert frame.stamp_s - 0.003 >= asked
    # Never undistorted by the device: the lens is ours to calibrate.
    assert seen.level[-1] is False
    camera.close()
    assert device.is_closed


def test_what_is_wished_is_set_from_the_start(monkeypatch):
    _, seen = a_device(monkeypatch, is_colour=False)
    requested = DeviceSetup((640, 400), 5000, 200, 90, {"rate_hz": "20"})
    camera = OakCamera(requested)
    camera.close()
    assert seen.initial.getExposureTime().total_seconds() == pytest.approx(5e-3)
    assert (seen.initial.getSensitivity(), seen.initial.getLensPosition()) == (200, 90)
    held = {"rate_hz": 20.0, "exposure_us": 5000, "gain": 200, "focus": 90}
    assert held.items() <= camera.settings.items()
    assert camera.resolution == (640, 400)
    assert seen.level[1] == dai.ImgFrame.Type.GRAY8


def test_it_focuses_where_the_factory_calibrated(monkeypatch):
    _, seen = a_device(monkeypatch, lens=120)
    camera = OakCamera(DeviceSetup((640, 400)))
    camera.close()
    assert seen.initial.getLensPosition() == 120
    assert camera.settings["focus"] == 120
    assert camera.settings["factory_intrinsics"].endswith("for focus 120")


def test_the_factorys_intrinsics_are_scaled_and_cropped(monkeypatch):
    a_device(monkeypatch, coefficients=(-0.1, 0.05, 1e-3, -1e-3, 0.01))
    camera = OakCamera(DeviceSetup((2028, 1140)))
    camera.close()
    # Half the size; 1520 rows are cropped to 1140 about the middle.
    assert camera.factory.matrix == pytest.approx([1500.25, 1500.75, 1015.125, 569.25], abs=1e-3)
    assert camera.factory.distortion == pytest.approx([-0.1, 0.05, 1e-3, -1e-3, 0.01], abs=1e-8)
    assert camera.settings["factory_intrinsics"] == "read from the device"


def test_a_device_without_calibration_is_used_without(monkeypatch):
    device, _ = a_device(monkeypatch)
    device.calibration = dai.CalibrationHandler()
    camera = OakCamera(DeviceSetup((640, 400)))
    camera.close()
    assert camera.factory is None
    assert "no calibration of CAM_A" in camera.settings["factory_intrinsics"]


def test_a_devices_raw_frames_are_recorded(monkeypatch, tmp_path):
    a_device(monkeypatch)
    raw = tmp_path / "raw.mkv"
    camera = OakCamera(DeviceSetup((64, 48), more={"raw": str(raw)}))
    camera.frame(timeout_s=PATIENT_S)
    frame = camera.frame(timeout_s=PATIENT_S)
    camera.close()
    stamps = [value.stamp_s for value in replayed(raw)]
    # All of them, whether or not anybody took them: one at least while exposure and focus settled.
    assert np.abs(np.array(stamps) - frame.stamp_s).min() < 2e-6
    assert len(stamps) > 2


def test_a_lens_that_no_model_of_ours_describes_is_not_taken(monkeypatch):
    a_device(monkeypatch, coefficients=[0.1] * 9)
    camera = OakCamera(DeviceSetup((640, 400)))
    camera.close()
    assert camera.factory is None
    assert "thin-prism" in camera.settings["factory_intrinsics"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"sockt": "CAM_A"}, "Did you mean socket"),
        ({"socket": "CAM_Q"}, "CAM_A to CAM_J"),
        ({"socket": "CAM_B"}, "no camera on CAM_B; it has CAM_A"),
        ({"rate_hz": "fast"}, "pictures a second"),
    ],
)
def test_options_that_are_wrong_are_refused_and_the_device_let_go(monkeypatch, more, words):
    device, _ = a_device(monkeypatch)
    with pytest.raises(DriverError) as caught:
        OakCamera(DeviceSetup(more=more))
    assert words in str(caught.value)
    # What is wrong by itself is told before the device is opened.
    assert device.is_closed == ("CAM_B" in more.values())


def test_without_a_device_it_tells_of_the_cable_and_the_rule(monkeypatch):
    def none(*_):
        raise RuntimeError("No available devices")

    monkeypatch.setattr(oak, "depthai", lambda: SimpleNamespace(Device=none))
    with pytest.raises(DriverError, match="No available devices") as caught:
        OakCamera()
    assert "cable" in caught.value.next_step
    assert "03e7" in caught.value.next_step


def parsed(text):
    return dai.CalibrationHandler.fromJson(json.loads(text))


RATIONAL = np.array([-0.115, 0.062, 0.0004, -0.0003, -0.008, 0.01, -0.02, 0.003])


@pytest.mark.parametrize("camera", [wide_camera(), fisheye_camera()])
def test_a_calibration_is_read_back_to_single_precision(camera):
    back = factory_intrinsics(parsed(calibration_json(camera, "CAM_B")), "CAM_B", camera.resolution)
    assert back.model == camera.model
    assert np.abs(back.matrix - camera.matrix).max() < SINGLE_PX
    assert np.abs(back.distortion - camera.distortion).max() < 1e-8


def test_a_calibration_written_onto_the_devices_own_keeps_all_else(monkeypatch):
    device, _ = a_device(monkeypatch, lens=120)
    handler, there = device.calibration, dai.CameraBoardSocket.CAM_B
    handler.setBoardInfo("BW1098OBC", "R0M0E0")
    handler.setCameraIntrinsics(there, [[800.0, 0, 640], [0, 800, 400], [0, 0, 1]], 1280, 800)
    handler.setDistortionCoefficients(there, [0.0] * 14)
    turn, shift = np.eye(3).tolist(), [-7.5, 0.0, 0.0]
    handler.setCameraExtrinsics(there, dai.CameraBoardSocket.CAM_A, turn, shift, shift)
    own = json.dumps(handler.eepromToJson())
    camera = Camera("brown", (1280, 800), wide_camera().matrix, RATIONAL)
    written = parsed(calibration_json(camera, "CAM_A", own))
    back = factory_intrinsics(written, "CAM_A", (1280, 800))
    # The matrix is kept at the sensor's size, over three times larger, and carried back.
    assert np.abs(back.matrix - camera.matrix).max() < SINGLE_PX
    assert np.abs(back.distortion - RATIONAL).max() < 1e-8
    assert written.getDefaultIntrinsics(dai.CameraBoardSocket.CAM_A)[1:] == (4056, 3040)
    assert written.getLensPosition(dai.CameraBoardSocket.CAM_A) == 120
    assert written.getCameraTranslationVector(there, dai.CameraBoardSocket.CAM_A) == shift
    before, after = json.loads(own), written.eepromToJson()
    assert {name for name in before if before[name] != after[name]} == {"cameraData"}


def test_the_export_names_the_socket_and_warns_without_the_devices_own():
    lens = CameraResult(wide_camera(), estimated=True)
    source = replace(made_up(5).calibration, camera=lens)
    written = document(source, "oak", Selection(child="CAM_C"))
    assert parsed(written.text).hasCameraCalibration(dai.CameraBoardSocket.CAM_C)
    assert any("--onto" in warning for warning in written.warnings)
    onto = document(source, "oak", Selection(onto=written.text))
    assert not any("--onto" in warning for warning in onto.warnings)
    with pytest.raises(DataError, match="CAM_A to CAM_J"):
        document(source, "oak", Selection(child="cam"))
    with pytest.raises(DataError, match="no calibration of an OAK") as error:
        document(source, "oak", Selection(onto="{}"))
    assert error.value.culprits == ("--onto",)


def test_a_rehearsals_camera_goes_through_the_pipeline():
    cell = simulate(CellOptions(views=1))
    seen = RehearsalCamera(cell, lambda at: np.tile(cell.robot.joints[0], (len(at), 1)))
    camera = HostedOak(seen.frame, seen.resolution, factory=seen.factory, settings=seen.settings)
    frame = camera.frame(timeout_s=PATIENT_S)
    assert frame.image.shape == (800, 1280)
    assert frame.exposure_s == pytest.approx(0.008)
    seen.fault = "unplugged"
    with pytest.raises(DriverError, match="no picture within 1 s"):
        camera.frame(timeout_s=PATIENT_S)
    camera.close()
