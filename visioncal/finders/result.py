"""What a finder returns."""

from dataclasses import dataclass

from visioncal.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Seen:
    """Corners that were found.

    Attributes:
        ids: (n,) ascending.
        px: (n, 2) positions [px].
        weights: (n,) by how much more than usual each is known, as the ratio of standard
            deviations; None where all are as usual.
    """

    ids: IntArray
    px: FloatArray
    weights: FloatArray | None = None


@dataclass(frozen=True)
class NotFound:
    """Why the target was not found, in words; `misfit` where another layout was seen instead."""

    reason: str
    misfit: bool = False
