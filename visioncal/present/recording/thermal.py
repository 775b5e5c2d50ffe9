"""How the arm drifted with its temperature, view by view."""

import rerun as rr

from visioncal.present.recording import paths
from visioncal.results.arm import ViewDrift


def log_view(stream: rr.RecordingStream, drift: ViewDrift) -> None:
    """Logs how far the arm had drifted at a view."""
    stream.log(paths.DRIFT_MM, rr.Scalars(drift.drift_mm))
    stream.log(paths.RISE_K, rr.Scalars(drift.rise_k))
