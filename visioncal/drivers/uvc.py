"""Cameras that OpenCV opens: USB video class, a device file, a stream's URL, or a video file."""

import math
import threading
import time
from collections.abc import Mapping
from queue import Empty, Queue
from types import MappingProxyType

import cv2
import numpy as np

from visioncal.drivers.protocols import DeviceWishes, Frame
from visioncal.errors import DriverError
from visioncal.types import Camera, Image

# A picture that comes after as long a wait was not in the driver's queue [s].
_WAITED_S = 0.008
# Some cameras take their time for the first picture [s].
_OPENING_S = 5.0
# How long a stream may take to open, and for a picture [ms].
_OPEN_MS, _READ_MS = 5000, 1500
# V4L2's word for exposure that the user sets, and its unit [s].
_MANUAL_EXPOSURE = 1.0
_EXPOSURE_UNIT_S = 1e-4


class UvcCamera:
    """A camera device through OpenCV's VideoCapture.

    What is asked for is set where the camera can; `settings` tell what it then says of itself.
    Autofocus, which would move the intrinsics, is switched off. Exposure that is not wished stays
    as the camera has it, which is automatic for most.

    Args:
        source: The camera's index, the path of its device, a URL, or a video file.
        wishes: What is asked of it.

    Raises:
        DriverError: It cannot be opened or gives no picture, or refuses the resolution.
    """

    def __init__(self, source: int | str, wishes: DeviceWishes | None = None) -> None:
        self._source = source
        self._capture = _opened(source)
        self._is_lost = False
        if not self._capture.isOpened():
            self._capture.release()
            raise DriverError(
                f"The {self.name} cannot be opened.",
                culprits=[str(source)],
                next_step="Look at its cable, at whether another program holds it, and at whether "
                "this user may read it (on Linux: the group video; v4l2-ctl --list-devices).",
            )
        wishes = wishes or DeviceWishes()
        self._settings = MappingProxyType(_set(self._capture, wishes))
        self._exposure_s = 1e-6 * (wishes.exposure_us or 0)
        # A device has no number of pictures.
        self._is_file = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0
        try:
            self._grab(_OPENING_S)
            first = self._retrieved()
            self._resolution = (first.shape[1], first.shape[0])
            self._check_resolution(wishes)
        except DriverError:
            self.close()
            raise
        self._unread = first if self._is_file else None

    @property
    def name(self) -> str:
        """Which camera it is."""
        return f"camera {self._source}"

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) of its pictures [px]."""
        return self._resolution

    @property
    def factory(self) -> Camera | None:
        """None: such a camera does not tell its intrinsics."""
        return None

    @property
    def settings(self) -> Mapping[str, str | float]:
        """What the camera says that it is set to."""
        return self._settings

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call, as far as can be told.

        Old ones in the driver's queue are passed by. Of a video file every picture counts.

        Raises:
            DriverError: None came: unplugged, or the file is at its end.
        """
        asked = time.monotonic()
        if self._unread is not None:
            first, self._unread = self._unread, None
            return Frame(first, asked)
        waits = 0
        while True:
            waited_s = self._grab(asked + timeout_s - time.monotonic())
            arrived = time.monotonic()
            waits += waited_s > _WAITED_S
            told = self._told_stamp(arrived)
            stamp = arrived if told is None else told
            # Where the driver tells no times, the first that was waited for began before the call.
            began_after = waits > 1 if told is None else told - self._exposure_s > asked
            if began_after or self._is_file:
                exposure_s = self._exposure_s or None
                return Frame(self._retrieved(), stamp - 0.5 * self._exposure_s, exposure_s)

    def close(self) -> None:
        """Lets go of it; may be called twice."""
        # What hangs in its driver holds it until this process ends.
        if not self._is_lost:
            self._capture.release()

    def _told_stamp(self, now: float) -> float | None:
        """When a picture had come, by the clock of the kernel; only Linux' V4L2 tells it."""
        told = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        return told if now - 1.0 < told <= now and not self._is_file else None

    def _grab(self, timeout_s: float) -> float:
        """Takes the next picture and tells how long that took [s].

        In a thread: the driver of a camera that is lost may hang for long.
        """
        if self._is_lost:
            raise self._gone()
        answers: Queue[tuple[bool, float]] = Queue()

        def grab() -> None:
            began = time.monotonic()
            is_there = self._capture.grab()
            answers.put((is_there, time.monotonic() - began))

        threading.Thread(target=grab, daemon=True).start()
        try:
            is_there, took_s = answers.get(timeout=max(timeout_s, 0.0))
        except Empty:
            self._is_lost = True
            raise self._gone() from None
        if not is_there:
            raise self._gone()
        return took_s

    def _retrieved(self) -> Image:
        read, image = self._capture.retrieve()
        if not read or image is None:
            raise self._gone()
        return np.asarray(image, np.uint8)

    def _gone(self) -> DriverError:
        return DriverError(
            f"The {self.name} gives no picture: it is unplugged, or at its end.",
            culprits=[str(self._source)],
            next_step="Look at its cable; then go on with --resume.",
        )

    def _check_resolution(self, wishes: DeviceWishes) -> None:
        if wishes.resolution in (None, self._resolution):
            return
        (width, height), wished = self._resolution, wishes.resolution
        raise DriverError(
            f"The {self.name} gives {width}x{height} pixels, not {wished[0]}x{wished[1]}.",
            culprits=[str(self._source)],
            next_step="Ask for a resolution that it has (on Linux: v4l2-ctl --list-formats-ext).",
        )


def _opened(source: int | str) -> cv2.VideoCapture:
    if isinstance(source, int) or "://" not in source:
        return cv2.VideoCapture(source)
    # Of itself it waits for half a minute.
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_MS]
    return cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)


def _set(capture: cv2.VideoCapture, wishes: DeviceWishes) -> dict[str, str | float]:
    """Sets what is wished, stops the focus from moving by itself, and asks what came of it."""
    if wishes.resolution is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, wishes.resolution[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, wishes.resolution[1])
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)
    if wishes.focus is not None:
        capture.set(cv2.CAP_PROP_FOCUS, wishes.focus)
    if wishes.exposure_us is not None:
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
        capture.set(cv2.CAP_PROP_EXPOSURE, round(1e-6 * wishes.exposure_us / _EXPOSURE_UNIT_S))
    if wishes.gain is not None:
        capture.set(cv2.CAP_PROP_GAIN, wishes.gain)
    told = {
        "exposure": capture.get(cv2.CAP_PROP_EXPOSURE),
        "auto_exposure": capture.get(cv2.CAP_PROP_AUTO_EXPOSURE),
        "focus": capture.get(cv2.CAP_PROP_FOCUS),
        "gain": capture.get(cv2.CAP_PROP_GAIN),
        "rate_hz": capture.get(cv2.CAP_PROP_FPS),
    }
    # OpenCV says 0 or -1 of what the camera does not have.
    return {name: it for name, it in told.items() if math.isfinite(it) and it > 0.0}
