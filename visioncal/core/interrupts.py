"""Handling of termination signals as KeyboardInterrupt."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def signals_as_interrupts(*names: str) -> Iterator[None]:
    """Runs a block in which signals raise KeyboardInterrupt, like Ctrl-C.

    By default SIGTERM, and SIGHUP of a closed terminal; signals that the system lacks are ignored.
    """
    present = [name for name in names or ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [getattr(signal, name) for name in present]
    previous = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - signal's interface
    raise KeyboardInterrupt
