"""Components of an unknown edge that were measured by hand, as with a gauge or in a drawing."""

from dataclasses import dataclass

import numpy as np

from visioncal.types import FloatArray


@dataclass(frozen=True, eq=False)
class Measured:
    """Where an edge's origin was measured to be, along some axes of the frame that it hangs on.

    An edge moves on its right: a step v of its translation moves the origin by `R v`.

    Attributes:
        edge: 0 for x, 1 for z.
        axes: (c,) which components were measured, 0 for x.
        values_m: (c,) what was measured [m].
        sigma_m: The standard deviation of each [m].
    """

    edge: int
    axes: tuple[int, ...]
    values_m: tuple[float, ...]
    sigma_m: float

    @property
    def place(self) -> slice:
        """Where the edge's translation is among the unknowns."""
        return slice(6 * self.edge + 3, 6 * self.edge + 6)

    def slopes(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """How the components (c, 3) move with the translation of the edge's step."""
        return np.asarray((x, z)[self.edge][list(self.axes), :3])

    def away_m(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """How far (c,) the edges are from what was measured [m]."""
        return np.asarray((x, z)[self.edge][list(self.axes), 3] - np.array(self.values_m))

    def information(self, x: FloatArray, z: FloatArray, size: int) -> FloatArray:
        """Information (size, size) on the unknowns' steps."""
        found = np.zeros((size, size))
        slopes = self.slopes(x, z)
        found[self.place, self.place] = slopes.T @ slopes / self.sigma_m**2
        return found

    def pull(self, x: FloatArray, z: FloatArray, size: int) -> FloatArray:
        """Gradient (size,) of half the squared error in units of sigma."""
        found = np.zeros(size)
        found[self.place] = self.slopes(x, z).T @ self.away_m(x, z) / self.sigma_m**2
        return found

    def cost(self, x: FloatArray, z: FloatArray) -> float:
        """The squared error in units of sigma."""
        return float(np.sum((self.away_m(x, z) / self.sigma_m) ** 2))

    def sigmas_m(self, spread: FloatArray, x: FloatArray, z: FloatArray) -> FloatArray:
        """Standard deviations (c,) of the components under a covariance of the unknowns [m]."""
        slopes = self.slopes(x, z)
        block = spread[self.place, self.place]
        return np.asarray(np.sqrt(np.einsum("ci,ij,cj->c", slopes, block, slopes)))
