"""Shows a recording in rerun's viewer, in a window or in a browser: a process of its own.

The viewer has no network access beyond this machine.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import Popen
from threading import Thread

from rerun import experimental

from visioncal.core.errors import DriverError
from visioncal.core.threads import signals_as_interrupts
from visioncal.present.recording import paths

_HOST = "127.0.0.1"
# Longest wait for the recording to load, and polling interval [s].
_PATIENCE_S = 60.0
# Nothing listens at the port of the discard service.
_NOWHERE = "http://127.0.0.1:9"
_SERVING = re.compile(rf"connect at (http://{re.escape(_HOST)}:\d+\S*)")


def review_native(recording: Path, row: int | None = None) -> None:
    """Shows a recording in a window, until it is closed or by Ctrl-C or SIGTERM.

    Args:
        recording: The `.rrd`.
        row: Row of the view to open it at; None for the first.

    Raises:
        DriverError: The viewer cannot be shown here.
    """
    # The viewer listens to other programs, on this machine only.
    port = free_port()
    arguments = ("--bind", _HOST, "--port", str(port), str(recording.absolute()))
    with until_interrupted(), viewer_process(*arguments) as process:
        if row is not None:
            Thread(target=_seek, args=(process, port, row), daemon=True).start()
        output, _ = process.communicate()
        if process.returncode != 0:
            raise _ended_error(process, output, "Without a display, show it in a browser: --web.")


def review_web(recording: Path, opened: Callable[[str], None]) -> None:
    """Serves a recording by rerun's own server to this machine, until Ctrl-C or SIGTERM.

    Args:
        recording: The `.rrd`.
        opened: Called with the page's URL once it is available.

    Raises:
        DriverError: Rerun's command does not serve its web viewer.
    """
    ports = ("--port", str(free_port()), "--web-viewer-port", "0")
    arguments = ("--serve-web", "--bind", _HOST, *ports, str(recording.absolute()))
    with until_interrupted(), viewer_process(*arguments) as process:
        output = ""
        for line in process.stdout or ():
            output += line
            if serving := _SERVING.search(line):
                opened(serving[1])
        process.wait()
        raise _ended_error(process, output, "Leave out --web for a window.")


def _ended_error(process: Popen[str], output: str, step: str) -> DriverError:
    last_line = output.strip().splitlines()[-1:] or ["it did not say why"]
    return DriverError(
        f"rerun's viewer ended with status {process.returncode}: {last_line[0]}.", next_step=step
    )


def _seek(process: Popen[str], port: int, row: int) -> None:
    """Goes to a view once the viewer has loaded the recording; gives up after a timeout."""
    deadline = time.monotonic() + _PATIENCE_S
    while process.poll() is None and time.monotonic() < deadline:
        try:
            viewer = experimental.ViewerClient(f"rerun+http://{_HOST}:{port}/proxy")
            viewer.set_time(paths.TIMELINE, sequence=row, play_state="paused")
        except (OSError, RuntimeError, ValueError):
            time.sleep(0.2)
        else:
            return


@contextmanager
def viewer_process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Runs rerun's viewer; leaving the block ends it with all its child processes.

    Args:
        arguments: Arguments of the `rerun` command. Its output can be read from `stdout`.

    Yields:
        The process, which leads its own process group (on Windows: its tree of processes).
    """
    # It sends no statistics under continuous integration, and checks for a newer version through
    # the proxy; neither changes the user's settings of rerun.
    quiet = {key: name for key, name in os.environ.items() if key != "FORCE_RERUN_ANALYTICS"}
    proxies = dict.fromkeys(("HTTPS_PROXY", "https_proxy", "ALL_PROXY", "all_proxy"), _NOWHERE)
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "rerun_cli", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env=quiet | proxies | {"CI": "1", "NO_COLOR": "1"},
        start_new_session=True,
    )
    try:
        yield process
    finally:
        # Rerun's command starts the viewer as a child, and may have ended before it.
        if sys.platform == "win32":
            ending = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
            subprocess.run(ending, check=False, capture_output=True)
            process.wait()
        else:
            for number in (signal.SIGTERM, signal.SIGKILL):
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(5.0)
        if process.stdout is not None:
            process.stdout.close()


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
