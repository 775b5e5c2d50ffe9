"""Pictures out of OpenCV's VideoCapture: as a device or a stream sends them, or all of a file."""

import time

import cv2
import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import Image
from visioncal.live.drivers.newest import Arrival

# What a driver says is a time of this host's clock where it lies so little in the past [s].
_RECENT_S = 10.0
# The clocks of a camera and of this host may run apart by so much.
_DRIFT = 1e-4


class GrabbedPictures:
    """A source of pictures that a device or a stream sends.

    Args:
        capture: Opened.
        name: Whose pictures they are, for people.
        exposure_s: How long they are exposed, where that is known [s].
        is_stream: Whether the times that it reports are those of a camera's clock, as RTSP has
            them, and none of this host's.
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
            DriverError: There are no more.
        """
        if not self._capture.grab():
            raise _gone(self._name)
        came_s = time.monotonic()
        reported_s = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        if self._is_stream:
            before_s, self._stamp_s = self._stamp_s, self._undelayed(came_s, reported_s)
            return Arrival(self._stamp_s, before_s)
        # Only Linux' V4L2 reports when the kernel had it.
        if came_s - _RECENT_S < reported_s <= came_s:
            return Arrival(reported_s, reported_s - self._exposure_s)
        return Arrival(came_s)

    def take(self) -> Image:
        """Decodes the picture that was grabbed last.

        Raises:
            DriverError: It cannot be decoded.
        """
        return _retrieved(self._capture, self._name)

    def interrupt(self) -> None:
        """Does nothing: OpenCV's waiting ends with the next picture, or its own time limit."""

    def close(self) -> None:
        """Lets go of it."""
        self._capture.release()

    def _undelayed(self, came_s: float, reported_s: float) -> float:
        """When a picture came that may have waited for its decoding: the least delay counts."""
        ahead_s = came_s - reported_s
        # A stream that reports no times, or begins again, is taken as it comes.
        is_onward = reported_s > self._reported_s
        drift_s = _DRIFT * (reported_s - self._reported_s)
        self._ahead_s = min(ahead_s, self._ahead_s + drift_s) if is_onward else ahead_s
        self._reported_s = reported_s
        return reported_s + self._ahead_s


class FilePictures:
    """Every picture of a video file, one after the other, each stamped when it is asked for.

    Args:
        capture: Opened.
        name: Whose pictures they are, for people.
    """

    def __init__(self, capture: cv2.VideoCapture, name: str) -> None:
        self._capture, self._name = capture, name
        self._unread: Image | None = None

    def first(self, timeout_s: float) -> tuple[Arrival, Image]:
        """Returns the first picture, which `after` will return again.

        Raises:
            DriverError: There is none.
        """
        arrival, self._unread = self.after(-np.inf, timeout_s)
        return arrival, self._unread

    def after(self, moment_s: float, timeout_s: float) -> tuple[Arrival, Image]:
        """Returns the next picture; no moment and no time limit is needed.

        Raises:
            DriverError: There is no further one.
        """
        del moment_s, timeout_s
        arrival = Arrival(time.monotonic())
        if self._unread is not None:
            image, self._unread = self._unread, None
            return arrival, image
        if not self._capture.grab():
            raise _gone(self._name)
        return arrival, _retrieved(self._capture, self._name)

    def close(self) -> None:
        """Lets go of it; may be called twice."""
        self._capture.release()


def _gone(name: str) -> DriverError:
    """Words that there are no more pictures."""
    return DriverError(
        f"The {name} gives no picture: it is unplugged, or at its end.",
        culprits=[name],
        next_step="Look at its cable; then go on with --resume.",
    )


def _retrieved(capture: cv2.VideoCapture, name: str) -> Image:
    read, image = capture.retrieve()
    if not read or image is None:
        raise _gone(name)
    return np.asarray(image, np.uint8)
