"""A network camera: that its pictures are fresh, what it may send, and how it may end."""

import threading
import time
from contextlib import closing

import cv2
import numpy as np
import pytest
from support.mjpeg import NetworkCamera, number_of, served

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.live.drivers.uvc import UvcCamera

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
