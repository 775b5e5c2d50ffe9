"""Signals that end a program, as Ctrl-C does."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ended_like_ctrl_c() -> Iterator[None]:
    """Runs a block that SIGTERM, and a terminal that is closed, end as Ctrl-C does.

    Raises:
        KeyboardInterrupt: When one of them comes.
    """
    names = [it for it in ("SIGTERM", "SIGHUP") if hasattr(signal, it)]
    numbers = [getattr(signal, it) for it in names]
    previous = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - signal's interface
    raise KeyboardInterrupt
