"""Calls into the client library in a thread of their own, with a timeout.

The library's control interface serves one call at a time and, if the controller falls silent, may
not return for minutes. One thread owns it; callers wait no longer than their timeout.
"""

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

from visioncal.core.errors import DriverError
from visioncal.live.drivers.stopwatch import Stopwatch

T = TypeVar("T")
# Python exceptions for the C++ ones that the library throws.
_THROWN = (RuntimeError, ValueError)
# Polling interval of waiting callers [s].
_GLANCE_S = 0.05


class CallThread:
    """Worker thread that runs calls in order, and a periodic task [s] while there are none."""

    def __init__(self, name: str, idle: Callable[[], None], every_s: float) -> None:
        self._name = name
        self._idle, self._every_s = idle, every_s
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        # A daemon: a call that never returns must not keep the program from ending.
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def call(self, work: Callable[[], T], *, limit_s: float, what: str) -> T:
        """Runs a call in the thread, with a timeout [s]; `what` it does is for messages.

        Raises:
            DriverError: It threw, or did not return in time.
        """
        future: Future[T] = Future()

        def run() -> None:
            try:
                future.set_result(work())
            except _THROWN as error:
                future.set_exception(error)

        self._jobs.put(run)
        waiting = Stopwatch()
        try:
            while not wait([future], _GLANCE_S).done:
                if waiting.read() > limit_s:
                    raise DriverError(
                        f"{self._name} did not {what} within {limit_s:.1f} s.",
                        culprits=[self._name],
                        next_step="Look at the pendant and at the network cable.",
                    )
            return future.result()
        except _THROWN as error:
            raise DriverError(
                f"{self._name} could not {what}: {error}.", culprits=[self._name]
            ) from error

    def end(self) -> None:
        """Ends the thread after the queued calls."""
        self._jobs.put(None)

    def _work(self) -> None:
        while True:
            try:
                job = self._jobs.get(timeout=self._every_s)
            except queue.Empty:
                self._idle()
                continue
            if job is None:
                return
            job()
