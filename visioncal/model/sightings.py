"""Sightings of one frame by another: corners in an image, a measured pose, or a measured place."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from visioncal.core.transforms import pose_difference
from visioncal.core.types import Corners, FloatArray
from visioncal.session.observations import APART_DEG, APART_MM, APART_PX


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """A pose that was measured as such: by other software (`cft_` columns) or an instrument."""

    matrix: FloatArray  # (4, 4) `seer_from_seen`.
    # Standard deviations per axis [rad], [m]: None of what is to be estimated, infinite of what was
    # not measured.
    sigmas: tuple[float | None, float | None] = (None, None)

    @property
    def is_of_board(self) -> bool:
        """Whether a program found it in an image, by the board's stated size."""
        return self.sigmas == (None, None)


@dataclass(frozen=True, eq=False)
class MeasuredPlace:
    """A place that was measured by an instrument: nothing is known of its rotation.

    Of a point that a tool's tip touched, it is the origin of the tip's own frame.
    """

    place_m: FloatArray  # (3,) origin of the seen frame in the seer's [m].
    sigma_m: float | None = None  # Standard deviation per axis [m]; None if to be estimated.
    axes: tuple[int, ...] = (0, 1, 2)  # Of the seer's axes, those along which it was measured.


Evidence: TypeAlias = Corners | MeasuredPose | MeasuredPlace


def is_copy(one: Evidence, other: Evidence, *, is_anew: bool) -> bool:
    """Whether two pieces of evidence of one stop are the same reading.

    Poses that a program found in images differ by more, unless `is_anew` is stated: a time of its
    own.
    """
    if isinstance(one, Corners) and isinstance(other, Corners):
        same = np.array_equal(one.ids, other.ids)
        return same and bool(np.abs(one.px - other.px).max(initial=0.0) < APART_PX)
    if isinstance(one, MeasuredPose) and isinstance(other, MeasuredPose):
        mm, deg = pose_difference(one.matrix, other.matrix)
        is_near = one.is_of_board and not is_anew and mm < APART_MM and deg < APART_DEG
        return is_near or np.array_equal(one.matrix, other.matrix)
    if isinstance(one, MeasuredPlace) and isinstance(other, MeasuredPlace):
        return np.array_equal(one.place_m, other.place_m)
    return False


@dataclass(frozen=True, eq=False)
class Sighting:
    """One frame seen by another at a stop."""

    view: int  # Its row's number in views.csv; below 0 of what session.toml states of two frames.
    stop: int  # Index of the state of the cell.
    seer: str  # Frame of the camera or instrument.
    seen: str  # Frame of the board, probe or point.
    evidence: Evidence  # Corners are numbered on their own board.
    is_held: bool = False  # Whether it is predicted only: no fit uses it.

    @property
    def is_stated(self) -> bool:
        """Whether the sighting is a prior of where one frame is in another."""
        return self.view < 0

    @property
    def corners(self) -> Corners | None:
        """Corners of the image; None for other sightings."""
        return self.evidence if isinstance(self.evidence, Corners) else None

    @property
    def directions(self) -> int:
        """Number of the six directions of a pose that the sighting determines."""
        if isinstance(self.evidence, MeasuredPlace):
            return len(self.evidence.axes)
        if isinstance(self.evidence, MeasuredPose):
            return 3 * sum(sigma is None or sigma < np.inf for sigma in self.evidence.sigmas)
        return 6

    @property
    def pair(self) -> tuple[str, str]:
        """Frames of the seer and the seen."""
        return self.seer, self.seen
