"""Stdout and stderr of a command, behind which a disk may be full or a reader gone."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO, cast

from visioncal.core.errors import DataError

# As a shell reports a program that SIGPIPE ended.
_EXIT_BROKEN_PIPE = 128 + 13


@contextmanager
def guarded_streams() -> Iterator[None]:
    """Runs a command whose streams may fail.

    Messages that cannot be written are lost, and the command goes on: its result is what counts. A
    result that cannot be written to stdout ends it: with one message on a full disk, and without a
    word where the reader has had enough.

    Raises:
        SystemExit: Stdout failed.
    """
    messages, results = _guarded(sys.stderr, lambda _: None), _guarded(sys.stdout, _end)
    with redirect_stderr(messages), redirect_stdout(results):
        yield


def _end(error: OSError) -> None:
    if isinstance(error, BrokenPipeError):
        raise SystemExit(_EXIT_BROKEN_PIPE) from error
    # A console takes longer to import than `--version` takes.
    from visioncal.cli.console import EXIT_NO_RESULT, report_error

    failure = DataError(
        f"stdout cannot be written: {error.strerror or error}.",
        culprits=["stdout"],
        next_step="Write it to a file where there is room.",
    )
    report_error(failure, as_json=False)
    raise SystemExit(EXIT_NO_RESULT) from error


def _guarded(stream: TextIO | None, failed: Callable[[OSError], None]) -> TextIO | None:
    # There is none where it was closed before the program began.
    return None if stream is None else cast(TextIO, _Guarded(stream, failed))


class _Guarded:
    """A text stream that goes nowhere once it has failed."""

    def __init__(self, stream: TextIO, failed: Callable[[OSError], None]) -> None:
        self._stream = stream
        self._failed = failed

    def write(self, text: str) -> int:
        """Writes a text; that of a stream that has failed is lost."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Hands on what was written."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        # What is left in the buffer would fail once more, without a word, when Python ends.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        self._failed(error)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)
