"""Points as a drawing has them, and which of them were measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray
from visioncal.estimation.pointfit import PointPairs


@dataclass(frozen=True, eq=False)
class NominalPoints:
    """Points as a drawing has them, n in all.

    Attributes:
        source: What they were read from, for messages and for the record.
        names: (n,) their names, each once.
        positions: (n, 3) [m] in the drawing's frame.
        sigma_m: (n,) how well each is known [m]; 0 where the drawing is taken as exact.
    """

    source: str
    names: tuple[str, ...]
    positions: FloatArray
    sigma_m: FloatArray

    def beside(
        self, names: Sequence[str], measured: FloatArray, covariances: FloatArray
    ) -> PointPairs:
        """Lays measured points beside the drawn ones of the same names.

        Letters count as alike in capitals and small where that leaves no doubt.

        Args:
            names: (m,) which point each is; one may be there several times.
            measured: (m, 3) in the base [m].
            covariances: (m, 3, 3) what is known of their noise [m^2].

        Raises:
            DataError: The drawing has no point of that name; near ones are named.
        """
        places = {name: at for at, name in enumerate(self.names)}
        folded = [name.casefold() for name in self.names]
        places |= {
            name: folded.index(name.casefold())
            for name in names
            if name not in places and folded.count(name.casefold()) == 1
        }
        unknown = [name for name in dict.fromkeys(names) if name not in places]
        if unknown:
            raise DataError(
                f"{self.source} has no point {some_of(unknown)}; it has {some_of(self.names, 20)}.",
                culprits=unknown,
                next_step=did_you_mean(unknown[0], self.names) or "Correct the points' names.",
            )
        rows = np.array([places[name] for name in names], dtype=np.int64)
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
