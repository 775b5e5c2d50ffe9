"""Predicted and wished accuracy of a result."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.live.planning.information import WEAK_SIGMA

# A sigma above this comes from the weak prior alone: no data determine it [rad or m].
OPEN_SIGMA = 0.25 * WEAK_SIGMA


@dataclass(frozen=True)
class Wish:
    """Wished accuracy, as standard deviations; None where that does not matter."""

    mm: float | None = None  # Of the position [mm].
    deg: float | None = None  # Of the rotation [deg].

    def __post_init__(self) -> None:
        for name in ("mm", "deg"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise DataError(
                    f"the wished accuracy is {value} {name}; a number above zero is needed.",
                    culprits=[f"wish_{name}"],
                )


@dataclass(frozen=True)
class Accuracy:
    """Predicted standard deviations of position and rotation, as root mean squares over worlds."""

    mm: float
    deg: float

    @classmethod
    def of(cls, place_m2: float, turn_rad2: float) -> "Accuracy":
        """The accuracy from the sums of the variances of all axes [m^2], [rad^2]."""
        return cls(1e3 * float(np.sqrt(place_m2)), float(np.rad2deg(np.sqrt(turn_rad2))))

    @property
    def is_open(self) -> bool:
        """Whether a direction is undetermined; the figures are then meaningless."""
        return self.mm > 1e3 * OPEN_SIGMA or self.deg > np.rad2deg(OPEN_SIGMA)

    def meets(self, wish: Wish) -> bool:
        """Whether it is at least as good as wished."""
        return (wish.mm is None or self.mm <= wish.mm) and (
            wish.deg is None or self.deg <= wish.deg
        )
