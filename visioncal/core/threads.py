"""Process-wide settings that several threads change temporarily, and handling of signals.

The first thread that needs a setting makes it and the last one undoes it; if each restored the
value it found, it could restore another thread's.
"""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache, wraps
from threading import Lock, RLock
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController


@contextmanager
def signals_as_interrupts(*names: str) -> Iterator[None]:
    """Runs a block in which signals raise KeyboardInterrupt, like Ctrl-C.

    By default SIGTERM, and SIGHUP of a closed terminal; signals that the system lacks are ignored.
    """
    present = [name for name in names or ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [getattr(signal, name) for name in present]
    previous = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


Given = ParamSpec("Given")
Answer = TypeVar("Answer")

# Matplotlib's settings are process-wide, too, but differ between figures: one is drawn at a time.
DRAWING = RLock()


class SharedSetting:
    """A setting that holds while any thread is within its block."""

    def __init__(self, setting: Callable[[], AbstractContextManager[object]]) -> None:
        """Takes a function whose context manager makes and undoes the setting."""
        self._make = setting
        self._made = ExitStack()
        self._lock = Lock()
        self._within = 0

    @contextmanager
    def held(self) -> Iterator[None]:
        """Holds the setting within the block."""
        with self._lock:
            if self._within == 0:
                self._made.enter_context(self._make())
            self._within += 1
        try:
            yield
        finally:
            with self._lock:
                self._within -= 1
                if self._within == 0:
                    self._made.close()


@contextmanager
def _no_current_folder() -> Iterator[None]:
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ.pop("PYTHONSAFEPATH")
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


_SAFE_PATH = SharedSetting(_no_current_folder)


def safe_path() -> AbstractContextManager[None]:
    """Python processes that start within import no module from the current folder.

    A session's folder may come from anywhere, and `multiprocessing` would import from there.
    """
    return _SAFE_PATH.held()


def one_blas_thread() -> AbstractContextManager[None]:
    """Limits BLAS to one thread: on a busy machine more make small dense solves far slower."""
    return _ONE_BLAS_THREAD.held()


def on_one_blas_thread(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Decorates a function to run within `one_blas_thread`."""

    @wraps(function)
    def limited(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        with one_blas_thread():
            return function(*args, **kwargs)

    return limited


# The search for loaded libraries takes as long as a whole fit.
_thread_pools = cache(ThreadpoolController)
_ONE_BLAS_THREAD = SharedSetting(lambda: _thread_pools().limit(limits=1))
