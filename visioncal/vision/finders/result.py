"""Results of detection."""

from dataclasses import dataclass

from visioncal.core.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Detected corners."""

    ids: IntArray  # (n,) corner ids, ascending.
    px: FloatArray  # (n, 2) positions [px].
    # (n,) accuracy relative to the usual one, as the ratio of standard deviations; None if all are
    # usual.
    weights: FloatArray | None = None
    # Edge width as a Gaussian's sigma, in the direction of the wider edges [px]; None if not
    # measured.
    blur_px: float | None = None


@dataclass(frozen=True)
class NotFound:
    """Why the target was not found, in words; `misfit` if another layout was seen instead."""

    reason: str
    misfit: bool = False
