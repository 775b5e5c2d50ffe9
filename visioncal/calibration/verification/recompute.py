"""Reproducibility of a result from its recording."""

from dataclasses import dataclass

from visioncal.calibration.pipeline import calibrate
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Progress
from visioncal.results import Calibration, to_document
from visioncal.session import Session

# Computed sections; the others state when, by which version, and in which words.
_NUMBERS = (
    "transforms",
    "joint_covariance",
    "camera",
    "cameras",
    "noise",
    "views",
    "rms",
    "validation",
)


@dataclass(frozen=True)
class Recomputed:
    """Result of recomputing a calibration.

    Attributes:
        is_same: Whether all numbers are the same, bit for bit.
        words: The comparison in a sentence, with the differences of the transforms.
    """

    is_same: bool
    words: str


def recompute(
    calibration: Calibration, session: Session, *, progress: Progress | None = None
) -> Recomputed:
    """Calibrates a recorded session once more and compares the numbers.

    Args:
        calibration: The result.
        session: Its recording.
        progress: Called with the progress of long work.

    Raises:
        VisioncalError: The recording cannot be calibrated.
    """
    again = calibrate(session, progress=progress)
    before, after = to_document(calibration), to_document(again)
    differing = [number for number in _NUMBERS if before.get(number) != after.get(number)]
    if not differing:
        return Recomputed(True, "Recomputed from the recording: the same numbers, bit for bit.")
    moved = [
        f"{name} by {mm_and_deg(mm, deg)} (sigma {figure(edge.sigma_mm)} mm)"
        for name, edge in calibration.edges.items()
        if name in again.edges
        for mm, deg in [pose_difference(edge.matrix, again.edges[name].matrix)]
    ]
    return Recomputed(
        False,
        f"Recomputed from the recording, {', '.join(differing)} differ: {'; '.join(moved)}. Other "
        "versions or options (--solver, --level, --dense) give other numbers.",
    )
