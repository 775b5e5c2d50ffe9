"""Modes of a smooth field over the image: a Gaussian process with a squared exponential kernel."""

from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray

# Share of the field's variance that its modes keep.
_KEPT = 0.999


@dataclass(frozen=True, eq=False)
class FieldModes:
    """Modes of a field along one axis of the image at n corners; those along the other are equal.

    Each is a product of one by x and one by y: all together are far larger than these.
    """

    by_x: FloatArray  # (n, a) modes by x, times the size of the field at each corner.
    by_y: FloatArray  # (n, b) modes by y.
    pairs: tuple[IntArray, IntArray]  # (e,) indices of each mode's two factors.

    @classmethod
    def none(cls, corners: int) -> Self:
        """No modes at n corners."""
        nothing = np.zeros((corners, 0))
        return cls(nothing, nothing, (np.zeros(0, dtype=int), np.zeros(0, dtype=int)))

    @property
    def count(self) -> int:
        """The number of modes e."""
        return len(self.pairs[0])

    def at(self, corners: slice) -> FloatArray:
        """(m, e) displacements of some corners for coefficients of variance one."""
        of_x, of_y = self.pairs
        modes = self.by_x[corners][:, of_x]
        modes *= self.by_y[corners][:, of_y]
        return np.asarray(modes)

    def displaced(self, values: FloatArray) -> FloatArray:
        """(n, 2) displacements by (2 e,) coefficients of both axes."""
        table = np.zeros((2, self.by_x.shape[1], self.by_y.shape[1]))
        table[:, *self.pairs] = values.reshape(2, -1)
        return np.stack([np.sum(self.by_x @ by_modes * self.by_y, axis=1) for by_modes in table], 1)


def field_modes(
    px: FloatArray, resolution: tuple[int, int], length: float, sizes: FloatArray | float = 1.0
) -> FieldModes:
    """Modes of a field.

    Args:
        px: (n, 2) corners, as predicted [px].
        resolution: (width, height) of the image [px].
        length: The field's length, as a share of the width.
        sizes: (n,) size of the field at each corner.
    """
    scale = length * resolution[0]
    (by_x, size_x), (by_y, size_y) = (
        _modes(at, extent / scale) for at, extent in zip(px.T / scale, resolution, strict=True)
    )
    variances = np.outer(size_x, size_y)
    order = np.argsort(-variances, axis=None, kind="stable")
    enough = int(np.searchsorted(np.cumsum(variances.ravel()[order]), _KEPT * variances.sum())) + 1
    of_x, of_y = np.unravel_index(order[:enough], variances.shape)
    return FieldModes(by_x * np.reshape(sizes, (-1, 1)), by_y, (of_x, of_y))


def _modes(at: FloatArray, extent: float) -> tuple[FloatArray, FloatArray]:
    """Modes along one axis at (n,) positions in units of the length, and their variances."""
    grid, vectors, values = _grid_modes(extent)
    kernel = at[:, None] - grid
    kernel *= kernel
    kernel *= -0.5
    return np.exp(kernel, out=kernel) @ (vectors / np.sqrt(values)), values / len(grid)


@cache
def _grid_modes(extent: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    # Grid points per axis.
    grid = np.linspace(0.0, extent, 64)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (grid[:, None] - grid) ** 2))
    kept = values > (1.0 - _KEPT) ** 2 * values[-1]
    # Fixed signs: stored coefficients are of the same modes on any machine.
    return grid, vectors[:, kept] * np.sign(vectors[0, kept]), values[kept]
