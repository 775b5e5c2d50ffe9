"""A place that a camera located, with its covariance by source."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.prediction import sigmas_of, total_of
from visioncal.core.quantiles import f_limit
from visioncal.core.types import FloatArray


@dataclass(frozen=True, eq=False)
class Located:
    """Position in the base with its covariance."""

    p_base: FloatArray  # (3,) [m].
    # (3, 3) covariance by source [m^2]: `pixels`, `calibration` (the camera's transform and its
    # lens and depth together), `robot` (at this stop), `arm`, `plane`, `depth` (its noise),
    # `target`, `focus` (a pixel's, by the
    # change of the focal length at this view).
    parts: Mapping[str, FloatArray]
    freedom: float  # Effective degrees of freedom of the covariance.
    warnings: tuple[str, ...] = ()  # Sentences to read before a robot is sent there.

    @cached_property
    def covariance(self) -> FloatArray:
        """(3, 3) sum of the independent parts [m^2]."""
        return total_of(self.parts)

    @property
    def sigma_mm(self) -> FloatArray:
        """(3,) standard deviations along the base's axes [mm]."""
        return np.asarray(1e3 * np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def budget_mm(self) -> dict[str, float]:
        """Standard deviation by source, and their `total` [mm]."""
        return sigmas_of(self.parts)

    @property
    def largest(self) -> str:
        """Source of the largest variance."""
        return max(self.parts, key=lambda name: float(np.trace(self.parts[name])))

    @property
    def radius95_mm(self) -> float:
        """Radius of the ball around `p_base` that holds the true position in 95 % of cases [mm].

        The squared distance is a sum of squares weighted by the covariance's eigenvalues:
        approximately chi-square (Box 1954, section 3), or F where noise levels are estimated.
        """
        values = np.maximum(np.linalg.eigvalsh(self.covariance), 0.0)
        total = float(values.sum())
        if not total > 0.0:
            return 0.0
        count = total**2 / float(np.sum(values**2))
        # Beyond the limit, F does not differ from chi-square, and its series lose digits.
        return float(1e3 * np.sqrt(total * f_limit(0.05, count, min(self.freedom, 1e6))))
