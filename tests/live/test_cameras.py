"""Cameras that need no client library: folders of images, what OpenCV opens, network cameras."""

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
from support.refusals import raised

from visioncal.core.errors import DriverError
from visioncal.core.extras import client_library
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.live.drivers.uvc import UvcCamera

# Longer than anything takes that comes at all [s].
PATIENT_S = 20.0


def test_the_command_installs_what_the_extra_would():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    declared = project["project"]["optional-dependencies"]
    for extra in declared.keys() - {"dev"}:
        with pytest.raises(DriverError) as caught:
            client_library("no_such_module", extra)
        assert [caught.value.next_step] == [
            f"Install it: pip install '{value}'" for value in declared[extra]
        ]


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


def asked(camera, capture, *times_s, pause_s=0.0, last_s=0.0):
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
    # Ten at once, then one after an interval.
    assert asked(camera, capture, *[0.0] * 10, last_s=0.3)[0] == 17


def test_a_kernels_time_is_taken_where_it_can_be_true(capture):
    camera = opened(capture, requested=DeviceSetup(exposure_us=20_000))
    soon_s = time.monotonic() + 0.1
    time.sleep(0.3)
    # Exposed before the request; then after it.
    fresh_s = time.monotonic() + 0.1
    number, frame = asked(camera, capture, soon_s, fresh_s, pause_s=0.2)
    assert number == 3
    # Rounding of a time in ms is far less; a share of the time since the start would be far more.
    assert frame.stamp_s == pytest.approx(fresh_s - 0.01, abs=1e-4)
    assert frame.exposure_s == 0.02


def test_a_camera_that_hangs_or_ends_is_told(capture):
    camera = opened(capture)
    for _ in range(2):
        with pytest.raises(DriverError, match=r"camera 0 stalls: no picture has come for 0\.\d s"):
            camera.frame(timeout_s=0.01)
    capture.coming.put(None)
    raised(DriverError, "unplugged", camera.frame, timeout_s=PATIENT_S)
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
