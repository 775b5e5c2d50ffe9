"""A recording in rerun's native viewer."""

from pathlib import Path

from visioncal.core.errors import DriverError
from visioncal.present.viewer.process import until_interrupted, viewer_process


def review_native(recording: Path) -> None:
    """Shows a recording in a window, until that is closed or Ctrl-C or SIGTERM comes.

    Args:
        recording: The `.rrd`.

    Raises:
        DriverError: The viewer cannot be shown here.
    """
    # The viewer listens to other programs, on this machine only.
    arguments = ("--bind", "127.0.0.1", "--port", "auto", str(recording.absolute()))
    with until_interrupted(), viewer_process(*arguments) as process:
        said, _ = process.communicate()
        if process.returncode != 0:
            last = said.strip().splitlines()[-1:] or ["it did not say why"]
            raise DriverError(
                f"rerun's viewer ended with status {process.returncode}: {last[0]}.",
                next_step="Without a display, show the recording in a browser: --web.",
            )
