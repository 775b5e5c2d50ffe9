"""Shows a recording in rerun's viewer, in a window or in a browser."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen
from threading import Thread

from rerun.experimental import ViewerClient

from visioncal.core.errors import DriverError
from visioncal.present.recording import paths
from visioncal.present.viewer.process import free_port, until_interrupted, viewer_process

_HOST = "127.0.0.1"
# Longest wait for the recording to load, and polling interval [s].
_PATIENCE_S, _AGAIN_S = 60.0, 0.2
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
            viewer = ViewerClient(f"rerun+http://{_HOST}:{port}/proxy")
            viewer.set_time(paths.TIMELINE, sequence=row, play_state="paused")
        except (OSError, RuntimeError, ValueError):
            time.sleep(_AGAIN_S)
        else:
            return
