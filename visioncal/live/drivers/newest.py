"""Reader of the newest picture of a camera that sends pictures continuously.

Unread pictures wait in a driver's or a network's buffers and get old. A thread therefore reads all
of them as they come, and notes the time.
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

# The longest wait, in intervals between this camera's recent pictures: one under way at the
# request, the requested one, and one more for network jitter; how many recent intervals count; and
# the longest interval that is not a stall [s].
_INTERVALS, _RECENT_INTERVALS, _LONGEST_S = 3.0, 4, 3.0
# Time over which a camera's mean interval is taken [s], as a burst follows a stall. A picture that
# comes after less than this share of an interval had waited in a buffer.
_PACE_S, _BURST = 10.0, 0.3
# Timeout of the thread's end [s]; one that hangs in a driver ends with the process.
_JOIN_S = 2.0
# Polling interval of waiting callers [s].
_GLANCE_S = 0.05

T_co = TypeVar("T_co", covariant=True)
T = TypeVar("T")


@dataclass(frozen=True)
class Arrival:
    """Time of a picture on the host's monotonic clock.

    Attributes:
        stamp_s: Time of arrival [s].
        began_s: Lower bound of the start of exposure [s]; None where the driver has no timestamps.
    """

    stamp_s: float
    began_s: float | None = None


class Source(Protocol[T_co]):
    """Source of all pictures of a camera in order; a single thread calls it."""

    def grab(self) -> Arrival:
        """Waits for the next picture.

        Raises:
            DriverError: There is none.
        """

    def take(self) -> T_co:
        """Returns the last grabbed picture; may be costly, as it may decode it."""

    def interrupt(self) -> None:
        """Makes `grab` return soon, where possible; called from another thread."""

    def close(self) -> None:
        """Releases the camera."""


@dataclass(eq=False)
class _PictureRequest(Generic[T]):
    """Request for a picture whose exposure began after a moment [s], and its answer."""

    moment_s: float
    answer: tuple[Arrival, T] | None = None
    too_old: int = 0


class Newest(Generic[T]):
    """Newest picture of a source that a thread reads continuously, and closes at its end."""

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
        """Waits for the very first picture; arguments and errors are those of `after`."""
        return self._wait_for(self._first, timeout_s)

    def after(self, moment_s: float, timeout_s: float) -> tuple[Arrival, T]:
        """Waits for a picture whose exposure began after a moment on the monotonic clock [s].

        The timeout [s] of a slow camera is longer.

        Raises:
            DriverError: None came in time, or the source has ended.
        """
        request: _PictureRequest[T] = _PictureRequest(moment_s)
        with self._news:
            self._request = request
        return self._wait_for(request, timeout_s)

    def close(self) -> None:
        """Ends the thread, which releases the camera; may be called twice."""
        self._is_closing = True
        self._source.interrupt()
        self._thread.join(_JOIN_S)

    def _wait_for(self, request: _PictureRequest[T], timeout_s: float) -> tuple[Arrival, T]:
        waiting = Stopwatch()
        with self._news:
            while request.answer is None:
                if self._error is not None:
                    raise self._error
                limit_s = max(timeout_s, _INTERVALS * self._longest_interval_s())
                remaining_s = limit_s - waiting.read()
                if remaining_s <= 0.0:
                    raise self._timeout_error(request)
                self._news.wait(min(remaining_s, _GLANCE_S))
            return request.answer

    def _read(self) -> None:
        try:
            while not self._is_closing:
                self._handle(self._source.grab())
        except Exception as error:  # noqa: BLE001
            # Raised to whoever waits for a picture.
            with self._news:
                self._error = error
                self._news.notify_all()
        finally:
            self._source.close()

    def _handle(self, arrival: Arrival) -> None:
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
                request.too_old += 1
                return
        # Not under the lock: it may take long, and a waiting caller must be able to time out.
        picture = self._source.take()
        with self._news:
            request.answer = (arrival, picture)
            if self._request is request:
                self._request = None
            self._news.notify_all()

    def _began_s(self, arrival: Arrival) -> float:
        """Earliest possible start of a picture's exposure [s]."""
        # Without timestamps that is the arrival of the picture before, unless this one had waited
        # in a buffer.
        if arrival.began_s is not None:
            return arrival.began_s
        stamps = self._stamps_s
        if not stamps:
            return -math.inf
        interval_s = (stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1)
        is_waited_for = arrival.stamp_s - stamps[-1] > _BURST * interval_s
        return stamps[-1] if is_waited_for else -math.inf

    def _longest_interval_s(self) -> float:
        """Longest recent interval between pictures, without stalls [s]."""
        last = list(self._stamps_s)[-_RECENT_INTERVALS - 1 :]
        return max((min(b - a, _LONGEST_S) for a, b in pairwise(last)), default=0.0)

    def _timeout_error(self, request: _PictureRequest[T]) -> DriverError:
        if request.too_old > _INTERVALS:
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
