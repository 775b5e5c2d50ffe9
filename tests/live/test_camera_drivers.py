"""Cameras: folders, what OpenCV opens, network cameras, and those of other libraries."""

import io
import os
import queue
import sys
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.live_cell import fake_devices, fake_plan
from support.mjpeg import NetworkCamera, number_of, served
from support.refusals import raised

from visioncal.core.errors import DriverError
from visioncal.core.extras import client_library
from visioncal.live.capture.devices import open_camera
from visioncal.live.drivers import folder, realsense, stream
from visioncal.live.drivers.features import bgr_or_grey
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.live.drivers.uvc import UvcCamera
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


@pytest.mark.parametrize("typed", [[], ["1 2 3"], ["0.1 0.2 0.3 0 0 0.1"]])
def test_malformed_poses_leave_no_folder_in_the_way_of_the_next_ones(seen, tmp_path, typed):
    lines, pictures = seen
    shown, live = tmp_path / "pictures", tmp_path / "live"
    shown.mkdir()
    for at, picture in enumerate(pictures):
        cv2.imwrite(str(shown / f"{at}.png"), picture)
    camera = f"folder:{shown}"
    record(typed, camera, live).refused("there is no session yet", "Then record again")
    assert not live.exists()
    record(lines, camera, live).good()
    assert np.array_equal(recorded(live), pictures)


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
    raised(DriverError, "is a file, but", open_camera, f"folder:{__file__}", DeviceSetup())
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


def a_realsense(rs, pictures, depth, size, translation):
    """A RealSense in software: colour and depth sensors, and what sends a pair of pictures."""
    device = rs.software_device()
    device.register_info(rs.camera_info.serial_number, "123")
    device.register_info(rs.camera_info.name, "RealSense D435")
    profiles = []
    for name, kind, form, shape in (
        ("RGB Camera", rs.stream.color, rs.format.bgr8, pictures[0].shape),
        ("Stereo Module", rs.stream.depth, rs.format.z16, size[::-1]),
    ):
        video, lens = rs.video_stream(), rs.intrinsics()
        lens.height, lens.width = video.height, video.width = shape[:2]
        # Both see the same angle.
        lens.fx = lens.fy = 0.9 * lens.width
        lens.ppx, lens.ppy, lens.coeffs = (lens.width - 1) / 2, (lens.height - 1) / 2, [0.0] * 5
        lens.model = rs.distortion.brown_conrady
        video.type, video.fmt, video.intrinsics, video.fps = kind, form, lens, 30
        video.bpp = video.uid = len(shape)
        sensor = device.add_sensor(name)
        profiles.append((sensor, sensor.add_video_stream(video).as_video_stream_profile()))
    profiles[1][0].add_read_only_option(rs.option.depth_units, 1e-4)
    between = rs.extrinsics()
    between.rotation, between.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], translation
    profiles[1][1].register_extrinsics_to(profiles[0][1], between)
    device.create_matcher(rs.matchers.default)

    def send(number, at):
        for (sensor, profile), pixels in zip(profiles, (pictures[at], depth[at]), strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp = np.ascontiguousarray(pixels), pixels.ndim
            frame.stride = frame.bpp * pixels.shape[1]
            frame.timestamp, frame.domain = 1e3 * time.time(), rs.timestamp_domain.system_time
            frame.frame_number, frame.profile = number, profile
            if pixels.ndim == 2:
                frame.depth_units = 1e-4
            sensor.on_video_frame(frame)

    return device, send


@contextmanager
def sent_by(monkeypatch, rs, device, send, at):
    """While pairs of pictures number `at()` come."""
    monkeypatch.setattr(rs, "context", lambda: SimpleNamespace(query_devices=lambda: [device]))
    ended = threading.Event()

    def run():
        number = 0
        while not ended.wait(0.02):
            send(number := number + 1, at())

    with ThreadPoolExecutor(1) as pool:
        sending = pool.submit(run)
        try:
            yield
        finally:
            ended.set()
            sending.result()


def test_a_realsense_is_recorded_with_its_depth_bit_for_bit(seen, tmp_path, monkeypatch):
    rs = pytest.importorskip("pyrealsense2")
    lines, pictures = seen
    colour = [np.dstack([picture] * 3) for picture in pictures]
    rng, (height, width) = np.random.default_rng(0), pictures[0].shape
    depth = [rng.integers(0, 65536, (height, width)).astype(np.uint16) for _ in pictures]
    # Depth that comes aligned, as from a D405.
    device, send = a_realsense(rs, colour, depth, (width, height), [0.0, 0.0, 0.0])
    typed = []

    def typing(_):
        typed.append(lines[len(typed)])
        return typed[-1]

    shown = SimpleNamespace(readline=typing, isatty=lambda: False, reconfigure=lambda **_: None)
    out = tmp_path / "live"
    with sent_by(monkeypatch, rs, device, send, lambda: max(len(typed) - 1, 0)):
        monkeypatch.setattr(sys, "stdin", shown)
        visioncal(
            *("record", *TYPED, "--camera", "realsense", "-o", out, "--views", len(lines))
        ).good()
    session = Session.load(out)
    assert session.declaration.camera.depth_unit_m == 1e-4
    assert len(session.views) == len(lines)
    for view, picture, distances in zip(session.views, colour, depth, strict=True):
        assert view.depth == view.image.replace("images", "depth")
        assert np.array_equal(cv2.imread(str(out / view.image), -1), picture)
        assert np.array_equal(cv2.imread(str(out / view.depth), -1), distances)


def test_depth_of_a_realsense_from_elsewhere_is_aligned(monkeypatch):
    rs = pytest.importorskip("pyrealsense2")
    picture, depth = np.zeros((120, 160, 3), np.uint8), np.full((60, 80), 8000, np.uint16)
    depth[20:40, 30:50] = 5000
    device, send = a_realsense(rs, [picture], [depth], (80, 60), [0.05, 0.0, 0.0])
    with (
        sent_by(monkeypatch, rs, device, send, lambda: 0),
        closing(open_camera("realsense", DeviceSetup())) as camera,
    ):
        found = camera.frame(timeout_s=PATIENT_S).depth
    assert camera.settings["depth_unit_m"] == 1e-4
    assert found.shape == (120, 160)
    # The middle of the near square by the colour's lens: 0.5 m away, 50 mm to the side.
    ray = np.array([0.05 / 0.5, 0.0])
    rows, columns = np.nonzero(found == 5000)
    # Pixels of half the size are rounded to whole ones.
    assert [columns.mean(), rows.mean()] == pytest.approx(ray * 144 + [79.5, 59.5], abs=1.0)


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


def test_the_command_installs_what_the_extra_would():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    declared = project["project"]["optional-dependencies"]
    for extra in declared.keys() - {"dev"}:
        with pytest.raises(DriverError) as caught:
            client_library("no_such_module", extra)
        # What has no wheels for every Python has a marker that says so.
        (package, _, newest) = declared[extra][0].partition("; python_version < ")
        assert len(declared[extra]) == 1
        assert package in caught.value.next_step
        if not newest or f"{sys.version_info[0]}.{sys.version_info[1]}" < newest.strip("'"):
            assert caught.value.next_step == f"Install it: pip install '{package}'"


class Scripted:
    """A capture whose pictures come when a test says so; a picture is its number."""

    def __init__(self):
        self.coming, self.taken, self.count = queue.Queue(), [], 0
        self.is_released = threading.Event()
        self.isOpened, self.set = (lambda *_: True,) * 2

    def grab(self):
        """Waits for the next picture, or the end."""
        self.at_s = self.coming.get()
        self.count += 1
        return self.at_s is not None

    def get(self, what):
        """Tells the time of the driver, where the test gives it one."""
        return 1e3 * self.at_s if what == cv2.CAP_PROP_POS_MSEC and self.count else 0.0

    def retrieve(self):
        """Decodes."""
        self.taken.append(self.count)
        return True, np.full((48, 64, 3), self.count, np.uint8)

    def release(self):
        """Is told to the test."""
        self.is_released.set()


@pytest.fixture
def capture(monkeypatch):
    made = Scripted()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: made)
    yield made
    made.coming.put(None)
    assert made.is_released.wait(PATIENT_S)


def opened(capture, source=0, requested=None):
    """A camera whose first picture has come."""
    capture.coming.put(0.0)
    return UvcCamera(source, requested)


def picture_of_request(camera, capture, *times_s, pause_s=0.0, last_s=0.0):
    """The number of the picture that a request gets, of those that come after it."""
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(camera.frame, timeout_s=PATIENT_S)
        while camera._request_s is None:
            time.sleep(1e-3)
        for at_s in times_s:
            time.sleep(pause_s)
            capture.coming.put(at_s)
        if last_s:
            time.sleep(last_s)
            capture.coming.put(0.0)
        frame = waiting.result()
    return int(frame.image[0, 0, 0]), frame


def test_a_frame_that_was_under_way_at_the_request_is_skipped(capture):
    camera = opened(capture)
    number, frame = picture_of_request(camera, capture, 0.0, 0.0, pause_s=0.05)
    assert number == 3
    assert abs(frame.stamp_s - time.monotonic()) < PATIENT_S
    # Only what is given is decoded.
    assert capture.taken == [1, 3]


def test_a_burst_after_a_stall_had_waited_and_is_passed_by(capture):
    camera = opened(capture)
    for _ in range(5):
        time.sleep(0.1)
        capture.coming.put(0.0)
    # Ten at once, then one after an interval.
    assert picture_of_request(camera, capture, *[0.0] * 10, last_s=0.3)[0] == 17


def test_a_kernels_time_is_taken_where_it_can_be_true(capture):
    camera = opened(capture, requested=DeviceSetup(exposure_us=20_000))
    soon_s = time.monotonic() + 0.1
    time.sleep(0.3)
    # Exposed before the request; then after it.
    fresh_s = time.monotonic() + 0.1
    number, frame = picture_of_request(camera, capture, soon_s, fresh_s, pause_s=0.2)
    assert number == 3
    # Rounding of a time in ms is far less; a share of the time since the start would be far more.
    assert frame.stamp_s == pytest.approx(fresh_s - 0.01, abs=1e-4)
    assert frame.exposure_s == 0.02


def test_a_camera_that_hangs_or_ends_is_reported(capture):
    camera = opened(capture)
    for _ in range(2):
        with pytest.raises(DriverError, match=r"camera 0 stalls: no picture has come for 0\.\d s"):
            camera.frame(timeout_s=0.01)
    capture.coming.put(None)
    raised(DriverError, "unplugged", camera.frame, timeout_s=PATIENT_S)
    camera.close()
    camera.close()
    assert not camera._thread.is_alive()


def test_pictures_that_all_come_late_are_reported(capture):
    camera = opened(capture)
    old_s = time.monotonic()
    time.sleep(0.01)
    for _ in range(10):
        capture.coming.put(old_s)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(camera.frame, timeout_s=0.5)
        while camera._request_s is None:
            time.sleep(1e-3)
        for _ in range(5):
            capture.coming.put(old_s)
        raised(DriverError, "no fresh pictures", waiting.result)


SMALL = np.full((240, 320), 110, np.uint8)


def test_pictures_that_are_cut_short_are_passed_by():
    sent = NetworkCamera(lambda: SMALL, cut=tuple(range(0, 1000, 2)))
    with served(sent) as url, closing(UvcCamera(url)) as camera:
        assert isinstance(camera, CameraDevice)
        assert camera.resolution == (320, 240)
        numbers = [number_of(camera.frame(timeout_s=10.0).image) for _ in range(5)]
    assert all(number % 2 for number in numbers)


def test_a_password_is_given_and_not_shown():
    sent = NetworkCamera(lambda: SMALL, password="someone:secret")
    with served(sent) as url:
        inside = url.replace("://", "://someone:secret@")
        with closing(UvcCamera(inside)) as camera:
            assert camera.name == f"camera {url}"
        for wrong in (url, url.replace("://", "://someone:wrong@")):
            caught = raised(DriverError, "cannot be opened", UvcCamera, wrong)
            assert "://USER:PASSWORD@" in caught.next_step
            assert "wrong" not in str(caught)
