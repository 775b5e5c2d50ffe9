"""The newest picture of a camera that sends picture after picture, asked for or not.

Pictures that nobody takes wait in a driver's or a network's buffers, and whoever takes one then
gets an old one. So a thread takes all of them, at the pace at which they come, and notes the time.
"""

import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

from visioncal.core.errors import DriverError
from visioncal.live.drivers.stopwatch import Stopwatch

# The longest wait, in intervals between this camera's last pictures: one under way when it is
# asked for, the one that is wanted, and one more for a network's jitter. Intervals longer than this
# are a stall and no pace [s].
_INTERVALS, _LAST, _LONGEST_S = 3.0, 4, 3.0
# A camera's pace is its mean over so long [s]: what a stall delays, a burst then brings. What comes
# after less than this share of an interval had waited in a buffer.
_PACE_S, _BURST = 10.0, 0.3
# How long the thread may take to end; one that hangs in a driver ends with the process [s].
_ENDING_S = 2.0
# How often who waits looks at the time [s].
_GLANCE_S = 0.05

T_co = TypeVar("T_co", covariant=True)
T = TypeVar("T")


@dataclass(frozen=True)
class Arrival:
    """When a picture came, on the host's monotonic clock.

    Attributes:
        stamp_s: When it came [s].
        began_s: Its exposure began no earlier [s]; None where its driver knows no times.
    """

    stamp_s: float
    began_s: float | None = None


class Source(Protocol[T_co]):
    """Gives all pictures of a camera, one after the other; one thread alone calls it."""

    def grab(self) -> Arrival:
        """Waits for the next picture.

        Raises:
            DriverError: There are no more.
        """

    def take(self) -> T_co:
        """Returns the picture that was grabbed last; costly where it has to be decoded for that."""

    def interrupt(self) -> None:
        """Lets `grab` end soon, where that can be; called by another thread."""

    def close(self) -> None:
        """Lets go of the camera."""


@dataclass(eq=False)
class _PictureRequest(Generic[T]):
    """A wish for a picture whose exposure began after a moment [s], and what came of it."""

    moment_s: float
    given: tuple[Arrival, T] | None = None
    passed_by: int = 0


class Newest(Generic[T]):
    """The newest picture of a source, which a thread reads all the time.

    Args:
        source: The source; closed by the thread at its end.
        name: Whose pictures they are, for people.
    """

    def __init__(self, source: Source[T], name: str) -> None:
        self._source, self._name = source, name
        self._news = threading.Condition()
        self._first: _PictureRequest[T] = _PictureRequest(-math.inf)
        self._request: _PictureRequest[T] | None = self._first
        self._came_s, self._late_s = time.monotonic(), 0.0
        self._stamps_s: deque[float] = deque()
        self._error: Exception | None = None
        self._is_closing = False
        self._thread = threading.Thread(target=self._read, name=f"pictures of {name}", daemon=True)
        self._thread.start()

    def first(self, timeout_s: float) -> tuple[Arrival, T]:
        """Waits for the first picture of all; the arguments and errors are those of `after`."""
        return self._answered(self._first, timeout_s)

    def after(self, moment_s: float, timeout_s: float) -> tuple[Arrival, T]:
        """Waits for a picture whose exposure began after a moment.

        Args:
            moment_s: The moment, on the host's monotonic clock [s].
            timeout_s: How long to wait [s]; for a slow camera longer, by its own pace.

        Raises:
            DriverError: None came, with for how long, or the camera is at its end.
        """
        request: _PictureRequest[T] = _PictureRequest(moment_s)
        with self._news:
            self._request = request
        return self._answered(request, timeout_s)

    def close(self) -> None:
        """Ends the thread, which lets go of the camera; may be called twice."""
        self._is_closing = True
        self._source.interrupt()
        self._thread.join(_ENDING_S)

    def _answered(self, request: _PictureRequest[T], timeout_s: float) -> tuple[Arrival, T]:
        waiting = Stopwatch()
        with self._news:
            while request.given is None:
                if self._error is not None:
                    raise self._error
                patience_s = max(timeout_s, _INTERVALS * self._longest_interval_s())
                left_s = patience_s - waiting.read()
                if left_s <= 0.0:
                    raise self._missed(request)
                self._news.wait(min(left_s, _GLANCE_S))
            return request.given

    def _read(self) -> None:
        try:
            while not self._is_closing:
                self._note(self._source.grab())
        except Exception as error:  # noqa: BLE001
            # Whoever waits for a picture raises it.
            with self._news:
                self._error = error
                self._news.notify_all()
        finally:
            self._source.close()

    def _note(self, arrival: Arrival) -> None:
        now = time.monotonic()
        with self._news:
            began_s = self._began_s(arrival)
            self._stamps_s.append(arrival.stamp_s)
            while self._stamps_s[0] < arrival.stamp_s - _PACE_S:
                self._stamps_s.popleft()
            self._came_s, self._late_s = now, now - arrival.stamp_s
            request = self._request
            if request is None:
                return
            if began_s < request.moment_s:
                request.passed_by += 1
                return
        # Not under the lock: it may take long, and whoever waits must be able to give up.
        taken = self._source.take()
        with self._news:
            request.given = (arrival, taken)
            if self._request is request:
                self._request = None
            self._news.notify_all()

    def _began_s(self, arrival: Arrival) -> float:
        """When a picture's exposure may have begun at the earliest."""
        # Where no times are known that is when the picture before it came, if it was waited for.
        if arrival.began_s is not None:
            return arrival.began_s
        stamps = self._stamps_s
        if not stamps:
            return -math.inf
        interval_s = (stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1)
        is_waited_for = arrival.stamp_s - stamps[-1] > _BURST * interval_s
        return stamps[-1] if is_waited_for else -math.inf

    def _longest_interval_s(self) -> float:
        """The longest of the last intervals between pictures that is none of a stall [s]."""
        last = list(self._stamps_s)[-_LAST - 1 :]
        return max((min(b - a, _LONGEST_S) for a, b in pairwise(last)), default=0.0)

    def _missed(self, request: _PictureRequest[T]) -> DriverError:
        if request.passed_by > _INTERVALS:
            return DriverError(
                f"The {self._name} gives no fresh pictures: its last one came {self._late_s:.1f} s "
                "late.",
                culprits=[self._name],
                next_step="It sends more than can be carried or decoded: set it to a lower rate or "
                "resolution.",
            )
        silent_s = time.monotonic() - self._came_s
        return DriverError(
            f"The {self._name} stalls: no picture has come for {silent_s:.1f} s.",
            culprits=[self._name],
            next_step="Look at its cable, its power and its network; then go on with --resume.",
        )
