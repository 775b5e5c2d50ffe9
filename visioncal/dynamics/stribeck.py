"""What breaking loose takes: Stribeck's hump of dry friction at low speeds, and how wide it is.

Dry friction is `(Fc + (Fs - Fc) exp(-(dq / vs)^2)) sign(dq)`. Where friction sets in gradually, as
torque sensors behind a gear have it, the hump is a dip: Fs is less than Fc. All but the speeds vs
are linear, and eliminated (Golub and Pereyra 1973, variable projection, in Kaufman's form of 1975).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import sign
from visioncal.dynamics.motion import JointMotion
from visioncal.dynamics.regression import NoiseBlock, Regression, regress
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_from, damped_step, gram

# Where the search begins, and what it stays within [rad/s].
_STARTS, _SLOWEST, _FASTEST = (0.01, 0.03, 0.08), 1e-3, 0.5
_SETTLED, _SETTLED_NOISE, _ROUNDS = 1e-6, 1e-2, 8
# A hump is one where chance would gain as much in less than so many cases.
_CHANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Stribeck:
    """The humps of some joints.

    Attributes:
        joints: (a,) which joints, from 0.
        hump_nm: (a,) Fs - Fc [N m].
        speed_rad_s: (a,) vs [rad/s].
        slow_rad_s: See `friction.sign`.
    """

    joints: IntArray
    hump_nm: FloatArray
    speed_rad_s: FloatArray
    slow_rad_s: float

    @classmethod
    def none(cls) -> Self:
        """No joint has one."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), 0.0)

    def shapes(self, motion: JointMotion) -> FloatArray:
        """(m, a) torques of a hump of 1 N m."""
        dq = motion.dq[:, self.joints]
        return np.asarray(sign(dq, self.slow_rad_s) * np.exp(-((dq / self.speed_rad_s) ** 2)))

    def torques(self, motion: JointMotion) -> FloatArray:
        """(m, n) what the humps add to the joints' friction [N m]."""
        torques = np.zeros_like(motion.dq)
        torques[:, self.joints] = self.hump_nm * self.shapes(motion)
        return torques

    def jacobian(self, motion: JointMotion) -> FloatArray:
        """(m, 2 a) derivatives by the hump, and by the logarithm of its speed."""
        shapes = self.shapes(motion)
        squares = (motion.dq[:, self.joints] / self.speed_rad_s) ** 2
        return np.concatenate([shapes, 2.0 * self.hump_nm * squares * shapes], axis=1)


def fit_stribeck(
    streams: Sequence[Conditioned],
    blocks: Sequence[NoiseBlock],
    plain: Regression,
    slow_rad_s: float,
    sliding: IntArray,
) -> tuple[Stribeck, Regression]:
    """Finds the humps that torques show.

    Args:
        streams: The samples.
        blocks: The same, as they were fitted without humps, to which humps may look like outliers.
        plain: That fit.
        slow_rad_s: See `friction.sign`.
        sliding: (n,) which of its parameters is each joint's Fc.

    Returns:
        The humps, and the fit with them: its parameters are those of `plain`, humps [N m], and
        logarithms of speeds, whose values are what is left to go and mean nothing.
    """
    joints = np.arange(blocks[0].y.shape[1])
    whole = _Weighted.of(streams, blocks, plain.sigmas)
    while len(joints):
        ones = np.ones(len(joints))
        starts = [Stribeck(joints, ones, start * ones, slow_rad_s) for start in _STARTS]
        tried = [_descended(whole, start) for start in starts]
        found, fit = _polished(streams, blocks, min(tried, key=lambda value: value.cost).humps)
        shown = _shown(found, fit, fit.values[sliding[joints]])
        if shown.all():
            return found, fit
        joints = joints[shown]
    return Stribeck.none(), plain


def _polished(
    streams: Sequence[Conditioned], blocks: Sequence[NoiseBlock], found: Stribeck
) -> tuple[Stribeck, Regression]:
    """Descends again under the noise that is left with humps, until that stays the same."""
    fit = regress(_with_humps(streams, blocks, found))
    for _ in range(_ROUNDS):
        found = _descended(_Weighted.of(streams, blocks, fit.sigmas), found).humps
        before, fit = fit, regress(_with_humps(streams, blocks, found))
        pairs = zip(before.sigmas, fit.sigmas, strict=True)
        if all(np.allclose(old, new, rtol=_SETTLED_NOISE) for old, new in pairs):
            break
    return found, fit


def _shown(found: Stribeck, fit: Regression, coulomb_nm: FloatArray) -> FloatArray:
    """(a,) whether a hump is above chance and within the range of speeds."""
    # Friction that would drive a joint at low speeds (Fs below 0) is none: something else is.
    count = len(found.joints)
    sigma = np.sqrt(np.diag(fit.covariance)[-2 * count : -count])
    limit = float(np.sqrt(chi2_limit(_CHANCE, 2.0)))
    inside = (found.speed_rad_s > 1.01 * _SLOWEST) & (found.speed_rad_s < 0.99 * _FASTEST)
    resists = coulomb_nm + found.hump_nm > 0.0
    return np.asarray((np.abs(found.hump_nm) > limit * sigma) & inside & resists)


def _descended(whole: "_Weighted", start: Stribeck) -> "_HumpFit":
    """The humps that a descent from some speeds finds."""

    def linearise(logs: FloatArray) -> Linearised[FloatArray]:
        look = whole.look(replace(start, speed_rad_s=np.exp(logs)))

        def step(damping: float) -> FloatArray:
            by = np.clip(damped_step(look.information, look.gradient, damping), -1.0, 1.0)
            return np.clip(logs + by, np.log(_SLOWEST), np.log(_FASTEST))

        return Linearised(logs, look.cost, step)

    logs, _ = levenberg_marquardt(np.log(start.speed_rad_s), linearise, _SETTLED)
    return whole.look(replace(start, speed_rad_s=np.exp(logs)))


@dataclass(frozen=True, eq=False)
class _HumpFit:
    """Humps of given speeds at their best.

    Attributes:
        humps: The humps, with the given speeds.
        cost: What is left with them, in units of the noise.
        information: (a, a) by the logarithms of the speeds, all else being at its best.
        gradient: (a,) of half the cost, likewise.
    """

    humps: Stribeck
    cost: float
    information: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, eq=False)
class _Weighted:
    """The problem without humps, under given noise.

    Attributes:
        streams: The samples.
        blocks: The same in units of the noise.
        weights: What these were multiplied by, (k, n) a block [1/(N m)].
        information: (p, p) by the parameters without humps.
        right: (p,) right side of their normal equations.
        total: Sum of the squared torques.
    """

    streams: Sequence[Conditioned]
    blocks: tuple[NoiseBlock, ...]
    weights: tuple[FloatArray, ...]
    information: FloatArray
    right: FloatArray
    total: float

    @classmethod
    def of(
        cls,
        streams: Sequence[Conditioned],
        blocks: Sequence[NoiseBlock],
        sigmas: Sequence[FloatArray],
    ) -> Self:
        """Weighs blocks by the noise of their joints."""
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

    def look(self, at: Stribeck) -> _HumpFit:
        """Solves for all that is linear at given speeds."""
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
        """Normal equations with humps and speeds behind the other parameters."""
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
    """Blocks with the columns of humps and of their speeds added."""
    count = len(humps.joints)
    added = []
    for stream, block in zip(streams, blocks, strict=True):
        jacobian = stream.filtered(humps.jacobian)
        more = np.zeros((*block.y.shape, 2 * count))
        for at, joint in enumerate(humps.joints):
            more[:, joint, [at, count + at]] = jacobian[:, [at, count + at]]
        added.append(replace(block, x=np.concatenate([block.x, more], axis=2)))
    return added
