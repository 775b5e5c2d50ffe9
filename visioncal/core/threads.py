"""Settings of the whole process that are changed for a while, by several threads at once.

A setting is made by the first thread that needs it and undone by the last, whichever that is: each
for itself would restore what another one had set.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache, wraps
from threading import Lock, RLock
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

# Matplotlib's settings are the process's, too, but differ: figures are drawn one at a time.
DRAWING = RLock()


class SharedSetting:
    """A setting that holds while any thread is within."""

    def __init__(self, setting: Callable[[], AbstractContextManager[object]]) -> None:
        """Prepares it.

        Args:
            setting: Makes the setting on entering, and undoes it on leaving.
        """
        self._make = setting
        self._made = ExitStack()
        self._lock = Lock()
        self._within = 0

    @contextmanager
    def held(self) -> Iterator[None]:
        """Makes the setting hold within the block."""
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


def one_blas_thread() -> AbstractContextManager[None]:
    """Keeps small dense solves on one thread: on a busy machine threads make them far slower."""
    return _ONE_BLAS_THREAD.held()


def on_one_blas_thread(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Has a function run within `one_blas_thread`."""

    @wraps(function)
    def alone(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        with one_blas_thread():
            return function(*args, **kwargs)

    return alone


@cache
def _thread_pools() -> ThreadpoolController:
    # Looking for the loaded libraries takes as long as a whole fit.
    return ThreadpoolController()


_ONE_BLAS_THREAD = SharedSetting(lambda: _thread_pools().limit(limits=1))
