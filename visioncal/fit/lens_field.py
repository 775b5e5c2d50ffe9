"""What a lens does beyond its model: a smooth field of displacements over the image.

It is a Gaussian process with a squared exponential kernel, by waves over somewhat more than the
image whose variances are the kernel's spectrum (Solin and Sarkka 2020). Its length is chosen with
its size, by the score of a fit without it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.vision.camera import project_with_jacobian

# Half waves across at most, and lengths of the field over the width that are tried.
_WAVES, LENGTHS = 16, (0.12, 0.18, 0.27, 0.4)
# Over how many widths the waves are: at their ends they have no slope.
_WIDTHS = 1.4


@dataclass(frozen=True, eq=False)
class Field:
    """A field of one lens, with e waves an axis."""

    orders: FloatArray  # (e, 2) half waves across and down.
    width: float  # Of the image [px].
    sigmas: FloatArray  # (e,) standard deviations of the waves in a field of size one.
    # What a lens of which nothing is stated does instead: its model, and (q, 2 e) intrinsics by the
    # field's values. None of a stated lens, which may be off by any field.
    instead: tuple[Camera, FloatArray] | None = None

    def at(self, px: FloatArray) -> FloatArray:
        """Displacements (n, 2, 2 e) of (n, 2) pixels by coefficients of variance one [px]."""
        each = waves(px, self.width, self.orders) * self.sigmas
        count = len(self.orders)
        found = np.zeros((len(px), 2, 2 * count))
        found[:, 0, :count], found[:, 1, count:] = each, each
        if self.instead is not None:
            lens, intrinsics = self.instead
            found -= by_lens(lens, px) @ intrinsics
        return found

    def above(self, least: float) -> "Field":
        """The field without the waves whose standard deviations are below a value."""
        kept = self.sigmas > least
        return replace(self, orders=self.orders[kept], sigmas=self.sigmas[kept])

    def beside(self, lens: Camera, px: FloatArray) -> "Field":
        """The field orthogonal to what an estimated lens does at (n, 2) corners."""
        own = by_lens(lens, px).reshape(2 * len(px), -1)
        scale = np.linalg.norm(own, axis=0)
        flat = self.at(px).reshape(2 * len(px), -1)
        instead = np.linalg.lstsq(own / scale, flat, rcond=None)[0] / scale[:, None]
        return replace(self, instead=(lens, instead))


def orders_of_waves() -> FloatArray:
    """(e, 2) half waves of a field."""
    across, down = np.meshgrid(np.arange(_WAVES + 1), np.arange(_WAVES + 1), indexing="ij")
    orders = np.column_stack([across.ravel(), down.ravel()])
    squares = np.sum(orders**2, axis=1)
    return np.asarray(orders[squares <= _WAVES**2], dtype=float)


def waves(px: FloatArray, width: float, orders: FloatArray) -> FloatArray:
    """(n, e) waves at (n, 2) pixels."""
    places = (px / width + (_WIDTHS - 1.0) / 2.0) / _WIDTHS
    tables = np.cos(np.pi * places[:, :, None] * np.arange(_WAVES + 1))
    of = orders.astype(np.int64)
    return np.asarray(tables[:, 0][:, of[:, 0]] * tables[:, 1][:, of[:, 1]])


def fields_of_lengths(
    width: float, px: FloatArray, lengths: Sequence[float] = LENGTHS
) -> Iterator[Field]:
    """Fields of some lengths, whose mean variance at (n, 2) corners is that of their size."""
    orders = orders_of_waves()
    # Of thousands of corners, some have the mean of all.
    variances = np.mean(waves(px[:: len(px) // 4000 + 1], width, orders) ** 2, axis=0)
    for length in lengths:
        sigmas = np.exp(-0.25 * np.sum(orders**2, axis=1) * (np.pi * length / _WIDTHS) ** 2)
        # A wave has half of the mean square of a constant.
        sigmas *= np.sqrt(0.5) ** np.sum(orders == 0, axis=1)
        yield Field(orders, width, sigmas / np.sqrt(variances @ sigmas**2))


def by_lens(lens: Camera, px: FloatArray) -> FloatArray:
    """Derivatives (n, 2, q) of (n, 2) corners by the intrinsics, near the lens's own rays."""
    rays = np.column_stack([(px - lens.matrix[2:]) / lens.matrix[:2], np.ones(len(px))])
    return np.nan_to_num(project_with_jacobian(lens, rays).jacobian_intrinsics)
