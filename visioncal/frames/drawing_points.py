"""Nominal points of a drawing, and their matching with measured points by name."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray
from visioncal.estimation.pointfit import PointPairs


@dataclass(frozen=True, eq=False)
class NominalPoints:
    """Nominal points of a drawing, n in all."""

    source: str  # What they were read from, for messages and for the record.
    names: tuple[str, ...]  # (n,) unique names.
    positions: FloatArray  # (n, 3) [m] in the drawing's frame.
    sigma_m: FloatArray  # (n,) standard deviation of each coordinate [m]; 0 where taken as exact.

    def beside(
        self, names: Sequence[str], measured: FloatArray, covariances: FloatArray
    ) -> PointPairs:
        """Pairs measured points with the drawn ones of the same names.

        Upper and lower case are the same where the match is unique.

        Args:
            names: (m,) which point each is; names may repeat.
            measured: (m, 3) in the base [m].
            covariances: (m, 3, 3) of their known noise [m^2].

        Raises:
            DataError: The drawing has no point of that name.
        """
        index_of = {name: at for at, name in enumerate(self.names)}
        folded = [name.casefold() for name in self.names]
        index_of |= {
            name: folded.index(name.casefold())
            for name in names
            if name not in index_of and folded.count(name.casefold()) == 1
        }
        unknown = [name for name in dict.fromkeys(names) if name not in index_of]
        if unknown:
            raise DataError(
                f"{self.source} has no point {some_of(unknown)}; it has {some_of(self.names, 20)}.",
                culprits=unknown,
                next_step=did_you_mean(unknown[0], self.names) or "Correct the points' names.",
            )
        rows = np.array([index_of[name] for name in names], dtype=np.int64)
        spare = np.setdiff1d(np.arange(len(self.names)), rows)
        return PointPairs(
            tuple(self.names[index] for index in rows),
            measured,
            covariances,
            self.positions[rows],
            self.sigma_m[rows],
            tuple(self.names[index] for index in spare),
            self.positions[spare],
        )
