"""Cameras that need no client library: folders of images, and what OpenCV opens."""

import os
import threading
import time
import tomllib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from visioncal.core.errors import DataError, DriverError
from visioncal.live.drivers import extras
from visioncal.live.drivers.images import FolderCamera
from visioncal.live.drivers.newest import Arrival
from visioncal.live.drivers.oak import OakCamera
from visioncal.live.drivers.protocols import CameraDevice, DeviceSetup
from visioncal.live.drivers.uvc import GrabbedPictures, UvcCamera

RNG = np.random.default_rng(7)


def test_a_missing_extra_tells_the_command_that_installs_it(monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(extras, "import_module", missing)
    with pytest.raises(DriverError, match="depthai cannot be imported") as caught:
        OakCamera()
    assert "pip install 'depthai" in caught.value.next_step
    assert os.environ["DEPTHAI_TELEMETRY"] == "0"


def test_all_missing_extras_are_named_at_once():
    uses = {"ur": "no_such_rtde", "oak": "no_such_depthai"}
    with pytest.raises(DriverError, match="no_such_rtde and no_such_depthai are not") as caught:
        extras.refuse_without("ur", uses)
    assert "'ur-rtde" in caught.value.next_step
    assert "'depthai" in caught.value.next_step
    # What is only welcome may be missing.
    extras.refuse_without("ur", {**uses, "ur": "json"})


def test_the_command_installs_what_the_extra_would():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    declared = project["project"]["optional-dependencies"]
    for extra in ("ur", "oak"):
        with pytest.raises(DriverError) as caught:
            extras.client_library("no_such_module", extra)
        assert [caught.value.next_step] == [
            f"Install it: pip install '{value}'" for value in declared[extra]
        ]


def a_folder(path, names=("view1.png", "view2.png", "view10.png"), shape=(48, 64)):
    path.mkdir()
    images = {name: RNG.integers(0, 255, shape, dtype=np.uint8) for name in names}
    for name, image in images.items():
        cv2.imwrite(str(path / name), image)
    return images


def test_a_folder_gives_its_images_in_the_order_of_their_numbers(tmp_path):
    images = a_folder(tmp_path / "bilder ü")
    camera = FolderCamera(tmp_path / "bilder ü")
    assert isinstance(camera, CameraDevice)
    assert camera.resolution == (64, 48)
    for name in ("view1.png", "view2.png", "view10.png"):
        before = time.monotonic()
        frame = camera.frame()
        assert np.array_equal(frame.image, images[name])
        assert before <= frame.stamp_s <= time.monotonic()
    with pytest.raises(DriverError, match="all 3 were given"):
        camera.frame()


def test_a_folder_without_images_or_with_a_bad_one_is_refused_by_name(tmp_path):
    with pytest.raises(DataError, match="no folder"):
        FolderCamera(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no images"):
        FolderCamera(tmp_path / "empty")
    a_folder(tmp_path / "mixed")
    cv2.imwrite(str(tmp_path / "mixed" / "view2.png"), np.zeros((10, 20), np.uint8))
    (tmp_path / "mixed" / "view10.png").write_bytes(b"")
    camera = FolderCamera(tmp_path / "mixed")
    camera.frame()
    with pytest.raises(DataError, match=r"view2\.png has 20x10"):
        camera.frame()


def a_video(path, count=5):
    # FFV1 is lossless; random pictures tell a wrong order from a right one.
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (64, 48))
    assert writer.isOpened()
    images = [RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(count)]
    for image in images:
        writer.write(image)
    writer.release()
    return images


def test_a_video_file_gives_its_pictures_and_then_says_that_it_is_at_its_end(tmp_path):
    images = a_video(tmp_path / "a.avi")
    camera = UvcCamera(str(tmp_path / "a.avi"))
    assert isinstance(camera, CameraDevice)
    assert camera.resolution == (64, 48)
    assert camera.settings["rate_hz"] == 10.0
    # FFV1 stores colours as luma and chroma, so they come back within some levels.
    for image in images:
        taken = camera.frame().image.astype(float)
        assert np.abs(taken.mean(axis=(0, 1)) - image.mean(axis=(0, 1))).max() < 3.0
    with pytest.raises(DriverError, match="at its end"):
        camera.frame()
    camera.close()
    camera.close()


def test_another_resolution_than_wished_is_refused(tmp_path):
    a_video(tmp_path / "a.avi")
    with pytest.raises(DriverError, match="gives 64x48 pixels, not 640x480"):
        UvcCamera(str(tmp_path / "a.avi"), DeviceSetup(resolution=(640, 480)))


def test_what_cannot_be_opened_tells_where_to_look(tmp_path, capfd):
    with pytest.raises(DriverError, match="cannot be opened") as error:
        UvcCamera(str(tmp_path / "none.avi"))
    assert "cable" in error.value.next_step
    # OpenCV's own words about it are no concern of the user's.
    capfd.readouterr()


class Queued:
    """A capture as V4L2's or a stream's: when pictures come, and what it tells of that [s]."""

    def __init__(self, *pictures):
        self.pictures, self.told_s = list(pictures), 0.0

    def grab(self):
        """Takes the next picture."""
        if not self.pictures:
            return False
        self.now_s, self.told_s = self.pictures.pop(0)
        return True

    def get(self, what):
        """Tells when it came, where the driver does."""
        return 1e3 * self.told_s if what == cv2.CAP_PROP_POS_MSEC else 0.0

    def retrieve(self):
        """Gives nothing."""
        return False, None


def arrivals_of(monkeypatch, *pictures, **words):
    """What becomes of pictures that come, and are stamped, at given times."""
    capture = Queued(*pictures)
    clock = SimpleNamespace(monotonic=lambda: capture.now_s)
    monkeypatch.setattr("visioncal.live.drivers.uvc.time", clock)
    source = GrabbedPictures(capture, "camera", **words)
    return [source.grab() for _ in pictures], source


def test_a_kernels_time_is_taken_where_it_can_be_true(monkeypatch):
    told, source = arrivals_of(
        monkeypatch, (100.0, 99.0), (101.0, 0.0), (102.0, 1.7e9), exposure_s=0.02, is_stream=False
    )
    assert told == [Arrival(99.0, 98.98), Arrival(101.0), Arrival(102.0)]
    with pytest.raises(DriverError, match="gives no picture"):
        source.take()
    with pytest.raises(DriverError, match="unplugged"):
        source.grab()


def test_a_stream_whose_decoding_lags_is_stamped_as_if_it_did_not(monkeypatch):
    # Its clock says 0.1 s a picture; decoding takes 0.3 s each. It then begins anew.
    pictures = [(100.0, 5.0), (100.3, 5.1), (100.6, 5.2), (100.65, 5.9), (101.0, 2.0)]
    found, _ = arrivals_of(monkeypatch, *pictures, is_stream=True)
    # By 0.1 ms a second their clocks may run apart, which counts as a delay.
    assert [value.stamp_s for value in found] == pytest.approx(
        [100.0, 100.1, 100.2, 100.65, 101.0], abs=1e-4
    )
    assert [item.began_s for item in found[1:]] == [item.stamp_s for item in found[:-1]]


class Hanging(Queued):
    """A capture that gives one picture; then its camera is lost, and whoever waits hangs."""

    def __init__(self):
        super().__init__((0.0, 0.0))
        self.freed = threading.Event()
        self.isOpened, self.set = (lambda *_: True,) * 2

    def grab(self):
        """Gives the first, then hangs."""
        return super().grab() or not self.freed.wait()

    def retrieve(self):
        """Gives it."""
        return True, np.zeros((48, 64, 3), np.uint8)

    def release(self):
        """Frees nobody."""


def test_a_camera_that_hangs_is_told_in_time(monkeypatch):
    capture = Hanging()
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: capture)
    camera = UvcCamera(0)
    for _ in range(2):
        with pytest.raises(DriverError, match=r"camera 0 stalls: no picture has come for 0\.\d s"):
            camera.frame(timeout_s=0.01)
    capture.freed.set()
    with pytest.raises(DriverError, match="unplugged"):
        camera.frame(timeout_s=10.0)
    camera.close()


def test_a_stream_that_nobody_serves_is_told_in_seconds(capfd):
    began = time.monotonic()
    with pytest.raises(DriverError, match=r"camera rtsp://127\.0\.0\.1:9/none cannot be") as caught:
        UvcCamera("rtsp://user:secret@127.0.0.1:9/none")
    assert "its network" in caught.value.next_step
    # Refused at once here; a lost host takes its 5 s, where OpenCV would wait for 30.
    assert time.monotonic() - began < 25.0
    capfd.readouterr()
