"""Cameras that need no client library: folders of images, and what OpenCV opens."""

import os
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from visioncal.drivers import extras
from visioncal.drivers.images import FolderCamera
from visioncal.drivers.oak import OakCamera
from visioncal.drivers.oak_hosted import HostedOak
from visioncal.drivers.protocols import CameraDevice, DeviceWishes
from visioncal.drivers.uvc import UvcCamera
from visioncal.errors import DataError, DriverError

RNG = np.random.default_rng(7)


def test_a_missing_extra_tells_the_command_that_installs_it(monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(extras, "import_module", missing)
    for open_it in (OakCamera, lambda: HostedOak(lambda: None, (64, 48))):
        with pytest.raises(DriverError, match="depthai cannot be imported") as caught:
            open_it()
        assert "pip install 'depthai" in caught.value.next_step
    assert os.environ["DEPTHAI_TELEMETRY"] == "0"


def test_the_command_installs_what_the_extra_would():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    declared = project["project"]["optional-dependencies"]
    for extra in ("ur", "oak"):
        with pytest.raises(DriverError) as caught:
            extras.client_library("no_such_module", extra)
        assert [caught.value.next_step] == [
            f"Install it: pip install '{it}'" for it in declared[extra]
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
        UvcCamera(str(tmp_path / "a.avi"), DeviceWishes(resolution=(640, 480)))


def test_what_cannot_be_opened_tells_where_to_look(tmp_path, capfd):
    with pytest.raises(DriverError, match="cannot be opened") as error:
        UvcCamera(str(tmp_path / "none.avi"))
    assert "cable" in error.value.next_step
    # OpenCV's own words about it are no concern of the user's.
    capfd.readouterr()


class Queued:
    """A capture as V4L2's: two old pictures at once, then one every 0.2 s."""

    def __init__(self, is_stamped):
        self.is_stamped, self.number, self.began = is_stamped, -1, time.monotonic()
        self.stamp = 0.0

    def grab(self):
        """Takes the next picture."""
        self.number += 1
        if self.number < 2:
            self.stamp = self.began - 0.03 * (2 - self.number)
        else:
            time.sleep(0.2)
            self.stamp = time.monotonic()
        return True

    def retrieve(self):
        """Gives it."""
        return True, np.full((48, 64), max(self.number, 0), np.uint8)

    def get(self, what):
        """Tells when it came, where the driver does."""
        return 1e3 * self.stamp if what == cv2.CAP_PROP_POS_MSEC and self.is_stamped else 0.0


class Hanging(Queued):
    """A capture whose camera is lost."""

    def grab(self):
        """Hangs for longer than anybody waits."""
        time.sleep(1.0)
        return False


def a_camera_with(capture, monkeypatch):
    """A camera on a capture as OpenCV would open it, with one picture that tells its resolution."""
    capture.isOpened, capture.set, capture.release = (lambda *_: True,) * 3
    grab, capture.grab = capture.grab, lambda: True
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: capture)
    camera = UvcCamera(0)
    capture.grab = grab
    return camera


@pytest.mark.parametrize(("is_stamped", "wanted"), [(True, 2), (False, 3)])
def test_pictures_that_were_queued_are_passed_by(is_stamped, wanted, monkeypatch):
    # A busy machine may well halt this process for some milliseconds; those are no waiting.
    monkeypatch.setattr("visioncal.drivers.uvc._WAITED_S", 0.1)
    camera = a_camera_with(Queued(is_stamped), monkeypatch)
    # Without times of its own the first picture that was waited for may have begun before.
    assert camera.frame(timeout_s=10.0).image[0, 0] == wanted


def test_a_camera_that_hangs_is_told_in_time(monkeypatch):
    camera = a_camera_with(Hanging(is_stamped=False), monkeypatch)
    with pytest.raises(DriverError, match="unplugged"):
        camera.frame(timeout_s=0.05)
    # Nobody touches it again while its driver hangs.
    with pytest.raises(DriverError, match="unplugged"):
        camera.frame(timeout_s=10.0)
    camera.close()


def test_a_stream_that_nobody_serves_is_told_in_seconds(capfd):
    began = time.monotonic()
    with pytest.raises(DriverError, match="cannot be opened"):
        UvcCamera("rtsp://127.0.0.1:9/none")
    # Refused at once here; a lost host takes its 5 s, where OpenCV would wait for 30.
    assert time.monotonic() - began < 25.0
    capfd.readouterr()
