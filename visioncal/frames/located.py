"""A place in the base with its uncertainty: by source, as an ellipsoid, and as a ball."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.types import FloatArray

# A direction with less than this share of the largest variance is exact: the normal of a declared
# plane. A point is as far off it as rounding takes it [m].
_EXACT_SHARE, _ROUNDING_M = 1e-12, 1e-9


@dataclass(frozen=True, eq=False)
class Located:
    """A place in the base, and how well it is known.

    Attributes:
        p_base: (3,) [m].
        parts: (3, 3) covariance by source [m^2]: `pixels`, `calibration` (the camera's transform
            and its lens together), `robot` (at this stop), `arm`, `plane`, `target`, `focus` (a
            pixel's, by the change of the focal length at this view).
        freedom: Degrees of freedom of the noise's levels that all of it rests on.
        warnings: What to know before a robot is sent there, in sentences.
    """

    p_base: FloatArray
    parts: Mapping[str, FloatArray]
    freedom: float
    warnings: tuple[str, ...] = ()

    @cached_property
    def covariance(self) -> FloatArray:
        """(3, 3) of the place [m^2]: the sources are independent, and add up."""
        return np.asarray(np.sum(list(self.parts.values()), axis=0))

    @property
    def sigma_mm(self) -> FloatArray:
        """(3,) standard deviations along the base's axes [mm]."""
        return np.asarray(1e3 * np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def budget_mm(self) -> dict[str, float]:
        """Standard deviation of the place by source, and their `total` [mm]."""
        every = {**self.parts, "total": self.covariance}
        squares = {name: max(np.trace(covariance), 0.0) for name, covariance in every.items()}
        return {name: float(1e3 * np.sqrt(square)) for name, square in squares.items()}

    @property
    def largest(self) -> str:
        """The source that most of the uncertainty is from."""
        return max(self.parts, key=lambda name: float(np.trace(self.parts[name])))

    @property
    def radius95_mm(self) -> float:
        """Radius of the ball around `p_base` that holds the true place in 95 % of cases [mm].

        The squared distance is a sum of squares with the covariance's eigenvalues for weights:
        approximately chi-square (Box 1954, section 3), and F with the noise's levels estimated.
        """
        values = np.maximum(np.linalg.eigvalsh(self.covariance), 0.0)
        total = float(values.sum())
        if not total > 0.0:
            return 0.0
        count = total**2 / float(np.sum(values**2))
        return float(1e3 * np.sqrt(total * _quantile95(count, self.freedom)))

    def holds(self, p_base: FloatArray) -> bool:
        """Whether the 95 % region, an ellipsoid around the place, holds a point.

        Its semi-axes are the covariance's, times the root of `n F(n, freedom)`'s 95 % quantile over
        the n directions that are uncertain: a point of an exactly known plane has two.

        Args:
            p_base: (3,) [m].
        """
        values, vectors = np.linalg.eigh(self.covariance)
        away = vectors.T @ (p_base - self.p_base)
        is_open = values > _EXACT_SHARE * max(float(values[-1]), 0.0)
        if np.any(np.abs(away[~is_open]) > _ROUNDING_M):
            return False
        count = int(is_open.sum())
        if not count:
            return True
        squared = float(np.sum(away[is_open] ** 2 / values[is_open]))
        return squared <= count * _quantile95(count, self.freedom)


def _quantile95(count: float, freedom: float) -> float:
    """Of the mean of so many squared errors, in units of a variance with that much freedom."""
    # Beyond, F does not differ from chi-square, and its series lose digits.
    return float(f_limit(0.05, count, min(freedom, 1e6)))
