"""A calibration against the truth of a simulated cell."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import invert, log, pose_difference
from visioncal.core.types import FloatArray
from visioncal.results import Calibration

# One rehearsal in a thousand errs by more although nothing is wrong, with sigmas that much larger:
# corners of one board err alike by hundredths of a pixel and joints rest beside their encoders,
# which a covariance of independent noise counts for too little.
_CHANCE, _LARGER = 1e-3, 1.5


@dataclass(frozen=True)
class EdgeError:
    """How far an edge is from the truth, beside what the calibration says of it.

    Attributes:
        mm: Its place [mm].
        deg: Its rotation [deg].
        sigma_mm: The calibration's sigma [mm].
        sigma_deg: Likewise [deg].
    """

    mm: float
    deg: float
    sigma_mm: float
    sigma_deg: float


@dataclass(frozen=True)
class Explained:
    """Whether the errors of all edges together are what their covariance lets expect.

    Attributes:
        chi_square: Their squared length in sigmas.
        freedom: Of how many numbers.
        limit: The most that is believed.
    """

    chi_square: float
    freedom: int
    limit: float

    @property
    def passed(self) -> bool:
        """Whether they are believed."""
        return self.chi_square <= self.limit


def edge_errors(
    calibration: Calibration, transforms: Mapping[str, FloatArray]
) -> dict[str, EdgeError]:
    """How far each edge is from its truth.

    Args:
        calibration: The result.
        transforms: (4, 4) true edges by name.
    """
    found = {}
    for name, edge in calibration.edges.items():
        mm, deg = pose_difference(transforms[name], edge.matrix)
        found[name] = EdgeError(mm, deg, edge.sigma_mm, edge.sigma_deg)
    return found


def explained(calibration: Calibration, transforms: Mapping[str, FloatArray]) -> Explained:
    """Weighs the errors of all edges by their joint covariance.

    Args:
        calibration: The result.
        transforms: (4, 4) true edges by name.
    """
    away = np.concatenate(
        [log(invert(transforms[it]) @ edge.matrix) for it, edge in calibration.edges.items()]
    )
    squared = float(away @ np.linalg.solve(calibration.joint_covariance, away))
    return Explained(squared, away.size, _LARGER**2 * float(chi2_limit(_CHANCE, away.size)))
