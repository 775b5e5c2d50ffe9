"""Displacements by a lens beyond its model: a smooth field of displacements over the image.

It is a Gaussian process with a squared exponential kernel, by waves over somewhat more than the
image whose variances are the kernel's spectrum (Solin and Sarkka 2020). Its length is chosen with
its size, by the score of a fit without it (`score.best_field`). Of all waves, those combinations
are kept that corners show (Karhunen and Loeve): as functions of the image alone, they are far
fewer.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.vision.camera import project_with_jacobian

# Half waves across at most, and lengths of the field over the width that are tried.
_WAVES, LENGTHS = 16, (0.1, 0.14, 0.2, 0.28, 0.4)
# Over how many widths the waves are: at their ends they have no slope.
_WIDTHS = 1.4


@dataclass(frozen=True, eq=False)
class Field:
    """A field of one lens, of r functions along each axis of the image."""

    orders: FloatArray  # (e, 2) half waves across and down.
    width: float  # Of the image [px].
    length: float  # Of the kernel, over that width.
    sigmas: FloatArray  # (e,) standard deviations of the waves in a field of size one.
    basis: FloatArray  # (e, r) the waves of each function; a field's values have variance one.
    # (q, 2 r) intrinsics that do the same as the field's values, by which the lens is less than as
    # estimated: what matrix and distortion alone explain best is theirs. None of a stated lens,
    # which may be off by any field.
    instead: FloatArray | None = None

    @property
    def count(self) -> int:
        """The number 2 r of its values: those along x, then those along y."""
        return 2 * int(self.basis.shape[1])

    def functions(self, px: FloatArray) -> FloatArray:
        """(n, r) displacements of (n, 2) pixels along one axis, by the values of that axis [px]."""
        return np.asarray(waves(px, self.width, self.orders) @ self.basis)

    def moved(self, px: FloatArray, values: FloatArray) -> FloatArray:
        """Displacements (n, 2) of (n, 2) pixels by the field's values (2 r,) [px]."""
        return np.asarray(self.functions(px) @ values.reshape(2, -1).T)

    def variance(self, px: FloatArray) -> FloatArray:
        """(n,) of (n, 2) pixels' displacements by the functions that are not kept, at size one."""
        each = waves(px, self.width, self.orders) * self.sigmas
        return np.asarray(np.sum(each**2, axis=1) - np.sum(self.functions(px) ** 2, axis=1))

    def shown(self, px: FloatArray, least: float) -> "Field":
        """The field of functions whose squares, summed over (n, 2) corners, are above a value."""
        # Of thousands of corners, some stand for all.
        step = len(px) // 10000 + 1
        each = waves(px[::step], self.width, self.orders) * self.sigmas
        squares, vectors = np.linalg.eigh(step * each.T @ each)
        return replace(self, basis=self.sigmas[:, None] * vectors[:, squares > least])

    def orthogonal_to(self, lens: Camera, px: FloatArray) -> "Field":
        """The field orthogonal to what an estimated lens does at (n, 2) corners."""
        lens_columns, each = by_lens(lens, px), self.functions(px)
        scale = np.linalg.norm(lens_columns, axis=(0, 1))
        inner = np.einsum("nai,naj->ij", lens_columns / scale, lens_columns / scale)
        pull = np.concatenate([lens_columns[:, axis].T @ each for axis in (0, 1)], axis=1)
        instead = np.linalg.pinv(inner, hermitian=True) @ (pull / scale[:, None])
        return replace(self, instead=instead / scale[:, None])


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
        sigmas /= np.sqrt(variances @ sigmas**2)
        yield Field(orders, width, length, sigmas, np.diag(sigmas))


def by_lens(lens: Camera, px: FloatArray) -> FloatArray:
    """Derivatives (n, 2, q) of (n, 2) corners by the intrinsics, near the lens's own rays."""
    rays = np.column_stack([(px - lens.matrix[2:]) / lens.matrix[:2], np.ones(len(px))])
    return np.nan_to_num(project_with_jacobian(lens, rays).jacobian_intrinsics)
