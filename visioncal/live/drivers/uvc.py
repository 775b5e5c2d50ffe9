"""Cameras that OpenCV opens: USB video class, a device file, or a stream's URL.

Unread pictures wait in a driver's or a network's buffers and get old. A thread therefore grabs all
of them as they come, and notes the time.
"""

import math
import threading
import time
from collections import deque
from types import MappingProxyType

import cv2
import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, Image
from visioncal.live.drivers.protocols import DeviceSetup, Frame, Stopwatch
from visioncal.vision.boards.imaging import decode_image

# OpenCV's format of packets as they come, and the code of JPEG files.
_UNDECODED, _JPEG = -1, cv2.VideoWriter.fourcc(*"MJPG")
# The longest wait, in intervals between this camera's pictures: one under way at the request, the
# requested one, and one more for network jitter; and the pictures of which the mean counts.
_INTERVALS, _PACED = 3.0, 50


class UvcCamera:
    """Camera device through OpenCV's VideoCapture.

    Requested settings are set where the camera supports them; `settings` are what it then reports.
    Autofocus, which would change the intrinsics, is switched off. Exposure stays as the camera has
    it unless requested, which is automatic for most.

    Args:
        source: The camera's index, the path of its device, or a URL.
        requested: Requested settings; of a URL, the resolution that it must have.

    Raises:
        DriverError: It cannot be opened, gives no picture, or refuses a requested setting.
    """

    # Such cameras do not report intrinsics.
    factory: Camera | None = None

    def __init__(self, source: int | str, requested: DeviceSetup | None = None) -> None:
        requested = requested or DeviceSetup()
        self.name = f"camera {without_password(str(source))}"
        self._exposure_s = 1e-6 * (requested.exposure_us or 0)
        self._capture = _open_capture(source, self.name, requested)
        # JPEG files of a network camera are decoded only when they are asked for: at a high
        # resolution they come faster than they could be decoded.
        self._is_jpeg = self._capture.get(cv2.CAP_PROP_FORMAT) == _UNDECODED
        self.settings = MappingProxyType(_configure(self._capture, requested))
        self._arrivals_s: deque[float] = deque(maxlen=_PACED)
        self._news = threading.Condition()
        # The moment after which the exposure of a requested picture begins, how many were too old
        # for it, and the picture with its stamp.
        self._request_s: float | None = -math.inf
        self._too_old = 0
        self._answer: tuple[float, Image] | None = None
        self._error: Exception | None = None
        self._is_closing = False
        self._thread = threading.Thread(
            target=self._read, name=f"pictures of {self.name}", daemon=True
        )
        self._thread.start()
        try:
            first = self._wait(5.0)
            self._check_resolution(first, requested.resolution, "gives")
        except BaseException:
            self.close()
            raise
        height, width = first.image.shape[:2]
        self.resolution = (width, height)

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call, as far as can be known.

        Without timestamps from the driver that is the second picture after the call; a delay of
        more than one picture within the camera remains unknown. The stamp is the time of arrival,
        minus half the exposure where it is known.

        Raises:
            DriverError: None came in time, or it has another resolution than before.
        """
        with self._news:
            self._request_s, self._too_old, self._answer = time.monotonic(), 0, None
        frame = self._wait(timeout_s)
        self._check_resolution(frame, self.resolution, "now gives")
        return frame

    def close(self) -> None:
        """Ends the thread, which releases the camera; may be called twice."""
        self._is_closing = True
        # One that hangs in a driver ends with the process.
        self._thread.join(2.0)

    def _wait(self, timeout_s: float) -> Frame:
        waiting = Stopwatch()
        with self._news:
            while self._answer is None:
                if self._error is not None:
                    raise self._error
                limit_s = max(timeout_s, _INTERVALS * self._interval_s())
                if waiting.read() > limit_s:
                    raise self._timeout_error(waiting.read())
                self._news.wait(0.05)
            stamp_s, image = self._answer
        return Frame(image, stamp_s - 0.5 * self._exposure_s, self._exposure_s or None)

    def _read(self) -> None:
        error: Exception = self._no_picture_error()
        try:
            while not self._is_closing and self._capture.grab():
                self._handle(*self._arrival(time.monotonic()))
        except Exception as caught:  # noqa: BLE001
            error = caught
        self._capture.release()
        # Raised to whoever waits for a picture.
        with self._news:
            self._error = error
            self._news.notify_all()

    def _arrival(self, now_s: float) -> tuple[float, float]:
        """Stamp of the grabbed picture, and earliest possible start of its exposure [s]."""
        reported_s = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        before_s = self._arrivals_s[-1] if self._arrivals_s else -math.inf
        # Only V4L2 of Linux reports the kernel's timestamp; one of the last ten seconds is of this
        # host's clock.
        if now_s - 10.0 < reported_s <= now_s:
            return reported_s, reported_s - self._exposure_s
        # Otherwise it began after the picture before had arrived, unless it waited in a buffer.
        # Then it comes after a small share of an interval.
        waited = now_s - before_s < 0.3 * self._interval_s()
        return now_s, -math.inf if waited else before_s

    def _handle(self, stamp_s: float, began_s: float) -> None:
        """Answers a request with the grabbed picture if it is new enough."""
        self._arrivals_s.append(stamp_s)
        request_s = self._request_s
        if request_s is None:
            return
        if began_s < request_s:
            self._too_old += 1
            return
        # Not under the lock: it may take long, and a waiting caller must be able to time out.
        read, image = self._capture.retrieve()
        if not read or image is None:
            raise self._no_picture_error()
        if self._is_jpeg:
            decoded = decode_image(image.tobytes(), colour=True)
            if isinstance(decoded, str):
                # Cut short, as where the network lost a part; the next one may be whole.
                self._too_old += 1
                return
            image = decoded
        with self._news:
            if self._request_s == request_s:
                self._request_s, self._answer = None, (stamp_s, np.asarray(image, np.uint8))
                self._news.notify_all()

    def _interval_s(self) -> float:
        """Mean interval between recent pictures [s]; 0 where it is not known."""
        recent = list(self._arrivals_s)
        return (recent[-1] - recent[0]) / (len(recent) - 1) if len(recent) > 1 else 0.0

    def _check_resolution(self, frame: Frame, needed: tuple[int, int] | None, how: str) -> None:
        height, width = frame.image.shape[:2]
        if needed is None or needed == (width, height):
            return
        raise DriverError(
            f"The {self.name} {how} {width}x{height} pixels, not {needed[0]}x{needed[1]}.",
            culprits=[self.name],
            next_step="Ask for a resolution that it has (on Linux: v4l2-ctl --list-formats-ext; of "
            "a URL, on the camera's own page).",
        )

    def _no_picture_error(self) -> DriverError:
        return DriverError(
            f"The {self.name} gives no picture: it is unplugged, or closed its stream.",
            culprits=[self.name],
            next_step="Look at its cable, its power and its network; then go on with --resume.",
        )

    def _timeout_error(self, waited_s: float) -> DriverError:
        if self._too_old > _INTERVALS:
            return DriverError(
                f"The {self.name} gives no fresh pictures: {self._too_old} that came were older "
                "than the request, or cut short.",
                culprits=[self.name],
                next_step="It sends more than can be carried or decoded: set it to a lower rate or "
                "resolution.",
            )
        return DriverError(
            f"The {self.name} stalls: no picture has come for {waited_s:.1f} s.",
            culprits=[self.name],
            next_step="Look at its cable, its power and its network; then go on with --resume.",
        )


def without_password(url: str) -> str:
    """A URL without user and password, to be shown and stored."""
    scheme, separator, rest = url.partition("://")
    authority, slash, path = rest.partition("/")
    return f"{scheme}{separator}{authority.rpartition('@')[2]}{slash}{path}" if separator else url


def _open_capture(source: int | str, name: str, requested: DeviceSetup) -> cv2.VideoCapture:
    scheme, separator, _ = str(source).partition("://")
    is_url = bool(separator) and "!" not in scheme
    if is_url and (requested.exposure_us, requested.gain, requested.focus) != (None, None, None):
        raise DriverError(
            f"The {name} cannot be set from here: a URL gives nothing but pictures.",
            culprits=["--exposure-us", "--gain", "--focus"],
            next_step="Leave them out, and hold exposure and focus on the camera's own page.",
        )
    if is_url:
        # The default timeout is half a minute, and decoding in n threads delays by n pictures.
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000]
        limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, 1500, cv2.CAP_PROP_N_THREADS, 1]
        undecoded = [*limits, cv2.CAP_PROP_FORMAT, _UNDECODED]
        capture = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, undecoded)
        if capture.isOpened() and int(capture.get(cv2.CAP_PROP_FOURCC)) != _JPEG:
            # Pictures of other codecs depend on those before them.
            capture.release()
            capture = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, limits)
    else:
        capture = cv2.VideoCapture(source)
    why, step = "", ""
    if not capture.isOpened():
        why = "cannot be opened"
        step = (
            "Look at its address, its power and its network: does another player on this computer "
            "show its pictures? One that wants a password has it in its URL: "
            "http://USER:PASSWORD@HOST/PATH."
            if is_url
            else "Look at its cable, at whether another program holds it, and at whether this user "
            "may read it (on Linux: the group video; v4l2-ctl --list-devices)."
        )
    # Only a file has a number of pictures.
    elif int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0:
        why = "is a video file, whose pictures have no time"
        step = "Extract them into a folder, and give their poses in a table: visioncal convert."
    if why:
        capture.release()
        raise DriverError(f"The {name} {why}.", culprits=[name], next_step=step)
    return capture


def _configure(capture: cv2.VideoCapture, requested: DeviceSetup) -> dict[str, str | float]:
    """Sets what is requested, disables autofocus, and reads back the settings."""
    if requested.resolution is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, requested.resolution[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, requested.resolution[1])
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)
    if requested.focus is not None:
        capture.set(cv2.CAP_PROP_FOCUS, requested.focus)
    if requested.exposure_us is not None:
        # V4L2's value for manual exposure, and its unit of 0.1 ms.
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0)
        capture.set(cv2.CAP_PROP_EXPOSURE, round(1e-6 * requested.exposure_us / 1e-4))
    if requested.gain is not None:
        capture.set(cv2.CAP_PROP_GAIN, requested.gain)
    values = {
        "exposure": capture.get(cv2.CAP_PROP_EXPOSURE),
        "auto_exposure": capture.get(cv2.CAP_PROP_AUTO_EXPOSURE),
        "focus": capture.get(cv2.CAP_PROP_FOCUS),
        "gain": capture.get(cv2.CAP_PROP_GAIN),
        "rate_hz": capture.get(cv2.CAP_PROP_FPS),
    }
    # OpenCV returns 0 or -1 for settings that the camera does not have.
    return {name: value for name, value in values.items() if math.isfinite(value) and value > 0.0}
