"""Fit of Stribeck friction: the hump of dry friction at low speeds.

Dry friction is `(Fc + (Fs - Fc) exp(-(dq / vs)^2)) sign(dq)`. Where friction sets in gradually, as
seen by torque sensors behind a gear, the hump is a dip: Fs is less than Fc. All parameters but the
speeds vs are linear, and eliminated by variable projection (Golub and Pereyra 1973, in Kaufman's
form of 1975).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import JointMotion, sign
from visioncal.dynamics.regression import NoiseBlock, Regression, regress
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_from, damped_step, gram

# Start values and bounds of the Stribeck speed [rad/s].
_STARTS, _SLOWEST, _FASTEST = (0.01, 0.03, 0.08), 1e-3, 0.5
_SETTLED, _SETTLED_NOISE, _ROUNDS = 1e-6, 1e-2, 8
# Significance level of a hump.
_CHANCE = 1e-3


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
    joints = np.arange(blocks[0].y.shape[1])
    problem = _Weighted.of(streams, blocks, plain.sigmas)
    while len(joints):
        ones = np.ones(len(joints))
        starts = [Stribeck(joints, ones, start * ones, slow_rad_s) for start in _STARTS]
        candidates = [_optimised(problem, start) for start in starts]
        humps, fit = _refined(streams, blocks, min(candidates, key=lambda value: value.cost).humps)
        significant = _significant(humps, fit, fit.values[coulomb_indices[joints]])
        if significant.all():
            return humps, fit
        joints = joints[significant]
    return Stribeck.none(), plain


def _refined(
    streams: Sequence[Conditioned], blocks: Sequence[NoiseBlock], humps: Stribeck
) -> tuple[Stribeck, Regression]:
    """Repeats the fit with the noise re-estimated with humps, until the noise converges."""
    fit = regress(_with_humps(streams, blocks, humps))
    for _ in range(_ROUNDS):
        humps = _optimised(_Weighted.of(streams, blocks, fit.sigmas), humps).humps
        before, fit = fit, regress(_with_humps(streams, blocks, humps))
        pairs = zip(before.sigmas, fit.sigmas, strict=True)
        if all(np.allclose(old, new, rtol=_SETTLED_NOISE) for old, new in pairs):
            break
    return humps, fit


def _significant(humps: Stribeck, fit: Regression, coulomb_nm: FloatArray) -> FloatArray:
    """(a,) humps that are significant, within the bounds of speed, and resist the motion."""
    # Fs below 0 would drive the joint at low speeds: something else is fitted then.
    count = len(humps.joints)
    sigma = np.sqrt(np.diag(fit.covariance)[-2 * count : -count])
    limit = float(np.sqrt(chi2_limit(_CHANCE, 2.0)))
    inside = (humps.speed_rad_s > 1.01 * _SLOWEST) & (humps.speed_rad_s < 0.99 * _FASTEST)
    resists = coulomb_nm + humps.hump_nm > 0.0
    return np.asarray((np.abs(humps.hump_nm) > limit * sigma) & inside & resists)


def _optimised(problem: "_Weighted", start: Stribeck) -> "_HumpFit":
    """Optimises the speeds of humps from a start."""

    def linearise(logs: FloatArray) -> Linearised[FloatArray]:
        fit = problem.solve(replace(start, speed_rad_s=np.exp(logs)))

        def step(damping: float) -> FloatArray:
            update = np.clip(damped_step(fit.information, fit.gradient, damping), -1.0, 1.0)
            return np.clip(logs + update, np.log(_SLOWEST), np.log(_FASTEST))

        return Linearised(logs, fit.cost, step)

    logs, _ = levenberg_marquardt(np.log(start.speed_rad_s), linearise, _SETTLED)
    return problem.solve(replace(start, speed_rad_s=np.exp(logs)))


@dataclass(frozen=True, eq=False)
class _HumpFit:
    """Best fit at given speeds of the humps."""

    humps: Stribeck  # The fitted humps.
    cost: float  # Sum of squared residuals, in units of the noise.
    # (a, a) over the logarithms of the speeds, other parameters eliminated.
    information: FloatArray
    gradient: FloatArray  # (a,) of half the cost, likewise.


@dataclass(frozen=True, eq=False)
class _Weighted:
    """The problem without humps, weighted by given noise."""

    streams: Sequence[Conditioned]  # The samples.
    blocks: tuple[NoiseBlock, ...]  # Their rows in units of the noise.
    weights: tuple[FloatArray, ...]  # (k, n) weights of each block [1/(N m)].
    information: FloatArray  # (p, p) over the parameters without humps.
    right: FloatArray  # (p,) right-hand side of their normal equations.
    total: float  # Sum of squared weighted torques.

    @classmethod
    def of(
        cls,
        streams: Sequence[Conditioned],
        blocks: Sequence[NoiseBlock],
        sigmas: Sequence[FloatArray],
    ) -> Self:
        """Weights blocks by the noise of their joints."""
        weights = tuple(block.used / sigma for block, sigma in zip(blocks, sigmas, strict=True))
        weighted = tuple(
            replace(block, x=block.x * weight[:, :, None], y=block.y * weight)
            for block, weight in zip(blocks, weights, strict=True)
        )
        return cls(
            streams,
            weighted,
            weights,
            np.asarray(sum(gram(block.x, block.x) for block in weighted)),
            np.asarray(sum(gram(block.x, block.y) for block in weighted)),
            float(sum(np.sum(block.y**2) for block in weighted)),
        )

    def solve(self, at: Stribeck) -> _HumpFit:
        """Solves for the linear parameters at given speeds."""
        count, size = len(at.joints), len(self.right)
        a, b = self._normal(replace(at, hump_nm=np.ones(count)))
        linear, speeds = slice(size + count), slice(size + count, None)
        covariance = covariance_from(a[linear, linear])
        best = covariance @ b[linear]
        humps = best[size:]
        cross = humps[:, None] * a[speeds, linear]
        return _HumpFit(
            replace(at, hump_nm=humps),
            self.total - float(best @ b[linear]),
            np.outer(humps, humps) * a[speeds, speeds] - cross @ covariance @ cross.T,
            cross @ best - humps * b[speeds],
        )

    def _normal(self, humps: Stribeck) -> tuple[FloatArray, FloatArray]:
        """Normal equations; humps and speeds follow the other parameters."""
        count, size = len(humps.joints), len(self.right)
        a, b = np.zeros((size + 2 * count, size + 2 * count)), np.zeros(size + 2 * count)
        a[:size, :size], b[:size] = self.information, self.right
        for stream, block, weight in zip(self.streams, self.blocks, self.weights, strict=True):
            jacobian = stream.filtered(humps.jacobian)
            for at, joint in enumerate(humps.joints):
                own = [size + at, size + count + at]
                columns = jacobian[:, [at, count + at]] * weight[:, joint, None]
                a[:size, own] += block.x[:, joint].T @ columns
                a[np.ix_(own, own)] += columns.T @ columns
                b[own] += columns.T @ block.y[:, joint]
        a[size:, :size] = a[:size, size:].T
        return a, b


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
