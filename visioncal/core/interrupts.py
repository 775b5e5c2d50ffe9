"""Signals that end a block as Ctrl-C does."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ended_like_ctrl_c(*names: str) -> Iterator[None]:
    """Runs a block that signals end as Ctrl-C does.

    Args:
        names: Of the signals; SIGTERM, and SIGHUP of a terminal that is closed, where left out.
            Those that the system does not have are passed over.

    Raises:
        KeyboardInterrupt: When one of them comes.
    """
    there = [name for name in names or ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [getattr(signal, name) for name in there]
    previous = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - signal's interface
    raise KeyboardInterrupt
