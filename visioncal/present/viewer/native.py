"""Shows a recording in rerun's native viewer."""

import time
from pathlib import Path
from subprocess import Popen
from threading import Thread

from rerun.experimental import ViewerClient

from visioncal.core.errors import DriverError
from visioncal.present.recording import paths
from visioncal.present.viewer.process import free_port, until_interrupted, viewer_process

# Longest wait for the recording to load, and polling interval [s].
_PATIENCE_S, _AGAIN_S = 60.0, 0.2


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
    arguments = ("--bind", "127.0.0.1", "--port", str(port), str(recording.absolute()))
    with until_interrupted(), viewer_process(*arguments) as process:
        if row is not None:
            Thread(target=_seek, args=(process, port, row), daemon=True).start()
        output, _ = process.communicate()
        if process.returncode != 0:
            last_line = output.strip().splitlines()[-1:] or ["it did not say why"]
            raise DriverError(
                f"rerun's viewer ended with status {process.returncode}: {last_line[0]}.",
                next_step="Without a display, show the recording in a browser: --web.",
            )


def _seek(process: Popen[str], port: int, row: int) -> None:
    """Goes to a view once the viewer has loaded the recording; gives up after a timeout."""
    deadline = time.monotonic() + _PATIENCE_S
    while process.poll() is None and time.monotonic() < deadline:
        try:
            viewer = ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy")
            viewer.set_time(paths.TIMELINE, sequence=row, play_state="paused")
        except (OSError, RuntimeError, ValueError):
            time.sleep(_AGAIN_S)
        else:
            return
