"""Weighted least squares on filtered torques, with a covariance that allows for correlated noise.

The noise level of each joint is estimated from its residuals. Noise is correlated between samples
by the filter: that does not bias the estimate, but enlarges its covariance.

Stribeck's hump of dry friction at low speeds: `(Fc + (Fs - Fc) exp(-(dq / vs)^2)) sign(dq)`. Where
friction sets in gradually, as seen by torque sensors behind a gear, the hump is a dip: Fs is less
than Fc. All parameters but the speeds vs are linear, and eliminated by variable projection (Golub
and Pereyra 1973, in Kaufman's form of 1975).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import qr, solve_triangular

from visioncal.core.quantiles import FALSE_REJECTION, chi2_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import JointMotion, sign

# Rows of a QR decomposition at a time, so that they stay in the processor's cache.
_CHUNK = 2000
# Start values and bounds of the Stribeck speed [rad/s].
_STARTS, _SLOWEST, _FASTEST = (0.01, 0.03, 0.08), 1e-3, 0.5


@dataclass(frozen=True, eq=False)
class NoiseBlock:
    """Regressor and torques of samples that share a noise level for each joint."""

    x: FloatArray  # (k, n, p) regressor.
    y: FloatArray  # (k, n) torques [N m].
    used: Mask  # (k, n) mask of the torques that are fitted.
    correlation: FloatArray  # (l,) autocorrelation of filtered white noise at lags 1, 2, ...

    def __post_init__(self) -> None:
        # Contiguous for each joint, as it is read again and again.
        by_joint = np.ascontiguousarray(np.moveaxis(self.x, 1, 0))
        object.__setattr__(self, "x", np.moveaxis(by_joint, 0, 1))

    def predicted(self, values: FloatArray) -> FloatArray:
        """Torques (k, n) predicted by (p,) parameters [N m]."""
        joints = range(self.y.shape[1])
        return np.stack([self.x[:, joint] @ values for joint in joints], axis=1)

    def within(self, values: FloatArray, sigma: FloatArray) -> "NoiseBlock":
        """The block without the outliers of a fit."""
        count = max(int(self.used.sum()), 1)
        limit = float(np.sqrt(chi2_limit(FALSE_REJECTION / count, 1.0)))
        near = np.abs(self.y - self.predicted(values)) <= limit * sigma
        return replace(self, used=self.used & near)


@dataclass(frozen=True, eq=False)
class Regression:
    """A fit of p parameters to blocks of n joints."""

    values: FloatArray  # (p,) the parameters.
    covariance: FloatArray  # (p, p) of these.
    sigmas: tuple[FloatArray, ...]  # (n,) noise of the joints, for each block [N m].
    blocks: tuple[NoiseBlock, ...]  # The fitted blocks, outliers masked.

    @property
    def residuals(self) -> tuple[FloatArray, ...]:
        """Measured less predicted torques (k, n), for each block."""
        return tuple(block.y - block.predicted(self.values) for block in self.blocks)


@dataclass(frozen=True, eq=False)
class _JointFactor:
    """Triangular factor of a joint's rows, which holds all their information."""

    columns: IntArray  # (c,) indices of the parameters that affect this joint.
    triangle: FloatArray  # (c + 1, c + 1) R factor of [x, y].
    count: int  # Number of rows.


def regress(blocks: Sequence[NoiseBlock]) -> Regression:
    """Fits parameters and the joints' noise, and masks outliers.

    Raises:
        numpy.linalg.LinAlgError: The rows do not determine all parameters.
    """
    blocks = tuple(blocks)
    with one_blas_thread():
        for _ in range(10):
            values, sigmas, root = _weighted(blocks)
            masked = tuple(
                block.within(values, sigma) for block, sigma in zip(blocks, sigmas, strict=True)
            )
            pairs = zip(masked, blocks, strict=True)
            if all(new.used.sum() == old.used.sum() for new, old in pairs):
                break
            blocks = masked
        fit = Regression(values, root @ root.T, sigmas, blocks)
        return replace(fit, covariance=_covariance(fit))


def rms_of(values: FloatArray, used: Mask) -> FloatArray:
    """(n,) root mean square of the used ones of (k, n) values."""
    counts = np.maximum(used.sum(axis=0), 1)
    return np.asarray(np.sqrt(np.sum(used * values**2, axis=0) / counts))


def std_of(values: FloatArray, used: Mask) -> FloatArray:
    """(n,) standard deviation of the used ones of (k, n) values."""
    counts = np.maximum(used.sum(axis=0), 1)
    return rms_of(values - np.sum(used * values, axis=0) / counts, used)


def _weighted(
    blocks: Sequence[NoiseBlock],
) -> tuple[FloatArray, tuple[FloatArray, ...], FloatArray]:
    """Parameters, noise of the joints by block, and a square root (p, p) of the covariance."""
    # Each joint's rows are decomposed once; reweighting only needs their triangular factors.
    joints = [_decomposed(block) for block in blocks]
    size = blocks[0].x.shape[2]
    sigmas = [np.ones(len(joint)) for joint in joints]
    for turn in range(30):
        values, root = _solved(joints, sigmas, size)
        before = sigmas
        sigmas = [
            np.array(
                [_sigma(joint, values, root, old) for joint, old in zip(factors, olds, strict=True)]
            )
            for factors, olds in zip(joints, before, strict=True)
        ]
        pairs = zip(before, sigmas, strict=True)
        if turn and all(np.allclose(old, new, rtol=1e-4) for old, new in pairs):
            break
    return values, tuple(sigmas), root


def _decomposed(block: NoiseBlock) -> list[_JointFactor]:
    """Triangular factors of a block's joints, chunk by chunk (Golub and Van Loan 2013, 5.3.5)."""
    factors = []
    for joint in range(block.y.shape[1]):
        rows = block.used[:, joint]
        x = block.x[:, joint]
        columns = np.flatnonzero(x.any(axis=0))
        triangle = np.zeros((0, len(columns) + 1))
        for begin in range(0, len(x), _CHUNK):
            chunk_rows = slice(begin, begin + _CHUNK)
            chunk = np.column_stack([x[chunk_rows][:, columns], block.y[chunk_rows, joint]])[
                rows[chunk_rows]
            ]
            if len(chunk):
                (triangle,) = qr(np.concatenate([triangle, chunk]), mode="r", overwrite_a=True)
                triangle = triangle[: len(columns) + 1]
        factors.append(_JointFactor(columns, triangle, int(rows.sum())))
    return factors


def _solved(
    joints: Sequence[Sequence[_JointFactor]], sigmas: Sequence[FloatArray], size: int
) -> tuple[FloatArray, FloatArray]:
    """Parameters at given noise, and a square root of their covariance."""
    parts = []
    for factors, noise in zip(joints, sigmas, strict=True):
        for joint, sigma in zip(factors, noise, strict=True):
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


def _sigma(joint: _JointFactor, values: FloatArray, root: FloatArray, before: float) -> float:
    """A joint's noise from its residuals and their degrees of freedom."""
    fitted = np.sum((joint.triangle[:, :-1] @ root[joint.columns]) ** 2) / before**2
    freedom = max(joint.count - fitted, 1.0)
    # Residuals of exact torques are rounding, which must not give a joint all the weight.
    size = np.linalg.norm(joint.triangle[:, -1]) / np.sqrt(max(joint.count, 1))
    left = joint.triangle[:, :-1] @ values[joint.columns] - joint.triangle[:, -1]
    return float(max(np.sqrt(left @ left / freedom), 1e-9 * size, 1e-12))


def _covariance(fit: Regression) -> FloatArray:
    """The estimate's covariance under correlated noise."""
    # Sandwich covariance (White 1980; Newey and West 1987), with the autocorrelation of filtered
    # white noise, or that of the residuals where it differs significantly.
    white = fit.covariance
    scores = np.zeros_like(white)
    for block, residuals, sigma in zip(fit.blocks, fit.residuals, fit.sigmas, strict=True):
        for joint in range(len(sigma)):
            used = block.used[:, joint]
            correlations = _correlations(residuals[:, joint] * used, used, block.correlation)
            rows = block.x[:, joint] * used[:, None] / sigma[joint]
            columns = np.flatnonzero(rows.any(axis=0))
            scores[np.ix_(columns, columns)] += _scores(rows[:, columns], correlations)
    # By a square root, so that no variance is negative, however ill-conditioned the parameters.
    sizes = np.sqrt(np.maximum(np.diag(scores), 1e-300))
    values, vectors = np.linalg.eigh(scores / np.outer(sizes, sizes))
    root = white @ (sizes[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
    return np.asarray(root @ root.T)


def _scores(rows: FloatArray, correlations: FloatArray) -> FloatArray:
    """`rows^T T rows`, where T is the Toeplitz matrix of the correlations 1, `correlations`."""
    # By the noise's spectrum, which is kept positive although the correlations are truncated.
    if not len(correlations):
        return np.asarray(rows.T @ rows)
    from scipy.fft import next_fast_len, rfft

    size = next_fast_len(len(rows) + len(correlations), real=True)
    kernel = np.zeros(size)
    kernel[0] = 1.0
    kernel[1 : len(correlations) + 1] = kernel[-1 : -len(correlations) - 1 : -1] = correlations
    power = np.maximum(rfft(kernel).real, 0.02)
    # All frequencies of a real signal's spectrum but the ends count twice.
    power[1 : (size + 1) // 2] *= 2.0
    waves = rfft(rows, size, axis=0) * np.sqrt(power / size)[:, None]
    return np.asarray(waves.real.T @ waves.real + waves.imag.T @ waves.imag)


def _correlations(residuals: FloatArray, used: Mask, of_filter: FloatArray) -> FloatArray:
    """Autocorrelation of the noise at lags 1, 2, ...: the filter's, or the residuals'."""
    size = float(residuals @ residuals)
    count = int(used.sum())
    correlations = list(of_filter)
    if not size or count < 20:
        return of_filter
    # Autocorrelations count up to the first insignificant one.
    for lag in range(1, int(0.1 * count)):
        sample = float(residuals[lag:] @ residuals[:-lag]) / size
        expected = correlations[lag - 1] if lag <= len(correlations) else 0.0
        if abs(sample - expected) * np.sqrt(count) < 3.0:
            break
        if lag <= len(correlations):
            correlations[lag - 1] = sample
        else:
            correlations.append(sample)
    return np.array(correlations)


@dataclass(frozen=True, eq=False)
class Stribeck:
    """Stribeck humps of a joints."""

    joints: IntArray  # (a,) indices of the joints, from 0.
    hump_nm: FloatArray  # (a,) Fs - Fc [N m].
    speed_rad_s: FloatArray  # (a,) vs [rad/s].
    slow_rad_s: float  # See `model.sign`.

    @classmethod
    def none(cls) -> Self:
        """No humps."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), 0.0)

    def shapes(self, motion: JointMotion) -> FloatArray:
        """Torques (m, a) of humps of 1 N m."""
        dq = motion.dq[:, self.joints]
        return np.asarray(sign(dq, self.slow_rad_s) * np.exp(-((dq / self.speed_rad_s) ** 2)))

    def torques(self, motion: JointMotion) -> FloatArray:
        """Friction torques (m, n) of the humps [N m]."""
        torques = np.zeros_like(motion.dq)
        torques[:, self.joints] = self.hump_nm * self.shapes(motion)
        return torques

    def jacobian(self, motion: JointMotion) -> FloatArray:
        """(m, 2 a) derivatives over humps, and over the logarithms of their speeds."""
        shapes = self.shapes(motion)
        squares = (motion.dq[:, self.joints] / self.speed_rad_s) ** 2
        return np.concatenate([shapes, 2.0 * self.hump_nm * squares * shapes], axis=1)


def fit_stribeck(
    streams: Sequence[Conditioned],
    blocks: Sequence[NoiseBlock],
    plain: Regression,
    slow_rad_s: float,
    coulomb_indices: IntArray,
) -> tuple[Stribeck, Regression]:
    """Fits significant Stribeck humps.

    Args:
        streams: The samples.
        blocks: Their rows with all samples: humps may look like outliers of the fit without.
        plain: The fit without humps.
        slow_rad_s: See `model.sign`.
        coulomb_indices: (n,) index of each joint's Fc among its parameters.

    Returns:
        The humps, and the fit with them: its parameters are those of `plain`, humps [N m], and
        logarithms of speeds, whose values are the remaining steps.
    """

    def cost(humps: Stribeck) -> float:
        """Negative log-likelihood of the fit."""
        fit = regress(_with_humps(streams, blocks, humps))
        pairs = zip(fit.blocks, fit.sigmas, strict=True)
        return float(sum(block.used.sum(axis=0) @ np.log(sigma) for block, sigma in pairs))

    joints = np.arange(blocks[0].y.shape[1])
    while len(joints):
        ones = np.ones(len(joints))
        starts = [Stribeck(joints, ones, start * ones, slow_rad_s) for start in _STARTS]
        humps = min(starts, key=cost)
        # Gauss-Newton steps of the logarithms of the speeds.
        for _ in range(20):
            fit = regress(_with_humps(streams, blocks, replace(humps, hump_nm=ones)))
            hump_nm, slopes = np.split(fit.values[-2 * len(joints) :], 2)
            steps = np.clip(slopes / hump_nm, -1.0, 1.0)
            speeds = np.clip(humps.speed_rad_s * np.exp(steps), _SLOWEST, _FASTEST)
            humps = replace(humps, hump_nm=hump_nm, speed_rad_s=speeds)
            if np.abs(steps).max() < 1e-3:
                break
        fit = regress(_with_humps(streams, blocks, humps))
        humps = replace(humps, hump_nm=fit.values[-2 * len(joints) : -len(joints)])
        coulomb_nm = fit.values[coulomb_indices[joints]]
        # Fs below 0 would drive the joint at low speeds: something else is fitted then.
        count = len(humps.joints)
        sigma = np.sqrt(np.diag(fit.covariance)[-2 * count : -count])
        limit = float(np.sqrt(chi2_limit(FALSE_REJECTION, 2.0)))
        inside = (humps.speed_rad_s > 1.01 * _SLOWEST) & (humps.speed_rad_s < 0.99 * _FASTEST)
        resists = coulomb_nm + humps.hump_nm > 0.0
        significant = np.asarray((np.abs(humps.hump_nm) > limit * sigma) & inside & resists)
        if significant.all():
            return humps, fit
        joints = joints[significant]
    return Stribeck.none(), plain


def _with_humps(
    streams: Sequence[Conditioned], blocks: Sequence[NoiseBlock], humps: Stribeck
) -> list[NoiseBlock]:
    """Blocks with the columns of humps and of their speeds appended."""
    count = len(humps.joints)
    extended = []
    for stream, block in zip(streams, blocks, strict=True):
        jacobian = stream.filtered(humps.jacobian)
        columns = np.zeros((*block.y.shape, 2 * count))
        for at, joint in enumerate(humps.joints):
            columns[:, joint, [at, count + at]] = jacobian[:, [at, count + at]]
        extended.append(replace(block, x=np.concatenate([block.x, columns], axis=2)))
    return extended
