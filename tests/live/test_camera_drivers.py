"""Cameras of other libraries, by the emulators that these bring, and folders of pictures."""

import io
import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.live_cell import fake_devices, fake_plan
from support.refusals import raised

from visioncal.core.errors import DriverError
from visioncal.live.capture.devices import open_camera
from visioncal.live.drivers import folder, realsense, stream
from visioncal.live.drivers.features import bgr_or_grey
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.session import Session

# SWIG's modules warn of themselves as they are imported.
pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
# Longer than anything takes that comes at all [s].
PATIENT_S = 20.0
TYPED = ("--arm", "manual", "--target", "charuco_9x6_30mm", "--frames", 2, "--settle-s", 0.03)


@pytest.fixture(scope="module")
def seen():
    """Poses as a UR's pendant shows them, a line each, and what a camera sees."""
    plan = fake_plan(3)
    arm, camera = fake_devices(plan)
    pictures = []
    for stop in plan.stops:
        arm.q0 = stop.q
        pictures.append(camera.frame().image)
    return [f"p[0.{place}, 0, 0.5, 0, 0, 0]\n" for place in (1, 2, 3)], pictures


def record(lines, camera, out, *more):
    with patch.object(sys, "stdin", io.StringIO("".join(lines))):
        return visioncal("record", *TYPED, "--camera", camera, "-o", out, *more)


def recorded(out):
    return [cv2.imread(str(out / view.image), -1) for view in Session.load(out).views]


def test_a_folder_that_still_grows_gives_each_picture_to_its_pose(seen, tmp_path, monkeypatch):
    lines, pictures = seen
    inbox, camera = tmp_path / "bilder ü", f"folder:{tmp_path / 'bilder ü'}"
    inbox.mkdir()
    files = [cv2.imencode(".png", picture)[1].tobytes() for picture in pictures]
    (inbox / "shot8.png").write_bytes(files[0])
    (inbox / "shot9.png").write_bytes(files[1][:20_000])

    def goes_on():
        # The third comes before the second in the alphabet.
        for name, content in (("shot9.png", files[1]), ("shot10.png", files[2])):
            time.sleep(0.5)
            (inbox / name).write_bytes(content)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(goes_on)
        record(lines, camera, tmp_path / "live", "--views", 3).good()
    assert np.array_equal(recorded(tmp_path / "live"), pictures)
    views = Session.load(tmp_path / "live").views
    assert [view.numbers["x_m"] for view in views] == [0.1, 0.2, 0.3]
    record(lines, camera, tmp_path / "live", "--resume").refused("by their order alone")
    monkeypatch.setattr(folder, "_PATIENCE_S", 0.3)
    record([*lines, lines[0]], camera, tmp_path / "more").refused(
        "has no further picture (3 were given)", "3 views are safe", "into a new session"
    )
    # All of them were there.
    assert np.array_equal(recorded(tmp_path / "more"), pictures)
    (inbox / "shot9.png").write_bytes(files[1][:20_000])
    record(lines, camera, tmp_path / "cut").refused("shot9.png: unreadable")
    small = open_camera(camera, DeviceSetup((320, 200)))
    assert isinstance(small, CameraDevice)
    raised(DriverError, "has 640x400 pixels, not 320x200", small.frame)
    raised(DriverError, "does not exist", open_camera, "folder:none", DeviceSetup())
    raised(DriverError, "cannot be set", open_camera, camera, DeviceSetup(gain=2))


@pytest.mark.parametrize("kind", ["oak", "genicam", "basler", "realsense"])
def test_a_missing_library_is_named_with_the_command(kind, monkeypatch):
    for module in ("depthai", "harvesters.core", "pypylon.pylon", "pyrealsense2"):
        monkeypatch.setitem(sys.modules, module, None)
    error = raised(DriverError, "cannot be imported", open_camera, kind, DeviceSetup())
    assert error.next_step.startswith("Install it: pip install '")


@pytest.mark.parametrize("rows", ["RG GB", "GR BG", "GB RG", "BG GR"])
def test_a_bayer_pattern_has_the_colours_of_its_name(rows):
    bgr = {"R": 200, "G": 100, "B": 30}
    block = np.array([[bgr[letter] for letter in row] for row in rows.split()], np.uint8)
    image = bgr_or_grey(np.tile(block, (8, 8)), f"Bayer{rows[:2]}8")
    assert (image[2:-2, 2:-2] == [30, 100, 200]).all()


def test_a_gentl_producer_is_found_and_its_camera_chosen(monkeypatch):
    genicam = pytest.importorskip("genicam")
    pytest.importorskip("harvesters")
    producer = Path(genicam.__file__).parent / "viky.cti"
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    for address, requested, words in (
        ("1", DeviceSetup(), "GENICAM_GENTL64_PATH names no"),
        ("/no.cti:1", DeviceSetup(), "no file /no.cti"),
        (f"{producer}", DeviceSetup(), f"several; .*--camera genicam:{producer}:VikyTL_DEV_red"),
        (f"{producer}:7", DeviceSetup(), "connected: VikyTL_DEV_red 0"),
        (f"{producer}:0", DeviceSetup((900, 300)), "900: Width: .*Max = 800"),
        (f"{producer}:0", DeviceSetup(focus=3), "focus 3: FocusPosition: it has no such feature"),
    ):
        raised(DriverError, words, open_camera, f"genicam:{address}", requested)
    monkeypatch.setenv("GENICAM_GENTL64_PATH", os.pathsep.join(["/none", str(producer.parent)]))
    for name in ("VikyTL_DEV_red", "1"):
        with closing(open_camera(f"genicam:{name}", DeviceSetup((300, 200)))) as camera:
            asked_s = time.monotonic()
            frame = camera.frame(timeout_s=PATIENT_S)
            # A second opening finds the producer in use.
            raised(DriverError, "connected: none", open_camera, f"genicam:{name}", DeviceSetup())
        assert asked_s <= frame.stamp_s <= time.monotonic()
        assert (frame.image.shape, np.ptp(frame.image) > 100) == ((200, 300), True)


@pytest.fixture
def pylon(monkeypatch):
    """Basler's emulator, which sends a file's picture, and is set as it is found: automatic."""
    library = pytest.importorskip("pypylon.pylon")
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    emulated = SimpleNamespace(found={"ExposureAuto": "Continuous"}, is_removed=False, device=None)
    open_it, gone = library.InstantCamera.Open, "IsCameraDeviceRemoved"

    def opened(device):
        open_it(device)
        emulated.device = device
        for name, value in emulated.found.items():
            getattr(device, name).Value = value

    monkeypatch.setattr(library.InstantCamera, "Open", opened)
    monkeypatch.setattr(library.InstantCamera, gone, lambda _: emulated.is_removed)
    monkeypatch.setattr(stream, "SETTLE_S", 0.1)
    return emulated


def test_a_baslers_pictures_are_recorded_bit_for_bit(pylon, seen, tmp_path):
    lines, pictures = seen
    pylon.found |= {"TestImageSelector": "Off", "ImageFileMode": "On"}
    for number, (line, picture) in enumerate(zip(lines, pictures, strict=True), 1):
        pylon.found["ImageFilename"] = str(tmp_path / f"{number}.png")
        cv2.imwrite(pylon.found["ImageFilename"], picture)
        more = ["--resolution", "640,400", "--views", number, *(["--resume"] if number > 1 else [])]
        record([line], "basler", tmp_path / "live", *more).good()
    assert np.array_equal(recorded(tmp_path / "live"), pictures)
    assert pylon.device.IsOpen() is False


def test_a_basler_that_is_missing_refuses_or_is_unplugged_is_reported(pylon):
    raised(DriverError, "connected: 0815-0000", open_camera, "basler:7", DeviceSetup())
    too_long = DeviceSetup(exposure_us=10**9)
    raised(DriverError, "must be smaller than or equal", open_camera, "basler", too_long)
    pylon.found["PixelFormat"] = "Mono12"
    with closing(open_camera("basler:0815-0000", DeviceSetup((64, 48), gain=3))) as camera:
        # What was automatic is held, and what has more bits is sent with eight.
        assert pylon.device.ExposureAuto.Value == "Off"
        assert camera.settings["pixel_format"] == "Mono8"
        assert camera.settings["gain"] == pytest.approx(3.0, abs=1e-3)
        # As where packets are lost: the next whole one is taken.
        pylon.device.ForceFailedBufferCount.Value = 50
        pylon.device.ForceFailedBuffer.Execute()
        frame = camera.frame(timeout_s=PATIENT_S)
        assert frame.exposure_s == pytest.approx(1e-6 * camera.settings["exposure_us"])
        pylon.is_removed = True
        camera._thread.join(PATIENT_S)
        raised(DriverError, "it is unplugged", camera.frame)
    assert pylon.device.IsOpen() is False


@pytest.fixture
def end(monkeypatch):
    """Ends the pictures of a RealSense in software."""
    rs, ended = pytest.importorskip("pyrealsense2"), threading.Event()
    device, video = rs.software_device(), rs.video_stream()
    device.register_info(rs.camera_info.serial_number, "123")
    device.register_info(rs.camera_info.name, "RealSense D435")
    sensor = device.add_sensor("RGB Camera")
    video.type, video.fmt, video.bpp, video.fps = rs.stream.color, rs.format.bgr8, 3, 30
    video.width, video.height, video.intrinsics = 64, 48, lens_of(rs)
    profile = sensor.add_video_stream(video).as_video_stream_profile()
    monkeypatch.setattr(rs, "context", lambda: SimpleNamespace(query_devices=lambda: [device]))

    def send():
        while not ended.wait(0.02):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp, frame.stride = np.full((48, 64, 3), 7, np.uint8), 3, 192
            frame.timestamp, frame.domain = 1e3 * time.time(), rs.timestamp_domain.global_time
            frame.profile = profile
            # The middle of the exposure is 4 ms before readout, on the device's own clock [us].
            sensor.set_metadata(rs.frame_metadata_value.frame_timestamp, 1_000_000)
            sensor.set_metadata(rs.frame_metadata_value.sensor_timestamp, 1_000_000 - 4000)
            sensor.on_video_frame(frame)

    with ThreadPoolExecutor(1) as pool:
        sending = pool.submit(send)
        yield ended.set
        ended.set()
        sending.result()


def lens_of(rs):
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 64, 48, 60, 61, 31, 23.5
    lens.coeffs, lens.model = [-0.2, 0.1, 1e-3, -2e-3, 0.05], rs.distortion.brown_conrady
    return lens


def test_a_realsense_gives_colour_its_time_and_its_factory_lens(end):
    small = DeviceSetup((32, 24))
    raised(DriverError, r"it has \[\(64, 48\)\]", open_camera, "realsense", small)
    raised(DriverError, "cannot be set", open_camera, "realsense", DeviceSetup(None, 100))
    raised(DriverError, "connected: 123", open_camera, "realsense:7", DeviceSetup())
    with closing(open_camera("realsense:123", DeviceSetup())) as camera:
        raised(DriverError, "cannot be opened", open_camera, "realsense", DeviceSetup())
        asked_s = time.monotonic()
        frame = camera.frame(timeout_s=PATIENT_S)
        # The exposure began after the request, but for the clocks' rounding, and ended before.
        assert asked_s + 4e-3 - 1e-3 <= frame.stamp_s <= time.monotonic() - 3e-3
        assert (frame.image == 7).all()
        assert camera.factory.matrix == pytest.approx([60.0, 61.0, 31.0, 23.5])
        end()
        time.sleep(0.05)
        raised(DriverError, "stalls", camera.frame, timeout_s=0.2)


def test_a_lens_of_uncertain_direction_is_not_passed_off_as_opencvs():
    rs = pytest.importorskip("pyrealsense2")
    lens, point = lens_of(rs), [0.21, -0.13, 0.6]
    camera, _ = realsense.factory_intrinsics(rs, lens)
    matrix = np.array([[60, 0, 31], [0, 61, 23.5], [0, 0, 1.0]])
    ours = cv2.projectPoints(np.array([point]), *np.zeros((2, 3)), matrix, camera.distortion)[0]
    # Single precision.
    assert ours.ravel() == pytest.approx(rs.rs2_project_point_to_pixel(lens, point), abs=1e-4)
    lens.model = rs.distortion.inverse_brown_conrady
    camera, source = realsense.factory_intrinsics(rs, lens)
    assert camera is None
    assert "not used: f 60, inverse_brown_conrady" in source
    lens.coeffs = [0.0] * 5
    assert not realsense.factory_intrinsics(rs, lens)[0].distortion.any()
