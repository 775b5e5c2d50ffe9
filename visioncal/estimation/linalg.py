"""Linear algebra of least squares: solving, covariance, and the spectrum of the information."""

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh, lapack

from visioncal.core.types import FloatArray, IntArray, Mask

_Floats: TypeAlias = npt.NDArray[np.floating[Any]]

# Squared pivots of a matrix of unit diagonal below which Cholesky's factor is mostly rounding.
_LEAST_PIVOT_SQ = 1e-11
# Share of the noise's variance under which a fit has taken all of it.
_VANISHED = 1e-6


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues of an information matrix scaled to a unit diagonal.

    The scaling makes them independent of the units of the parameters.

    Attributes:
        values: (n,) ascending, not negative.
        vectors: (n, n), one direction a column, in the parameters' own units, of unit length.
    """

    values: FloatArray
    vectors: FloatArray

    @property
    def ratio(self) -> float:
        """Smallest over largest eigenvalue: 0 where a direction is not determined at all."""
        return float(self.values[0] / self.values[-1]) if self.values[-1] > 0 else 0.0


def spectrum(information: FloatArray) -> Spectrum:
    """Computes the scaled spectrum of an (n, n) information matrix."""
    scale = _scale(information)
    values, vectors = _eigen(information * np.outer(scale, scale))
    directions = vectors * scale[:, None]
    return Spectrum(np.maximum(values, 0.0), directions / np.linalg.norm(directions, axis=0))


def scaled_values(information: FloatArray) -> FloatArray:
    """(..., n) eigenvalues, as `spectrum` has them, of (..., n, n) information matrices."""
    scale = _scale(information)
    values = np.linalg.eigvalsh(information * scale[..., :, None] * scale[..., None, :])
    return np.asarray(np.maximum(values, 0.0))


def covariance_from(information: FloatArray) -> FloatArray:
    """Inverts (..., n, n) information matrices, scaled first to a unit diagonal.

    A direction without information gets a large but finite variance, never a NaN; whoever asks
    for a covariance has looked at the spectrum before.
    """
    if information.ndim == 2:  # A large one by Cholesky, which takes a tenth of the time.
        root = covariance_root(information)
        return np.asarray(root @ root.T)
    values, vectors, scale = _floored(information)
    inverse = (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(inverse * scale[..., :, None] * scale[..., None, :])


def covariance_root(information: FloatArray) -> FloatArray:
    """Factors `covariance_from(information)` as (n, n) `root @ root^T`, however singular."""
    scale = _scale(information)
    factor, failed = lapack.dpotrf(information * np.outer(scale, scale), lower=1)
    if not failed and np.diag(factor).min(initial=1.0) ** 2 > _LEAST_PIVOT_SQ:
        inverse, _ = lapack.dtrtri(factor, lower=1)
        return np.asarray(scale[:, None] * np.tril(inverse).T)
    values, vectors, scale = _floored(information)
    return np.asarray(scale[:, None] * vectors / np.sqrt(values))


def _floored(information: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Eigenvalues (..., n), none of them zero, and vectors of scaled matrices, and the scales."""
    scale = _scale(information)
    values, vectors = _eigen(information * scale[..., :, None] * scale[..., None, :])
    # Of a unit diagonal, the largest is at least one, unless there is no information at all.
    floor = np.finfo(float).eps * np.maximum(values[..., -1:], 1.0)
    return np.maximum(values, floor), vectors, scale


def covariance_among(information: FloatArray, among: Mask) -> FloatArray:
    """Inverts (n, n) information on some unknowns, the others being where they are.

    Args:
        information: (n, n) on all unknowns.
        among: (n,) those that are open.

    Returns:
        (n, n), zero where an unknown is not among them.
    """
    found = np.zeros_like(information)
    places = np.ix_(among, among)
    found[places] = covariance_from(information[places])
    return found


def _eigen(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (..., n), ascending, and eigenvectors (..., n, n) of symmetric matrices."""
    # The usual way, divide and conquer, gives up on some good matrices with many eigenvalues that
    # are all but equal, as held unknowns make them; the other way is slower and does not.
    try:
        return np.linalg.eigh(matrices)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrices).all():
            raise
    size = matrices.shape[-1]
    pairs = [eigh(array, driver="evr") for array in matrices.reshape(-1, size, size)]
    values, vectors = (np.array(pair) for pair in zip(*pairs, strict=True))
    return values.reshape(matrices.shape[:-1]), vectors.reshape(matrices.shape)


def gram(left: _Floats, right: _Floats) -> FloatArray:
    """Sums `left_i^T right_i` over blocks: (m, d, p) and (m, d, q), or (m, d), to (p, q) or (p,).

    One product of tall matrices, which is many times faster than `einsum` over the blocks.
    """
    rows = left.reshape(math.prod(left.shape[:-1]), left.shape[-1])
    return np.asarray(rows.T @ right.reshape(len(rows), *right.shape[2:]))


def weighted_gram(blocks: FloatArray, weights: FloatArray) -> FloatArray:
    """(p, p) products of (m, d, p) blocks with themselves, by the (m, d) rows that have a weight.

    One product of a matrix with its own transpose, which takes half of what two matrices take.
    """
    rows = weights > 0.0
    half = np.sqrt(weights[rows])[:, None] * blocks[rows]
    return np.asarray(half.T @ half)


def damped_step(
    information: FloatArray, gradient: FloatArray, damping: FloatArray | float
) -> FloatArray:
    """Solves for Levenberg-Marquardt's step (Marquardt 1963: damping scaled by the diagonal).

    Args:
        information: (..., n, n) normal matrices.
        gradient: (..., n) gradients of half the squared error.
        damping: Share of the diagonal that is added to it, one for all or (..., 1).

    Returns:
        (..., n) steps.
    """
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    added = damping * np.maximum(diagonal, np.finfo(float).tiny) + np.finfo(float).tiny
    matrix = information + added[..., :, None] * np.eye(information.shape[-1])
    return np.asarray(-np.linalg.solve(matrix, gradient[..., None])[..., 0])


def squared_lengths(
    residuals: FloatArray, left: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Squared lengths of residuals in units of a covariance, where that has not vanished.

    A residual that alone determines a direction is zero there, and has no variance either.

    Args:
        residuals: (m, d) residuals.
        left: (m, d, d) their covariances: those of the noise, less what a fit has taken.
        covariance: (m, d, d) covariances of the noise.

    Returns:
        (m,) squared lengths, and (m,) in how many directions they were measured.
    """
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ left @ np.swapaxes(inverse, 1, 2))
    white = (np.swapaxes(vectors, 1, 2) @ inverse @ residuals[:, :, None])[:, :, 0]
    counts = values > _VANISHED
    squares = np.where(counts, white**2 / np.where(counts, values, 1.0), 0.0)
    return np.asarray(squares.sum(axis=1)), np.asarray(counts.sum(axis=1))


def _scale(information: FloatArray) -> FloatArray:
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))
