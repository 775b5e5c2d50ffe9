"""Linear algebra of least squares: solving, covariance, and the spectrum of the information."""

import math
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import blas, eigh, lapack

from visioncal.core.types import FloatArray, IntArray, Mask

_Floats: TypeAlias = npt.NDArray[np.floating[Any]]

# Share of a variance, or of an information, below which what is left is rounding.
ROUNDING = 1e-6
# Bounds of standard deviations that are estimated, in units of the residuals [rad and m].
LEAST_SIGMA, MOST_SIGMA = 1e-10, 1e2
# Share of the largest eigenvalue below which a direction is undetermined.
NULL_SHARE = 1e-8


def eigenvalue_shares(information: FloatArray) -> FloatArray:
    """Eigenvalues (n,), ascending, of a matrix scaled to a unit diagonal, over the largest.

    The scaling makes them independent of the units of the parameters.
    """
    scale = _scale(information)
    values = np.maximum(_eigen(information * np.outer(scale, scale))[0], 0.0)
    return np.asarray(values / max(values[-1], np.finfo(float).tiny))


def covariance_from(information: FloatArray) -> FloatArray:
    """Inverts (..., n, n) information matrices after scaling them to a unit diagonal.

    A direction without information gets a large but finite variance, never a NaN; callers check
    the spectrum first.
    """
    if information.ndim == 2:  # Cholesky takes a tenth of the time of an eigendecomposition.
        root = covariance_root(information)
        return np.asarray(root @ root.T)
    values, vectors, scale = _floored(information)
    inverse = (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(inverse * scale[..., :, None] * scale[..., None, :])


def covariance_root(information: FloatArray) -> FloatArray:
    """Factors `covariance_from(information)` as (n, n) `root @ root^T`, even if singular."""
    scale = _scale(information)
    factor, failed = lapack.dpotrf(information * np.outer(scale, scale), lower=1)
    # With smaller pivots of a unit-diagonal matrix the factor is mostly rounding.
    if not failed and np.diag(factor).min(initial=1.0) ** 2 > 1e-11:
        inverse, _ = lapack.dtrtri(factor, lower=1)
        return np.asarray(scale[:, None] * np.tril(inverse).T)
    values, vectors, scale = _floored(information)
    return np.asarray(scale[:, None] * vectors / np.sqrt(values))


def times_root(rows: FloatArray, root: FloatArray) -> FloatArray:
    """(u, d, n) product of rows with a `covariance_root` (n, n)."""
    flat = rows.reshape(-1, len(root))
    if np.tril(root, -1).any():
        return np.asarray((flat @ root).reshape(rows.shape))
    # Half of the work for a triangular root.
    return np.asarray(blas.dtrmm(1.0, root.T, flat.T, lower=1).T.reshape(rows.shape))


def inverse_roots(covariance: FloatArray) -> FloatArray:
    """(u, d, d) whitening `w` with `w covariance w^T = 1` of (u, d, d), even if singular."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    except np.linalg.LinAlgError:
        values, vectors, scale = _floored(covariance)
        return np.swapaxes(scale[..., :, None] * vectors / np.sqrt(values)[..., None, :], 1, 2)


def _floored(information: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positive eigenvalues (..., n) and eigenvectors of the scaled matrices, and the scales."""
    scale = _scale(information)
    values, vectors = _eigen(information * scale[..., :, None] * scale[..., None, :])
    # The largest eigenvalue is at least one for a unit diagonal, unless there is no information.
    floor = np.finfo(float).eps * np.maximum(values[..., -1:], 1.0)
    return np.maximum(values, floor), vectors, scale


def covariance_among(information: FloatArray, among: Mask) -> FloatArray:
    """Covariance (n, n) by the information on n unknowns, zero for those that are not in a mask."""
    covariance = np.zeros_like(information)
    free = np.ix_(among, among)
    covariance[free] = covariance_from(information[free])
    return covariance


def _eigen(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (..., n), ascending, and eigenvectors (..., n, n) of symmetric matrices."""
    # NumPy's divide and conquer fails on some valid matrices with many nearly equal eigenvalues,
    # which held unknowns cause; the driver `evr` is slower but does not.
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
    """Sums `left_i^T right_i` over blocks (m, d, p) and (m, d, q), or (m, d): (p, q) or (p,)."""
    # A single product of tall matrices is many times faster than `einsum` over the blocks.
    rows = left.reshape(math.prod(left.shape[:-1]), left.shape[-1])
    return np.asarray(rows.T @ right.reshape(len(rows), *right.shape[2:]))


def damped_step(
    information: FloatArray, gradient: FloatArray, damping: FloatArray | float
) -> FloatArray:
    """(..., n) Levenberg-Marquardt steps for (..., n, n) normal matrices and (..., n) gradients.

    The damping, scalar or (..., 1), is the share of the diagonal that is added (Marquardt 1963).
    """
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    added = damping * np.maximum(diagonal, np.finfo(float).tiny) + np.finfo(float).tiny
    matrix = information + added[..., :, None] * np.eye(information.shape[-1])
    return np.asarray(-np.linalg.solve(matrix, gradient[..., None])[..., 0])


def squared_lengths(
    residuals: FloatArray, left: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Computes squared Mahalanobis lengths of residuals in directions that have redundancy.

    An observation that alone determines a direction has zero residual and variance there. Of (m, d)
    residuals, `left` is the (m, d, d) covariance less what the fit absorbed, and `covariance` that
    of their noise. Returns (m,) squared lengths, and (m,) their degrees of freedom.
    """
    root = np.linalg.cholesky(covariance)
    whitening = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(whitening @ left @ np.swapaxes(whitening, 1, 2))
    white = (np.swapaxes(vectors, 1, 2) @ whitening @ residuals[:, :, None])[:, :, 0]
    redundant = values > ROUNDING
    squares = np.where(redundant, white**2 / np.where(redundant, values, 1.0), 0.0)
    return np.asarray(squares.sum(axis=1)), np.asarray(redundant.sum(axis=1))


def _scale(information: FloatArray) -> FloatArray:
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))
