"""A viewer that shows a session while it is recorded."""

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import rerun as rr
import rerun.blueprint as rrb

from visioncal.core.errors import DriverError
from visioncal.present.recording import paths
from visioncal.present.viewer.layout import image_view, space_view
from visioncal.present.viewer.native import free_port, viewer_process

_HOST = "127.0.0.1"
# Time for the viewer to listen, polling interval, and time for its window to open [s].
_PATIENCE_S, _POLL_S, _WINDOW_S = 10.0, 0.1, 1.0
# Longest wait for the last data to arrive [s].
_FLUSH_S = 2.0


@contextmanager
def live_viewer(name: str) -> Iterator[rr.RecordingStream]:
    """Opens a viewer; leaving the block closes it.

    Args:
        name: Name of the recording.

    Yields:
        The stream that it shows.

    Raises:
        DriverError: The viewer cannot be shown here.
    """
    port = free_port()
    with viewer_process("--bind", _HOST, "--port", str(port)) as process:
        deadline = time.monotonic() + _PATIENCE_S
        while process.poll() is None and time.monotonic() < deadline and not _listens(port):
            time.sleep(_POLL_S)
        # It listens before it opens its window, and exits if it cannot open one.
        time.sleep(_WINDOW_S)
        if process.poll() is not None or not _listens(port):
            raise DriverError(
                "rerun's viewer cannot be shown here; is there a display?",
                next_step="Record without --view.",
            )
        stream = rr.RecordingStream(paths.APPLICATION)
        stream.connect_grpc(f"rerun+http://{_HOST}:{port}/proxy")
        stream.send_recording_name(name)
        stream.send_blueprint(live_blueprint(), make_active=True, make_default=True)
        try:
            yield stream
        finally:
            if process.poll() is None:
                stream.flush(timeout_sec=_FLUSH_S)
            stream.disconnect()


def live_blueprint() -> rrb.Blueprint:
    """Layout of a live recording: image and cell, coverage and predicted sigma."""
    entities = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.CAMERA, paths.TARGET, paths.STOPS)
    shown = [*(f"+ {entity}/**" for entity in entities), f"- {paths.DETECTED}/**"]
    cell = space_view("Cell: views so far in blue", shown)
    image = image_view("This view", paths.IMAGE)
    coverage = image_view("What corners have reached", paths.IMAGE_COVERAGE)
    sigma = rrb.TimeSeriesView(name="Predicted sigma [mm]", origin=paths.LIVE_SIGMA)
    note = rrb.TextDocumentView(name="This view", origin=paths.LIVE_NOTE)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(image, cell, row_shares=[1, 1]),
            rrb.Vertical(coverage, sigma, note, row_shares=[2, 1, 1]),
            column_shares=[1.6, 1],
        ),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
    )


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(_POLL_S)
        return probe.connect_ex((_HOST, port)) == 0
