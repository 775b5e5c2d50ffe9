"""Streaming cameras: a thread that reads them, and the first picture that is new enough.

Unread pictures wait in a driver's or a network's buffers and get old. A thread therefore takes all
of them as they come, and notes the time.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, Image, Image16
from visioncal.live.drivers.protocols import DeviceSetup, Frame, Stopwatch

# The longest wait, in intervals between this camera's pictures: one under way at the request, the
# requested one, and one more for network jitter.
_INTERVALS = 3.0
# Time for automatic exposure, focus and the like before they are held [s].
SETTLE_S = 1.5
_STEP = "Look at its cable, its power and its network."


@dataclass(frozen=True, eq=False)
class Arrival:
    """A picture that has come."""

    arrived_s: float  # When it came, on the host's monotonic clock [s].
    # Its pixels, as in `Frame`; None where it is cut short. Valid until the next picture is read.
    decode: Callable[[], Image | None]
    # Begin and middle of its exposure by that clock, where the camera reports them [s].
    exposed_s: tuple[float, float] | None = None
    # Its distances, aligned to it, where the camera measures them; valid likewise.
    depth: Callable[[], Image16] | None = None


# An opened camera: its name in messages; its pictures, which end where the camera does,
# with None where there was none for a while; and the settings that it reports.
Opened: TypeAlias = tuple[str, Iterator[Arrival | None], dict[str, str | float]]


class StreamingCamera:
    """Camera device whose pictures a thread reads as they come.

    Args:
        address: Which camera, in the kind's own form; empty for the only one.
        requested: Requested settings.

    Raises:
        DriverError: Its library or the camera is missing, it is held by another program, gives no
            picture, or refuses a requested setting.
    """

    # Intrinsics that the device itself reports.
    factory: Camera | None = None

    def __init__(self, address: str | int = "", requested: DeviceSetup | None = None) -> None:
        requested = requested or DeviceSetup()
        with ExitStack() as opening:
            self.name, arrivals, settings = self._open(str(address), requested, opening)
            closing = opening.pop_all()
        self.settings = MappingProxyType(settings)
        # 0 where it is not known.
        self._exposure_s = 1e-6 * float(settings.get("exposure_us", requested.exposure_us or 0))
        # Of so many pictures the mean interval counts.
        self._arrivals_s: deque[float] = deque(maxlen=50)
        self._news = threading.Condition()
        # The moment after which the exposure of a requested picture begins, how many were too old
        # for it, and the stamp, the picture and its depth.
        self._request_s: float | None = -math.inf
        self._too_old = 0
        self._answer: tuple[float, Image, Image16 | None] | None = None
        self._error: Exception | None = None
        self._is_closing = False
        read, name = (arrivals, closing), f"pictures of {self.name}"
        self._thread = threading.Thread(target=self._read, args=read, name=name, daemon=True)
        self._thread.start()
        try:
            first = self._wait(5.0)
            check_resolution(self.name, first.image, requested.resolution, "gives")
        except BaseException:
            self.close()
            raise
        height, width = first.image.shape[:2]
        self.resolution = (width, height)

    def _open(self, address: str, requested: DeviceSetup, closing: ExitStack) -> Opened:
        """Opens the camera, to be released by `closing`; what drivers differ in."""
        raise NotImplementedError

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call, as far as can be known.

        Where the camera does not report when it exposed, that is the second picture after the call;
        a delay of more than one picture within the camera remains unknown. The stamp is then the
        time of arrival, minus half the exposure where it is known.

        Raises:
            DriverError: None came in time, or it has another resolution than before.
        """
        with self._news:
            self._request_s, self._too_old, self._answer = time.monotonic(), 0, None
        frame = self._wait(timeout_s)
        check_resolution(self.name, frame.image, self.resolution, "now gives")
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
                    why, step = f"stalls: no picture has come for {waiting.read():.1f} s", _STEP
                    if self._too_old > _INTERVALS:
                        why = f"gives no fresh pictures: {self._too_old} that came were older than "
                        why += "the request, or cut short"
                        step = "It sends more than can be carried or decoded: set a lower rate or "
                        step += "resolution."
                    raise camera_error(self.name, why, step)
                self._news.wait(0.05)
            stamp_s, image, depth = self._answer
        return Frame(image, stamp_s, self._exposure_s or None, depth=depth)

    def _read(self, arrivals: Iterator[Arrival | None], closing: ExitStack) -> None:
        ended = "gives no picture: it is unplugged, or closed its stream"
        error = camera_error(self.name, ended, _STEP)
        with closing:
            try:
                for arrival in arrivals:
                    if self._is_closing:
                        break
                    if arrival is not None:
                        self._handle(arrival)
            except Exception as caught:  # noqa: BLE001
                error = camera_error(self.name, f"{ended} ({caught})", _STEP)
                error.__cause__ = caught
        # Raised to whoever waits for a picture.
        with self._news:
            self._error = error
            self._news.notify_all()

    def _handle(self, arrival: Arrival) -> None:
        """Answers a request with a picture if it is new enough."""
        before_s = self._arrivals_s[-1] if self._arrivals_s else -math.inf
        now_s, exposure_s = arrival.arrived_s, self._exposure_s
        if arrival.exposed_s is not None:
            began_s, middle_s = arrival.exposed_s
        else:
            # It began after the picture before had arrived, unless it waited in a buffer. Then it
            # comes after a small share of an interval.
            waited = now_s - before_s < 0.3 * self._interval_s()
            began_s = -math.inf if waited else min(before_s, now_s - exposure_s)
            middle_s = now_s - 0.5 * exposure_s
        self._arrivals_s.append(now_s)
        request_s = self._request_s
        if request_s is None:
            return
        # Not under the lock: it may take long, and a waiting caller must be able to time out.
        image = None if began_s < request_s else arrival.decode()
        if image is None:
            # The next one may be newer, or whole.
            self._too_old += 1
            return
        depth = None if arrival.depth is None else arrival.depth()
        with self._news:
            if self._request_s == request_s:
                self._request_s, self._answer = None, (middle_s, image, depth)
                self._news.notify_all()

    def _interval_s(self) -> float:
        """Mean interval between recent pictures [s]; 0 where it is not known."""
        recent = list(self._arrivals_s)
        return (recent[-1] - recent[0]) / (len(recent) - 1) if len(recent) > 1 else 0.0


def camera_error(name: str, why: str, step: str, *culprits: str) -> DriverError:
    """The error of a camera; by default it is itself the culprit."""
    return DriverError(f"The {name} {why}.", culprits=culprits or [name], next_step=step)


def check_resolution(name: str, image: Image, needed: tuple[int, int] | None, how: str) -> None:
    """Checks the (width, height) that a picture of a camera must have [px]; raises DriverError."""
    height, width = image.shape[:2]
    if needed is not None and needed != (width, height):
        why = f"{how} {width}x{height} pixels, not {needed[0]}x{needed[1]}"
        step = "Ask for a resolution that its maker's viewer or page shows (on Linux: v4l2-ctl)."
        raise camera_error(name, why, step)


@contextmanager
def being_opened(name: str, *errors: type[Exception]) -> Iterator[None]:
    """Words what a library raises where it cannot open a camera; raises DriverError."""
    try:
        yield
    except errors as error:
        step = "Look at whether another program holds it, as its maker's viewer; at its cable and "
        step += "its power; and at whether this user may use it."
        raise camera_error(name, f"cannot be opened: {error}", step) from error


def chosen(kind: str, found: Sequence[tuple[str, ...]], wanted: str, viewer: str) -> int:
    """Index of the one camera that is meant among those that are connected, by their names.

    Raises:
        DriverError: No camera is connected, or several are and none is named.
    """
    matching = [index for index, names in enumerate(found) if not wanted or wanted in names]
    if len(matching) == 1:
        return matching[0]
    step = f"Look at whether {viewer} shows it: its cable, its power, its network."
    why = "is not connected"
    if matching:
        why, step = "may be any of several", f"Say which: --camera {kind}:{found[matching[0]][0]}."
    connected = ", ".join(" ".join(names) for names in found) or "none"
    name = f"{kind}:{wanted}".rstrip(":")
    raise camera_error(f"camera {name}", f"{why}; connected: {connected}", step)


def refuse_settings(name: str, requested: DeviceSetup, where: str) -> None:
    """Refuses exposure, gain and focus that only another program can set; raises DriverError."""
    if (requested.exposure_us, requested.gain, requested.focus) != (None, None, None):
        step = f"Leave them out, and hold exposure and focus {where}."
        options = ("--exposure-us", "--gain", "--focus")
        raise camera_error(name, "gives nothing but pictures, and cannot be set", step, *options)
