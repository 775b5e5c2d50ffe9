"""Cameras that OpenCV opens: USB video class, a device file, a stream's URL, or a video file."""

import math
import time
from types import MappingProxyType

import cv2

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, Image
from visioncal.live.drivers.grabbed import FilePictures, GrabbedPictures
from visioncal.live.drivers.multipart import (
    UNREACHED,
    MultipartPictures,
    open_multipart,
    without_password,
)
from visioncal.live.drivers.newest import Arrival, Newest
from visioncal.live.drivers.protocols import DeviceSetup, Frame
from visioncal.vision.finders.imaging import decode_image

# Some cameras take their time for the first picture [s].
_OPENING_S = 5.0
# How long a stream may take to open, and for a picture [ms].
_OPEN_MS, _READ_MS = 5000, 1500
# Streams whose pictures carry the camera's own times.
_TIMED = ("rtsp", "rtsps", "rtmp", "srt")
# V4L2's word for exposure that the user sets, and its unit [s].
_MANUAL_EXPOSURE = 1.0
_EXPOSURE_UNIT_S = 1e-4


class UvcCamera:
    """A camera device through OpenCV's VideoCapture, or a stream of JPEG files over HTTP.

    What is asked for is set where the camera can; `settings` are what it then reports.
    Autofocus, which would move the intrinsics, is switched off. Exposure that is not wished stays
    as the camera has it, which is automatic for most. All that comes is read at once, so that no
    old picture waits in a buffer; of a video file every picture counts.

    Args:
        source: The camera's index, the path of its device, a URL, or a video file.
        requested: What is asked of it; of a URL, which resolution it is to have.

    Raises:
        DriverError: It cannot be opened or gives no picture, or refuses what is wished.
    """

    # Such a camera does not report its intrinsics.
    factory: Camera | None = None

    def __init__(self, source: int | str, requested: DeviceSetup | None = None) -> None:
        requested = requested or DeviceSetup()
        self.name = f"camera {without_password(str(source))}"
        self._exposure_s = 1e-6 * (requested.exposure_us or 0)
        settings: dict[str, str | float] = {}
        self._feed: Newest[bytes] | Newest[Image] | FilePictures
        pictures = _multipart(source, requested)
        if pictures is not None:
            self._feed = Newest(pictures, self.name)
        else:
            capture = _opened(source, self.name)
            settings = _set(capture, requested)
            # A device has no number of pictures.
            if int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0:
                self._feed = FilePictures(capture, self.name)
            else:
                is_stream = _scheme(source) in _TIMED
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

        Where the driver knows no times that is the second picture to come after the call; what a
        camera holds back for longer than one picture is not known. It is stamped when it came,
        less half its exposure where that is known. Of a video file it is the next picture.

        Raises:
            DriverError: None came, with for how long; or it has another resolution than before.
        """
        frame = self._frame(*self._feed.after(time.monotonic(), timeout_s))
        self._check_resolution(frame, self.resolution, "now gives")
        return frame

    def close(self) -> None:
        """Lets go of it; may be called twice."""
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
    """The scheme of a URL; empty for what is none, as a GStreamer pipeline with one in it."""
    if isinstance(source, int) or "!" in source.partition("://")[0]:
        return ""
    scheme, found, _ = source.partition("://")
    return scheme.lower() if found else ""


def _multipart(source: int | str, requested: DeviceSetup) -> MultipartPictures | None:
    """The JPEG files of a URL that sends such; None for every other source."""
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


def _opened(source: int | str, name: str) -> cv2.VideoCapture:
    if isinstance(source, int) or not _scheme(source):
        capture = cv2.VideoCapture(source)
    else:
        # Of itself it waits for half a minute, and decoding in n threads keeps n pictures back.
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


def _set(capture: cv2.VideoCapture, requested: DeviceSetup) -> dict[str, str | float]:
    """Sets what is wished, stops the focus from moving by itself, and asks what came of it."""
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
    # OpenCV says 0 or -1 of what the camera does not have.
    return {name: it for name, it in values.items() if math.isfinite(it) and it > 0.0}
