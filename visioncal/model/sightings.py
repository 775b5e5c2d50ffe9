"""What one frame saw of another: corners in an image, a measured pose, or a measured place."""

from dataclasses import dataclass
from typing import TypeAlias

from visioncal.core.types import Corners, FloatArray


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """A pose that was measured as such: by other software (`cft_` columns) or an instrument."""

    matrix: FloatArray  # (4, 4) `seer_from_seen`.
    # Standard deviations per axis [rad], [m]; None where they are to be estimated.
    sigmas: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class MeasuredPlace:
    """A place that was measured by an instrument, or touched: nothing is known of its rotation."""

    place_m: FloatArray  # (3,) origin of the seen frame in the seer's [m].
    sigma_m: float | None = None  # Standard deviation per axis [m]; None if to be estimated.


Evidence: TypeAlias = Corners | MeasuredPose | MeasuredPlace


@dataclass(frozen=True, eq=False)
class Sighting:
    """One frame seen by another at a stop."""

    view: int  # Its row's number in views.csv.
    stop: int  # Index of the state of the cell.
    seer: str  # Frame of the camera or instrument.
    seen: str  # Frame of the board, probe or point.
    evidence: Evidence  # Corners are numbered on their own board.

    @property
    def corners(self) -> Corners | None:
        """Its corners, if it is an image."""
        return self.evidence if isinstance(self.evidence, Corners) else None

    @property
    def pair(self) -> tuple[str, str]:
        """Frames of the seer and the seen."""
        return self.seer, self.seen
