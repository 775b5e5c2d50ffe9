"""Cameras that need no client library: folders of images, what OpenCV opens, network cameras."""

import os
import queue
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.mjpeg import NetworkCamera, number_of, served

from visioncal.core.errors import DriverError
from visioncal.live.drivers import extras
from visioncal.live.drivers.oak import OakCamera
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.live.drivers.uvc import UvcCamera

RNG = np.random.default_rng(7)
# Longer than anything takes that comes at all [s].
PATIENT_S = 20.0


def test_a_missing_extra_tells_the_command_that_installs_it(monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(extras, "import_module", missing)
    with pytest.raises(DriverError, match="depthai cannot be imported") as caught:
        OakCamera()
    assert "pip install 'depthai" in caught.value.next_step
    assert os.environ["DEPTHAI_TELEMETRY"] == "0"


def test_the_command_installs_what_the_extra_would():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    declared = project["project"]["optional-dependencies"]
    for extra in ("ur", "oak"):
        with pytest.raises(DriverError) as caught:
            extras.client_library("no_such_module", extra)
        assert [caught.value.next_step] == [
            f"Install it: pip install '{value}'" for value in declared[extra]
        ]


def test_a_video_file_is_refused_whose_pictures_have_no_time(tmp_path):
    path = str(tmp_path / "a.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (64, 48))
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    with pytest.raises(DriverError, match="video file") as error:
        UvcCamera(path)
    assert "visioncal convert" in error.value.next_step


def test_what_cannot_be_opened_tells_where_to_look(tmp_path, capfd):
    with pytest.raises(DriverError, match="cannot be opened") as error:
        UvcCamera(str(tmp_path / "none.avi"))
    assert "cable" in error.value.next_step
    # OpenCV's own words about it are no concern of the user's.
    capfd.readouterr()


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


def asked(camera, capture, *times_s, pause_s=0.0):
    """The number of the picture that a request gets, of those that come after it."""
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(camera.frame, timeout_s=PATIENT_S)
        while camera._request_s is None:
            time.sleep(1e-3)
        for at_s in times_s:
            time.sleep(pause_s)
            capture.coming.put(at_s)
        frame = waiting.result()
    return int(frame.image[0, 0, 0]), frame


def test_what_was_under_way_when_it_was_asked_for_is_passed_by(capture):
    camera = opened(capture)
    number, frame = asked(camera, capture, 0.0, 0.0, pause_s=0.05)
    assert number == 3
    assert abs(frame.stamp_s - time.monotonic()) < PATIENT_S
    # Only what is given is decoded.
    assert capture.taken == [1, 3]


def test_a_burst_after_a_stall_had_waited_and_is_passed_by(capture):
    camera = opened(capture)
    for _ in range(5):
        time.sleep(0.1)
        capture.coming.put(0.0)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(camera.frame, timeout_s=PATIENT_S)
        while camera._request_s is None:
            time.sleep(1e-3)
        # Ten at once, then one after an interval.
        for _ in range(10):
            capture.coming.put(0.0)
        time.sleep(0.3)
        capture.coming.put(0.0)
        assert int(waiting.result().image[0, 0, 0]) == 17


def test_a_kernels_time_is_taken_where_it_can_be_true(capture):
    camera = opened(capture, requested=DeviceSetup(exposure_us=20_000))
    soon_s = time.monotonic() + 0.1
    time.sleep(0.3)
    # Exposed before the request; then after it.
    fresh_s = time.monotonic() + 0.1
    number, frame = asked(camera, capture, soon_s, fresh_s, pause_s=0.2)
    assert number == 3
    assert frame.stamp_s == pytest.approx(fresh_s - 0.01)
    assert frame.exposure_s == 0.02


def test_a_camera_that_hangs_or_ends_is_told(capture):
    camera = opened(capture)
    for _ in range(2):
        with pytest.raises(DriverError, match=r"camera 0 stalls: no picture has come for 0\.\d s"):
            camera.frame(timeout_s=0.01)
    capture.coming.put(None)
    with pytest.raises(DriverError, match="unplugged"):
        camera.frame(timeout_s=PATIENT_S)
    camera.close()
    camera.close()
    assert not camera._thread.is_alive()


def test_pictures_that_all_come_late_are_told(capture):
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
        with pytest.raises(DriverError, match="no fresh pictures"):
            waiting.result()


def test_a_stream_that_nobody_serves_is_told_in_seconds(capfd):
    began = time.monotonic()
    with pytest.raises(DriverError, match=r"camera rtsp://127\.0\.0\.1:9/none cannot be") as caught:
        UvcCamera("rtsp://user:secret@127.0.0.1:9/none")
    assert "its network" in caught.value.next_step
    # Refused at once here; a lost host takes its 5 s, where OpenCV would wait for 30.
    assert time.monotonic() - began < 25.0
    capfd.readouterr()


SMALL = np.full((240, 320), 110, np.uint8)


# Five megapixels that take long to decode.
LARGE = cv2.resize(
    np.random.default_rng(5).integers(0, 255, (486, 648), dtype=np.uint8), (2592, 1944)
)


def frames_of(camera, count, *, timeout_s=10.0):
    return [camera.frame(timeout_s=timeout_s) for _ in range(count)]


def test_no_picture_is_from_before_it_was_asked_for():
    sent = NetworkCamera(lambda: LARGE, period_s=0.05)
    with served(sent) as url, closing(UvcCamera(url)) as camera:
        assert isinstance(camera, CameraDevice)
        assert camera.resolution == (2592, 1944)
        for pause in (0, 40, 0, 10):
            # Pictures that nobody asks for would fill every buffer on the way.
            sent.wait_for(len(sent.drawn_s) + pause)
            count, asked = len(sent.drawn_s), time.monotonic()
            frame = camera.frame(timeout_s=10.0)
            number = number_of(frame.image)
            assert number >= count
            assert asked <= frame.stamp_s <= time.monotonic()
            assert sent.drawn_s[number] <= frame.stamp_s


def test_pictures_that_are_cut_short_are_passed_by():
    sent = NetworkCamera(lambda: SMALL, cut=tuple(range(0, 1000, 2)))
    with served(sent) as url, closing(UvcCamera(url)) as camera:
        numbers = [number_of(frame.image) for frame in frames_of(camera, 5)]
    assert all(number % 2 for number in numbers)


def test_a_password_is_given_and_not_shown():
    sent = NetworkCamera(lambda: SMALL, password="someone:secret")
    with served(sent) as url:
        inside = url.replace("://", "://someone:secret@")
        with closing(UvcCamera(inside)) as camera:
            assert camera.name == f"camera {url}"
        for wrong in (url, url.replace("://", "://someone:wrong@")):
            with pytest.raises(DriverError, match="cannot be opened") as caught:
                UvcCamera(wrong)
            assert "://USER:PASSWORD@" in caught.value.next_step
            assert "wrong" not in str(caught.value)


def test_a_stalled_stream_is_told_and_its_thread_ends():
    sent = NetworkCamera(lambda: SMALL, stalls_at=3)
    with served(sent) as url, closing(UvcCamera(url)) as camera:
        sent.wait_for(2)
        with pytest.raises(DriverError, match=r"stalls: no picture has come for \d\.\d s"):
            frames_of(camera, 3, timeout_s=0.05)
        thread = camera._thread
        camera.close()
        assert not thread.is_alive()


def test_a_closed_stream_is_told():
    sent = NetworkCamera(lambda: SMALL, ends_at=3)
    with served(sent) as url, closing(UvcCamera(url)) as camera:
        with pytest.raises(DriverError, match="closed its stream") as caught:
            frames_of(camera, 3)
        assert "--resume" in caught.value.next_step


def test_a_camera_that_changes_its_resolution_is_told():
    sent = NetworkCamera(lambda: SMALL if len(sent.drawn_s) < 2 else LARGE)
    with (
        served(sent) as url,
        closing(UvcCamera(url)) as camera,
        pytest.raises(DriverError, match="now gives 2592x1944 pixels, not 320x240"),
    ):
        frames_of(camera, 3)


def test_what_a_url_cannot_do_is_refused():
    sent = NetworkCamera(lambda: SMALL)
    with served(sent) as url:
        with pytest.raises(DriverError, match="gives 320x240 pixels, not 640x480"):
            UvcCamera(url, DeviceSetup(resolution=(640, 480)))
        with pytest.raises(DriverError, match="cannot be set from here"):
            UvcCamera(url, DeviceSetup(exposure_us=5000))
    with pytest.raises(DriverError, match="cannot be opened"):
        UvcCamera(url)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("pictures of")]
