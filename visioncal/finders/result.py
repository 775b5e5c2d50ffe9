"""What a finder returns."""

from dataclasses import dataclass

from visioncal.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Seen:
    """Corners that were found: (n,) ascending ids and (n, 2) positions [px]."""

    ids: IntArray
    px: FloatArray


@dataclass(frozen=True)
class NotFound:
    """Why the target was not found, in words; `misfit` where another layout was seen instead."""

    reason: str
    misfit: bool = False
