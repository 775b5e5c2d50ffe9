"""Rerun's viewer as a child process, without network access beyond this machine."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress

from visioncal.core.interrupts import signals_as_interrupts

_PATIENCE_S = 5.0
# Nothing listens at the port of the discard service.
_NOWHERE = "http://127.0.0.1:9"


@contextmanager
def viewer_process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Runs rerun's viewer; leaving the block ends it with all its child processes.

    Args:
        arguments: Arguments of the `rerun` command. Its output can be read from `stdout`.

    Yields:
        The process, which leads its own process group.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env=_quiet(os.environ),
        start_new_session=True,
    )
    try:
        yield process
    finally:
        _end_group(process)


def free_port() -> int:
    """A free port of this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Runs a block that Ctrl-C or SIGTERM ends without an error."""
    with suppress(KeyboardInterrupt), signals_as_interrupts("SIGINT", "SIGTERM"):
        yield


def _quiet(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment in which the viewer sends no statistics and checks for no newer version."""
    # It sends none under continuous integration, and checks through the proxy; neither changes the
    # user's settings of rerun.
    quiet = {key: name for key, name in environment.items() if key != "FORCE_RERUN_ANALYTICS"}
    proxies = dict.fromkeys(("HTTPS_PROXY", "https_proxy", "ALL_PROXY", "all_proxy"), _NOWHERE)
    return quiet | proxies | {"CI": "1", "NO_COLOR": "1"}


def _end_group(process: subprocess.Popen[str]) -> None:
    """Ends a process and its children; rerun's command starts the viewer as a child."""
    # Both signals, as the command may have ended before its child.
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
    if process.stdout is not None:
        process.stdout.close()
