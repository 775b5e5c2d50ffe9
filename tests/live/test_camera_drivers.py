"""Cameras of other libraries, by the emulators that these bring, and folders of pictures."""

import io
import os
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.live_cell import fake_devices, fake_plan
from support.refusals import raised

from visioncal.core.errors import DriverError
from visioncal.live.capture.devices import open_camera
from visioncal.live.drivers import features, folder, realsense
from visioncal.live.drivers.features import Features, bgr_or_grey
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.session import Session

# SWIG's modules warn of themselves as they are imported.
pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
# Longer than anything takes that comes at all [s].
PATIENT_S = 20.0
TYPED = ("--arm", "manual", "--target", "charuco_9x6_30mm", "--frames", 2, "--settle-s", 0.03)


@pytest.fixture(scope="module")
def seen():
    """Poses as a UR's pendant shows them, a line each, and what the camera then sees."""
    plan = fake_plan(3)
    arm, camera = fake_devices(plan)
    lines, pictures = [], []
    for stop in plan.stops:
        arm.q0 = stop.q
        pictures.append(camera.frame().image)
        pose = arm.true_flange(0.0)
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
        lines.append(f"p[{', '.join(f'{value:.6f}' for value in numbers)}]\n")
    return lines, pictures


def record(lines, camera, out, *more):
    with patch.object(sys, "stdin", io.StringIO("".join(lines))):
        return visioncal("record", *TYPED, "--camera", camera, "-o", out, *more)


def recorded(out):
    return [cv2.imread(str(out / view.image), -1) for view in Session.load(out).views]


def test_a_folder_that_still_grows_gives_each_picture_to_its_pose(seen, tmp_path, monkeypatch):
    lines, pictures = seen
    inbox = tmp_path / "bilder ü"
    inbox.mkdir()
    files = [cv2.imencode(".png", picture)[1].tobytes() for picture in pictures]
    # The third comes before the second in the alphabet.
    (inbox / "shot8.png").write_bytes(files[0])
    (inbox / "shot9.png").write_bytes(files[1][:20_000])
    (inbox / "shot9.txt").write_text("no picture")

    def goes_on():
        time.sleep(0.5)
        (inbox / "shot9.png").write_bytes(files[1])
        time.sleep(0.5)
        (inbox / "shot10.png").write_bytes(files[2])

    writing = threading.Thread(target=goes_on)
    writing.start()
    record(lines, f"folder:{inbox}", tmp_path / "live", "--views", 3).good()
    writing.join()
    for found, picture in zip(recorded(tmp_path / "live"), pictures, strict=True):
        assert np.array_equal(found, picture)
    monkeypatch.setattr(folder, "_PATIENCE_S", 0.3)
    ended = record([*lines, lines[0]], f"folder:{inbox}", tmp_path / "more")
    ended.refused("has no further picture (3 were given)", "3 views are safe", "into a new session")
    record(lines, f"folder:{inbox}", tmp_path / "live", "--resume").refused("by their order alone")
    (inbox / "shot9.png").write_bytes(files[1][:20_000])
    record(lines, f"folder:{inbox}", tmp_path / "cut").refused("shot9.png: unreadable")
    camera = open_camera(f"folder:{inbox}", DeviceSetup((320, 200)))
    assert isinstance(camera, CameraDevice)
    raised(DriverError, "640x400 pixels; needed are 320x200", camera.frame)
    raised(DriverError, "does not exist", open_camera, "folder:none", DeviceSetup())
    raised(DriverError, "cannot be set", open_camera, f"folder:{inbox}", DeviceSetup(gain=2))


@pytest.mark.parametrize("kind", ["genicam", "basler", "realsense"])
def test_a_missing_library_is_named_with_the_command(kind, monkeypatch):
    for module in ("harvesters.core", "pypylon.pylon", "pyrealsense2"):
        monkeypatch.setitem(sys.modules, module, None)
    error = raised(DriverError, "cannot be imported", open_camera, kind, DeviceSetup())
    assert error.next_step.startswith("Install it: pip install '")


def test_what_is_automatic_settles_and_is_held(monkeypatch):
    values = {"ExposureAuto": "Continuous", "GainAuto": "Off", "GainRaw": 12, "Width": 640}
    nodes = {name: SimpleNamespace(value=value) for name, value in values.items()}
    nodes |= {"ExposureTimeAbs": SimpleNamespace(value=1.0)}
    nodes |= {"PixelFormat": SimpleNamespace(value="Mono12"), "OffsetX": SimpleNamespace(value=8)}
    camera = Features("camera", nodes.__getitem__, "value", (KeyError,))
    raised(
        DriverError,
        "does not take --focus 3: FocusPosition",
        camera.configure,
        DeviceSetup(focus=3),
    )
    raised(DriverError, "--resolution 400: Height", camera.configure, DeviceSetup((600, 400)))
    camera.configure(DeviceSetup(gain=30))
    assert (nodes["GainRaw"].value, nodes["PixelFormat"].value) == (30, "Mono8")
    assert (nodes["Width"].value, nodes["OffsetX"].value) == (600, 0)
    monkeypatch.setattr(features, "_SETTLE_S", 0.05)

    def exposing():
        while True:
            nodes["ExposureTimeAbs"].value = min(nodes["ExposureTimeAbs"].value + 1.0, 9.0)
            yield None

    held = camera.held(exposing())
    assert (nodes["ExposureAuto"].value, held["exposure_us"]) == ("Off", 9.0)


@pytest.mark.parametrize("pattern", ["RG", "GR", "GB", "BG"])
def test_a_bayer_pattern_has_the_colours_of_its_name(pattern):
    bgr = {"R": 200, "G": 100, "B": 30}
    second = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[pattern]
    block = np.array([[bgr[letter] for letter in row] for row in (pattern, second)], np.uint8)
    image = bgr_or_grey(np.tile(block, (8, 8)), f"Bayer{pattern}8")
    assert (image[2:-2, 2:-2] == [30, 100, 200]).all()


def test_a_gentl_producer_is_found_and_its_camera_chosen(monkeypatch):
    genicam = pytest.importorskip("genicam")
    pytest.importorskip("harvesters")
    producer = Path(genicam.__file__).parent / "viky.cti"
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    raised(DriverError, "GENICAM_GENTL64_PATH names no", open_camera, "genicam:1", DeviceSetup())
    raised(DriverError, "no file /no.cti", open_camera, "genicam:/no.cti:1", DeviceSetup())
    stated = f"genicam:{producer}"
    error = raised(DriverError, "may be any of several", open_camera, stated, DeviceSetup())
    assert error.next_step == f"Say which: --camera {stated}:VikyTL_DEV_red."
    raised(DriverError, "connected: VikyTL_DEV_red 0", open_camera, f"{stated}:7", DeviceSetup())
    wide = DeviceSetup((900, 300))
    raised(DriverError, "900: Width: .*Max = 800", open_camera, f"{stated}:0", wide)
    monkeypatch.setenv("GENICAM_GENTL64_PATH", os.pathsep.join(["/none", str(producer.parent)]))
    for name in ("VikyTL_DEV_red", "1"):
        with closing(open_camera(f"genicam:{name}", DeviceSetup((300, 200)))) as camera:
            asked_s = time.monotonic()
            frame = camera.frame(timeout_s=PATIENT_S)
            # A second opening finds the producer in use.
            raised(DriverError, "connected: none", open_camera, f"genicam:{name}", DeviceSetup())
        assert frame.image.shape == (200, 300)
        assert np.ptp(frame.image) > 100
        assert asked_s <= frame.stamp_s <= time.monotonic()
        camera.close()


@pytest.fixture
def pylon(monkeypatch):
    """Basler's emulator, which sends a file's picture where it is opened."""
    library = pytest.importorskip("pypylon.pylon")
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    emulated = SimpleNamespace(file="", is_removed=False, device=None)
    open_it = library.InstantCamera.Open

    def opened(device):
        open_it(device)
        emulated.device = device
        device.ExposureAuto.Value = "Continuous"
        if emulated.file:
            device.TestImageSelector.Value, device.ImageFileMode.Value = "Off", "On"
            device.ImageFilename.Value = str(emulated.file)

    monkeypatch.setattr(library.InstantCamera, "Open", opened)
    gone = "IsCameraDeviceRemoved"
    monkeypatch.setattr(library.InstantCamera, gone, lambda _: emulated.is_removed)
    monkeypatch.setattr(features, "_SETTLE_S", 0.1)
    return emulated


def test_a_baslers_pictures_are_recorded_bit_for_bit(pylon, seen, tmp_path):
    lines, pictures = seen
    for number, (line, picture) in enumerate(zip(lines, pictures, strict=True), 1):
        pylon.file = tmp_path / f"{number}.png"
        cv2.imwrite(str(pylon.file), picture)
        more = (
            "--resolution",
            "640,400",
            "--views",
            number,
            *(("--resume",) if number > 1 else ()),
        )
        record([line], "basler", tmp_path / "live", *more).good()
    for found, picture in zip(recorded(tmp_path / "live"), pictures, strict=True):
        assert np.array_equal(found, picture)
    row = Session.load(tmp_path / "live").views[0].text
    assert (row["device_pixel_format"], float(row["device_exposure_us"])) == ("Mono8", 10_000.0)
    assert pylon.device.IsOpen() is False


def test_a_basler_that_is_not_there_refuses_or_leaves_is_told(pylon):
    raised(DriverError, "connected: 0815-0000", open_camera, "basler:7", DeviceSetup())
    too_long = DeviceSetup(exposure_us=10**9)
    raised(DriverError, "must be smaller than or equal", open_camera, "basler", too_long)
    with closing(open_camera("basler:0815-0000", DeviceSetup((64, 48), 5000, 3))) as camera:
        assert pylon.device.ExposureAuto.Value == "Off"
        assert camera.frame(timeout_s=PATIENT_S).exposure_s == pytest.approx(5e-3)
        pylon.is_removed = True
        camera._thread.join(PATIENT_S)
        raised(DriverError, "it is unplugged", camera.frame)
    assert pylon.device.IsOpen() is False


@pytest.fixture
def streamed(monkeypatch):
    """A RealSense in software: opens it with a lens, and sends pictures of a running number."""
    rs = pytest.importorskip("pyrealsense2")
    device = rs.software_device()
    device.register_info(rs.camera_info.serial_number, "123")
    device.register_info(rs.camera_info.name, "RealSense D435")
    sensor, ended = device.add_sensor("RGB Camera"), threading.Event()
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 64, 48, 60.0, 61.0, 31.0, 23.5
    video = rs.video_stream()
    video.type, video.fmt, video.bpp = rs.stream.color, rs.format.bgr8, 3
    video.width, video.height, video.fps, video.uid, video.intrinsics = 64, 48, 30, 1, lens
    profile = sensor.add_video_stream(video).as_video_stream_profile()
    monkeypatch.setattr(rs, "context", lambda: SimpleNamespace(query_devices=lambda: [device]))

    def send():
        number = 0
        while not ended.wait(0.02):
            number += 1
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp, frame.stride = np.full((48, 64, 3), number, np.uint8), 3, 192
            frame.timestamp, frame.domain = 1e3 * time.time(), rs.timestamp_domain.global_time
            frame.frame_number, frame.profile = number, profile
            # Exposed until 4 ms before readout, for up to 8 ms, on the device's own clock [us].
            sensor.set_metadata(rs.frame_metadata_value.frame_timestamp, 1_000_000 * number)
            sensor.set_metadata(rs.frame_metadata_value.sensor_timestamp, 1_000_000 * number - 4000)
            sensor.on_video_frame(frame)

    sending = threading.Thread(target=send)
    sending.start()
    yield SimpleNamespace(rs=rs, lens=lens, ended=ended)
    ended.set()
    sending.join()


def test_a_realsense_gives_colour_its_time_and_its_factory_lens(streamed):
    raised(DriverError, r"it has \[\(64, 48\)\]", open_camera, "realsense", DeviceSetup((640, 480)))
    raised(DriverError, "cannot be set", open_camera, "realsense", DeviceSetup(None, 100))
    raised(DriverError, "connected: 123", open_camera, "realsense:7", DeviceSetup())
    with closing(open_camera("realsense:123", DeviceSetup())) as camera:
        asked_s = time.monotonic()
        frame = camera.frame(timeout_s=PATIENT_S)
        # Its exposure began after the request, and it was stamped in its middle.
        assert asked_s + 4e-3 - 1e-3 <= frame.stamp_s <= time.monotonic() - 3e-3
        assert np.ptp(frame.image) == 0
        assert camera.factory.matrix == pytest.approx([60.0, 61.0, 31.0, 23.5])
        streamed.ended.set()
        raised(DriverError, "stalls", camera.frame, timeout_s=0.2)


def test_a_lens_of_uncertain_direction_is_not_passed_off_as_opencvs():
    rs = pytest.importorskip("pyrealsense2")
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 640, 480, 600, 610, 320.5, 241
    lens.coeffs, lens.model = [-0.2, 0.1, 1e-3, -2e-3, 0.05], rs.distortion.brown_conrady
    camera, source = realsense.factory_intrinsics(rs, lens)
    assert source == "read from the device"
    # Librealsense's own projection and OpenCV's.
    point = [0.21, -0.13, 0.6]
    matrix = np.array([[600, 0, 320.5], [0, 610, 241], [0, 0, 1.0]])
    ours = cv2.projectPoints(np.array([point]), *np.zeros((2, 3)), matrix, camera.distortion)[0]
    # Single precision, at 640 px.
    assert ours.ravel() == pytest.approx(rs.rs2_project_point_to_pixel(lens, point), abs=1e-3)
    lens.model = rs.distortion.inverse_brown_conrady
    camera, source = realsense.factory_intrinsics(rs, lens)
    assert camera is None
    assert "not used: f 600, inverse_brown_conrady" in source
    lens.coeffs = [0.0] * 5
    assert not realsense.factory_intrinsics(rs, lens)[0].distortion.any()
