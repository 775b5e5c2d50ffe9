"""Weighted least squares on many filtered torques, with a covariance that counts what they share.

Each joint has a noise of its own, estimated from its residuals. Filtered noise is correlated from
one sample to the next; the estimate stands that, but its covariance must know.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.linalg import qr, solve_triangular

from visioncal.core.quantiles import chi2_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray, Mask

# Rows that are decomposed at a time, so that they stay in the processor's cache.
_CHUNK = 2000
_ROUNDS, _SETTLED = 30, 1e-4
# A residual that chance exceeds less often than this, among all of them, is an outlier.
_OUTLIER_CHANCE = 1e-3
_CUTS = 10
# Correlations are followed until they are lost in their own noise, and over this share of samples.
_LOST, _FOLLOWED = 3.0, 0.1
# No frequency has less than this share of white noise's power.
_LEAST_POWER = 0.02


@dataclass(frozen=True, eq=False)
class NoiseBlock:
    """Samples whose joints have each one level of noise.

    Attributes:
        x: (k, n, p) derivatives of the torques by the parameters.
        y: (k, n) torques [N m].
        used: (k, n) which of them count.
        correlation: (l,) what the filter alone leaves of white noise from one sample to the next,
            the one after, and so on.
    """

    x: FloatArray
    y: FloatArray
    used: Mask
    correlation: FloatArray

    def __post_init__(self) -> None:
        # Joint after joint in memory, since that is how they are read, again and again.
        by_joint = np.ascontiguousarray(np.moveaxis(self.x, 1, 0))
        object.__setattr__(self, "x", np.moveaxis(by_joint, 0, 1))

    def predicted(self, values: FloatArray) -> FloatArray:
        """(k, n) torques by (p,) parameters [N m]."""
        joints = range(self.y.shape[1])
        return np.stack([self.x[:, joint] @ values for joint in joints], axis=1)

    def within(self, values: FloatArray, sigma: FloatArray) -> "NoiseBlock":
        """The same without torques that are farther from a fit than chance takes them."""
        count = max(int(self.used.sum()), 1)
        limit = float(np.sqrt(chi2_limit(_OUTLIER_CHANCE / count, 1.0)))
        near = np.abs(self.y - self.predicted(values)) <= limit * sigma
        return replace(self, used=self.used & near)


@dataclass(frozen=True, eq=False)
class Regression:
    """A fit of p parameters to blocks of n joints.

    Attributes:
        values: (p,) the parameters.
        covariance: (p, p) of these.
        sigmas: One (n,) noise of the joints a block [N m].
        blocks: What was fitted, without outliers.
    """

    values: FloatArray
    covariance: FloatArray
    sigmas: tuple[FloatArray, ...]
    blocks: tuple[NoiseBlock, ...]

    @property
    def residuals(self) -> tuple[FloatArray, ...]:
        """(k, n) torques less the fit, a block."""
        return tuple(block.y - block.predicted(self.values) for block in self.blocks)


@dataclass(frozen=True, eq=False)
class _Joint:
    """All that a block says of a joint: a triangle in place of its rows.

    Attributes:
        columns: (c,) the parameters that move this joint.
        triangle: (c + 1, c + 1) of [x, y] decomposed.
        count: How many rows it stands for.
    """

    columns: IntArray
    triangle: FloatArray
    count: int

    def scatter(self, values: FloatArray) -> float:
        """Sum of squared residuals."""
        left = self.triangle[:, :-1] @ values[self.columns] - self.triangle[:, -1]
        return float(left @ left)


def regress(blocks: Sequence[NoiseBlock]) -> Regression:
    """Fits parameters, the joints' noise, and finds outliers.

    Raises:
        numpy.linalg.LinAlgError: The rows do not determine all parameters.
    """
    blocks = tuple(blocks)
    with one_blas_thread():
        for _ in range(_CUTS):
            values, sigmas, root = _weighted(blocks)
            cut = tuple(
                block.within(values, sigma) for block, sigma in zip(blocks, sigmas, strict=True)
            )
            pairs = zip(cut, blocks, strict=True)
            if all(new.used.sum() == old.used.sum() for new, old in pairs):
                break
            blocks = cut
        fit = Regression(values, root @ root.T, sigmas, blocks)
        return replace(fit, covariance=_covariance(fit))


def rms_of(values: FloatArray, used: Mask) -> FloatArray:
    """(n,) root mean square of those of (k, n) values that count."""
    counts = np.maximum(used.sum(axis=0), 1)
    return np.asarray(np.sqrt(np.sum(used * values**2, axis=0) / counts))


def spread_of(values: FloatArray, used: Mask) -> FloatArray:
    """(n,) standard deviation of those of (k, n) values that count."""
    counts = np.maximum(used.sum(axis=0), 1)
    return rms_of(values - np.sum(used * values, axis=0) / counts, used)


def _weighted(
    blocks: Sequence[NoiseBlock],
) -> tuple[FloatArray, tuple[FloatArray, ...], FloatArray]:
    """Parameters, noise of the joints by block, and a root (p, p) of the white covariance."""
    # Each joint's rows are decomposed once; changing weights costs triangles alone.
    joints = [_decomposed(block) for block in blocks]
    size = blocks[0].x.shape[2]
    sigmas = [np.ones(len(joint)) for joint in joints]
    for turn in range(_ROUNDS):
        values, root = _solved(joints, sigmas, size)
        before = sigmas
        sigmas = [
            np.array(
                [_sigma(joint, values, root, old) for joint, old in zip(of, olds, strict=True)]
            )
            for of, olds in zip(joints, before, strict=True)
        ]
        pairs = zip(before, sigmas, strict=True)
        if turn and all(np.allclose(old, new, rtol=_SETTLED) for old, new in pairs):
            break
    return values, tuple(sigmas), root


def _decomposed(block: NoiseBlock) -> list[_Joint]:
    """The triangles of a block's joints, chunk by chunk (Golub and Van Loan 2013, 5.3.5)."""
    found = []
    for joint in range(block.y.shape[1]):
        rows = block.used[:, joint]
        x = block.x[:, joint]
        columns = np.flatnonzero(x.any(axis=0))
        triangle = np.zeros((0, len(columns) + 1))
        for begin in range(0, len(x), _CHUNK):
            some = slice(begin, begin + _CHUNK)
            chunk = np.column_stack([x[some][:, columns], block.y[some, joint]])[rows[some]]
            if len(chunk):
                (triangle,) = qr(np.concatenate([triangle, chunk]), mode="r", overwrite_a=True)
                triangle = triangle[: len(columns) + 1]
        found.append(_Joint(columns, triangle, int(rows.sum())))
    return found


def _solved(
    joints: Sequence[Sequence[_Joint]], sigmas: Sequence[FloatArray], size: int
) -> tuple[FloatArray, FloatArray]:
    """Parameters under given noise, and a root of their covariance."""
    parts = []
    for of, noise in zip(joints, sigmas, strict=True):
        for joint, sigma in zip(of, noise, strict=True):
            part = np.zeros((len(joint.triangle), size + 1))
            part[:, [*joint.columns, size]] = joint.triangle / sigma
            parts.append(part)
    stacked = np.concatenate(parts)
    lengths = np.linalg.norm(stacked[:, :-1], axis=0)
    if not lengths.all():
        raise np.linalg.LinAlgError("parameters without any effect")
    stacked[:, :-1] /= lengths
    (triangle,) = qr(stacked, mode="r")
    upper = triangle[:size, :size]
    root = solve_triangular(upper, np.eye(size)) / lengths[:, None]
    return root @ triangle[:size, -1], root


def _sigma(joint: _Joint, values: FloatArray, root: FloatArray, before: float) -> float:
    """A joint's noise by its residuals, less the freedom that the fit has taken of its rows."""
    taken = np.sum((joint.triangle[:, :-1] @ root[joint.columns]) ** 2) / before**2
    freedom = max(joint.count - taken, 1.0)
    # Exact torques leave rounding, and no joint may get all the weight for it.
    size = np.linalg.norm(joint.triangle[:, -1]) / np.sqrt(max(joint.count, 1))
    return float(max(np.sqrt(joint.scatter(values) / freedom), 1e-9 * size, 1e-12))


def _covariance(fit: Regression) -> FloatArray:
    """The estimate's covariance under correlated noise."""
    # That of least squares under another noise than it was weighted for (White 1980; Newey and West
    # 1987), with the correlations that the filter leaves of white noise, and those of the residuals
    # where they are plainly larger.
    white = fit.covariance
    scores = np.zeros_like(white)
    for block, residuals, sigma in zip(fit.blocks, fit.residuals, fit.sigmas, strict=True):
        for joint in range(len(sigma)):
            used = block.used[:, joint]
            shares = _correlations(residuals[:, joint] * used, used, block.correlation)
            rows = block.x[:, joint] * used[:, None] / sigma[joint]
            columns = np.flatnonzero(rows.any(axis=0))
            scores[np.ix_(columns, columns)] += _scores(rows[:, columns], shares)
    # By a root, which leaves no variance below zero, however badly parameters are determined.
    sizes = np.sqrt(np.maximum(np.diag(scores), 1e-300))
    values, vectors = np.linalg.eigh(scores / np.outer(sizes, sizes))
    root = white @ (sizes[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
    return np.asarray(root @ root.T)


def _scores(rows: FloatArray, shares: FloatArray) -> FloatArray:
    """`rows^T T rows`, where T has ones on its diagonal and `shares` beside it."""
    # By the noise's spectrum, which cannot be negative, whatever cut-off correlations say.
    if not len(shares):
        return np.asarray(rows.T @ rows)
    size = next_fast_len(len(rows) + len(shares), real=True)
    kernel = np.zeros(size)
    kernel[0] = 1.0
    kernel[1 : len(shares) + 1] = kernel[-1 : -len(shares) - 1 : -1] = shares
    power = np.maximum(rfft(kernel).real, _LEAST_POWER)
    # Of a real signal's spectrum all but the ends stand for two frequencies.
    power[1 : (size + 1) // 2] *= 2.0
    waves = rfft(rows, size, axis=0) * np.sqrt(power / size)[:, None]
    return np.asarray(waves.real.T @ waves.real + waves.imag.T @ waves.imag)


def _correlations(residuals: FloatArray, used: Mask, known: FloatArray) -> FloatArray:
    """Correlations of the noise at lags 1, 2, ...: known ones, or of the residuals."""
    size = float(residuals @ residuals)
    count = int(used.sum())
    found = list(known)
    if not size or count < 20:
        return known
    for lag in range(1, int(_FOLLOWED * count)):
        seen = float(residuals[lag:] @ residuals[:-lag]) / size
        expected = found[lag - 1] if lag <= len(found) else 0.0
        if abs(seen - expected) * np.sqrt(count) < _LOST:
            break
        if lag <= len(found):
            found[lag - 1] = seen
        else:
            found.append(seen)
    return np.array(found)
