"""Cameras that OpenCV opens: USB video class, a device file, a stream's URL, or a video file."""

import math
import time
from types import MappingProxyType

import cv2
import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, Image
from visioncal.live.drivers.multipart import (
    UNREACHED,
    MultipartPictures,
    open_multipart,
    without_password,
)
from visioncal.live.drivers.newest import Arrival, Newest
from visioncal.live.drivers.protocols import DeviceSetup, Frame
from visioncal.vision.finders.imaging import decode_image

# Timeout of the first picture [s].
_OPENING_S = 5.0
# Timeouts of opening a stream, and of a picture [ms].
_OPEN_MS, _READ_MS = 5000, 1500
# Streams whose pictures carry the camera's own timestamps.
_TIMESTAMPED = ("rtsp", "rtsps", "rtmp", "srt")
# V4L2's value for manual exposure, and its unit [s].
_MANUAL_EXPOSURE = 1.0
_EXPOSURE_UNIT_S = 1e-4
# A driver's timestamp no older than this is taken as one of this host's clock [s].
_RECENT_S = 10.0
# Greatest relative drift between the clocks of a camera and of this host.
_DRIFT = 1e-4


class UvcCamera:
    """Camera device through OpenCV's VideoCapture, or a stream of JPEG files over HTTP.

    Requested settings are set where the camera supports them; `settings` are what it then reports.
    Autofocus, which would change the intrinsics, is switched off. Exposure stays as the camera has
    it unless requested, which is automatic for most. All pictures are read at once, so that none
    gets old in a buffer; of a video file every picture is returned.

    Args:
        source: The camera's index, the path of its device, a URL, or a video file.
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
        settings: dict[str, str | float] = {}
        self._feed: Newest[bytes] | Newest[Image] | FilePictures
        pictures = _open_jpeg_stream(source, requested)
        if pictures is not None:
            self._feed = Newest(pictures, self.name)
        else:
            capture = _open_capture(source, self.name)
            settings = _configure(capture, requested)
            # Only a file has a number of pictures.
            if int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0:
                self._feed = FilePictures(capture, self.name)
            else:
                is_stream = _scheme(source) in _TIMESTAMPED
                grabbed = GrabbedPictures(capture, self.name, self._exposure_s, is_stream=is_stream)
                self._feed = Newest(grabbed, self.name)
        self.settings = MappingProxyType(settings)
        try:
            first = self._frame(*self._feed.first(_OPENING_S))
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
        minus half the exposure where it is known. Of a video file it is the next picture.

        Raises:
            DriverError: None came in time, or it has another resolution than before.
        """
        frame = self._frame(*self._feed.after(time.monotonic(), timeout_s))
        self._check_resolution(frame, self.resolution, "now gives")
        return frame

    def close(self) -> None:
        """Releases the camera; may be called twice."""
        self._feed.close()

    def _frame(self, arrival: Arrival, content: Image | bytes) -> Frame:
        image = decode_image(content, colour=True) if isinstance(content, bytes) else content
        if isinstance(image, str):
            raise DriverError(
                f"The {self.name} sent a picture that is {image}.",
                culprits=[self.name],
                next_step="Look at its network; then go on with --resume.",
            )
        return Frame(image, arrival.stamp_s - 0.5 * self._exposure_s, self._exposure_s or None)

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


def _scheme(source: int | str) -> str:
    """Scheme of a URL; empty for anything else, such as a GStreamer pipeline that contains one."""
    if isinstance(source, int) or "!" in source.partition("://")[0]:
        return ""
    scheme, separator, _ = source.partition("://")
    return scheme.lower() if separator else ""


def _open_jpeg_stream(source: int | str, requested: DeviceSetup) -> MultipartPictures | None:
    """Opens a URL that sends JPEG files; None for any other source."""
    if not _scheme(source):
        return None
    url = str(source)
    if (requested.exposure_us, requested.gain, requested.focus) != (None, None, None):
        raise DriverError(
            f"The camera {without_password(url)} cannot be set from here: a URL gives nothing but "
            "pictures.",
            culprits=["--exposure-us", "--gain", "--focus"],
            next_step="Leave them out, and hold exposure and focus on the camera's own page.",
        )
    return open_multipart(url) if _scheme(url) in ("http", "https") else None


def _open_capture(source: int | str, name: str) -> cv2.VideoCapture:
    if isinstance(source, int) or not _scheme(source):
        capture = cv2.VideoCapture(source)
    else:
        # The default timeout is half a minute, and decoding in n threads delays by n pictures.
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_MS]
        limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_MS, cv2.CAP_PROP_N_THREADS, 1]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
    if not capture.isOpened():
        capture.release()
        raise DriverError(
            f"The {name} cannot be opened.",
            culprits=[name],
            next_step=UNREACHED
            if _scheme(source)
            else "Look at its cable, at whether another program holds it, and at whether this user "
            "may read it (on Linux: the group video; v4l2-ctl --list-devices).",
        )
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
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
        capture.set(cv2.CAP_PROP_EXPOSURE, round(1e-6 * requested.exposure_us / _EXPOSURE_UNIT_S))
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


class GrabbedPictures:
    """Source of the pictures of a device or a stream.

    Args:
        capture: The opened capture.
        name: Name of the camera in messages.
        exposure_s: Exposure time; 0 where it is not known [s].
        is_stream: Whether reported times are of the camera's clock, as with RTSP, rather than of
            this host's.
    """

    def __init__(
        self, capture: cv2.VideoCapture, name: str, exposure_s: float = 0.0, *, is_stream: bool
    ) -> None:
        self._capture, self._name, self._exposure_s = capture, name, exposure_s
        self._is_stream = is_stream
        self._reported_s, self._ahead_s, self._stamp_s = np.inf, np.inf, -np.inf

    def grab(self) -> Arrival:
        """Waits for the next picture.

        Raises:
            DriverError: There is none.
        """
        if not self._capture.grab():
            raise _no_picture_error(self._name)
        arrived_s = time.monotonic()
        reported_s = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        if self._is_stream:
            before_s, self._stamp_s = self._stamp_s, self._least_delayed_s(arrived_s, reported_s)
            return Arrival(self._stamp_s, before_s)
        # Only V4L2 of Linux reports the kernel's timestamp.
        if arrived_s - _RECENT_S < reported_s <= arrived_s:
            return Arrival(reported_s, reported_s - self._exposure_s)
        return Arrival(arrived_s)

    def take(self) -> Image:
        """Decodes the last grabbed picture.

        Raises:
            DriverError: It cannot be decoded.
        """
        return _retrieve(self._capture, self._name)

    def interrupt(self) -> None:
        """Does nothing: OpenCV's wait ends with the next picture, or its own timeout."""

    def close(self) -> None:
        """Releases the capture."""
        self._capture.release()

    def _least_delayed_s(self, arrived_s: float, reported_s: float) -> float:
        """Arrival time of a picture that may have been delayed, from the least delay so far [s]."""
        ahead_s = arrived_s - reported_s
        # Without times, or after a restart of the stream, the time of arrival counts.
        continues = reported_s > self._reported_s
        drift_s = _DRIFT * (reported_s - self._reported_s)
        self._ahead_s = min(ahead_s, self._ahead_s + drift_s) if continues else ahead_s
        self._reported_s = reported_s
        return reported_s + self._ahead_s


class FilePictures:
    """All pictures of a video file in order, each stamped when it is requested."""

    def __init__(self, capture: cv2.VideoCapture, name: str) -> None:
        self._capture, self._name = capture, name
        self._unread: Image | None = None

    def first(self, timeout_s: float) -> tuple[Arrival, Image]:
        """Returns the first picture; `after` returns it again.

        Raises:
            DriverError: There is none.
        """
        arrival, self._unread = self.after(-np.inf, timeout_s)
        return arrival, self._unread

    def after(self, moment_s: float, timeout_s: float) -> tuple[Arrival, Image]:
        """Returns the next picture; moment and timeout are ignored.

        Raises:
            DriverError: There is none.
        """
        del moment_s, timeout_s
        arrival = Arrival(time.monotonic())
        if self._unread is not None:
            image, self._unread = self._unread, None
            return arrival, image
        if not self._capture.grab():
            raise _no_picture_error(self._name)
        return arrival, _retrieve(self._capture, self._name)

    def close(self) -> None:
        """Releases the file; may be called twice."""
        self._capture.release()


def _no_picture_error(name: str) -> DriverError:
    return DriverError(
        f"The {name} gives no picture: it is unplugged, or at its end.",
        culprits=[name],
        next_step="Look at its cable; then go on with --resume.",
    )


def _retrieve(capture: cv2.VideoCapture, name: str) -> Image:
    read, image = capture.retrieve()
    if not read or image is None:
        raise _no_picture_error(name)
    return np.asarray(image, np.uint8)
