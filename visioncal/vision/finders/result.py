"""What a finder returns."""

from dataclasses import dataclass

from visioncal.core.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Corners that were found.

    Attributes:
        ids: (n,) ascending.
        px: (n, 2) positions [px].
        weights: (n,) by how much more than usual each is known, as the ratio of standard
            deviations; None where all are as usual.
        blur_px: Width of the edges, as a Gaussian's sigma, in the direction in which they are wider
            [px]; None where it is not measured.
    """

    ids: IntArray
    px: FloatArray
    weights: FloatArray | None = None
    blur_px: float | None = None


@dataclass(frozen=True)
class NotFound:
    """Why the target was not found, in words; `misfit` where another layout was seen instead."""

    reason: str
    misfit: bool = False
