"""What breaking loose takes: Stribeck's hump of dry friction at low speeds, and how wide it is.

Dry friction is `(Fc + (Fs - Fc) exp(-(dq / vs)^2)) sign(dq)`. Where friction sets in gradually, as
torque sensors behind a gear have it, the hump is a dip: Fs is less than Fc. All but the speeds vs
are linear, and eliminated (Golub and Pereyra 1973, variable projection, in Kaufman's form of 1975).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.chance import chi2_limit
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.friction import sign
from visioncal.dynamics.motion import Motion
from visioncal.dynamics.regression import Block, Regression, regress
from visioncal.estimator.descend import Linearised, descend
from visioncal.estimator.linalg import covariance, damped_step
from visioncal.types import FloatArray, IntArray

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

    def shapes(self, motion: Motion) -> FloatArray:
        """(m, a) torques of a hump of 1 N m."""
        dq = motion.dq[:, self.joints]
        return np.asarray(sign(dq, self.slow_rad_s) * np.exp(-((dq / self.speed_rad_s) ** 2)))

    def torques(self, motion: Motion) -> FloatArray:
        """(m, n) what the humps add to the joints' friction [N m]."""
        torques = np.zeros_like(motion.dq)
        torques[:, self.joints] = self.hump_nm * self.shapes(motion)
        return torques

    def slopes(self, motion: Motion) -> FloatArray:
        """(m, 2 a) derivatives by the hump, and by the logarithm of its speed."""
        shapes = self.shapes(motion)
        squares = (motion.dq[:, self.joints] / self.speed_rad_s) ** 2
        return np.concatenate([shapes, 2.0 * self.hump_nm * squares * shapes], axis=1)


def fit_stribeck(
    streams: Sequence[Conditioned], blocks: Sequence[Block], plain: Regression, slow_rad_s: float
) -> tuple[Stribeck, Regression]:
    """Finds the humps that torques show.

    Args:
        streams: The samples.
        blocks: The same, as they were fitted without humps, to which humps may look like outliers.
        plain: That fit.
        slow_rad_s: See `friction.sign`.

    Returns:
        The humps, and the fit with them: its parameters are those of `plain`, humps [N m], and
        logarithms of speeds, whose values are what is left to go and mean nothing.
    """
    joints = np.arange(blocks[0].y.shape[1])
    whole = replace(plain, blocks=tuple(blocks))
    while len(joints):
        starts = [np.full(len(joints), it) for it in _STARTS]
        tried = [_fitted(streams, whole, joints, it, slow_rad_s) for it in starts]
        found, fit = _polished(streams, whole, min(tried, key=lambda it: it[1])[0])
        shown = _shown(found, fit)
        if shown.all():
            return found, fit
        joints = joints[shown]
    return Stribeck.none(), plain


def _polished(
    streams: Sequence[Conditioned], whole: Regression, found: Stribeck
) -> tuple[Stribeck, Regression]:
    """Descends again under the noise that is left with humps, until that stays the same."""
    fit = regress(_with_humps(streams, whole.blocks, found))
    for _ in range(_ROUNDS):
        weighted = replace(whole, sigmas=fit.sigmas)
        found, _ = _fitted(streams, weighted, found.joints, found.speed_rad_s, found.slow_rad_s)
        before, fit = fit, regress(_with_humps(streams, whole.blocks, found))
        pairs = zip(before.sigmas, fit.sigmas, strict=True)
        if all(np.allclose(old, new, rtol=_SETTLED_NOISE) for old, new in pairs):
            break
    return found, fit


def _shown(found: Stribeck, fit: Regression) -> FloatArray:
    """(a,) whether a hump is above chance and within the range of speeds."""
    count = len(found.joints)
    sigma = np.sqrt(np.diag(fit.covariance)[-2 * count : -count])
    limit = float(np.sqrt(chi2_limit(_CHANCE, 2.0)))
    inside = (found.speed_rad_s > 1.01 * _SLOWEST) & (found.speed_rad_s < 0.99 * _FASTEST)
    return np.asarray((np.abs(found.hump_nm) > limit * sigma) & inside)


def _fitted(
    streams: Sequence[Conditioned],
    plain: Regression,
    joints: IntArray,
    start_rad_s: FloatArray,
    slow_rad_s: float,
) -> tuple[Stribeck, float]:
    """The speeds that a descent from one start finds, with its cost."""
    count = len(joints)

    def linearise(logs: FloatArray) -> Linearised[FloatArray]:
        at = _solved(streams, plain, Stribeck(joints, np.ones(count), np.exp(logs), slow_rad_s))
        information, gradient, cost = _projected(streams, plain, at)

        def step(damping: float) -> FloatArray:
            by = np.clip(damped_step(information, gradient, damping), -1.0, 1.0)
            return np.clip(logs + by, np.log(_SLOWEST), np.log(_FASTEST))

        return Linearised(logs, cost, step)

    logs, _ = descend(np.log(start_rad_s), linearise, _SETTLED)
    found = _solved(streams, plain, Stribeck(joints, np.ones(count), np.exp(logs), slow_rad_s))
    return found, _projected(streams, plain, found)[2]


def _solved(streams: Sequence[Conditioned], plain: Regression, humps: Stribeck) -> Stribeck:
    """The same speeds with the best humps."""
    count = len(humps.joints)
    a, b = _normal(streams, plain, humps)
    a, b = a[:-count, :-count], b[:-count]
    return replace(humps, hump_nm=(covariance(a) @ b)[-count:])


def _projected(
    streams: Sequence[Conditioned], plain: Regression, humps: Stribeck
) -> tuple[FloatArray, FloatArray, float]:
    """Information and gradient by the logarithms of speeds, all else being at its best; cost."""
    count = len(humps.joints)
    a, b = _normal(streams, plain, humps)
    best = covariance(a[:-count, :-count]) @ b[:-count]
    cross = a[-count:, :-count]
    spread = covariance(a[:-count, :-count])
    information = a[-count:, -count:] - cross @ spread @ cross.T
    total = sum(
        float(np.sum((it.used * it.y / sigma) ** 2))
        for it, sigma in zip(plain.blocks, plain.sigmas, strict=True)
    )
    return information, cross @ best - b[-count:], total - float(best @ b[:-count])


def _normal(
    streams: Sequence[Conditioned], plain: Regression, humps: Stribeck
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of all parameters, under the noise of the fit without humps."""
    size = plain.values.size + 2 * len(humps.joints)
    a, b = np.zeros((size, size)), np.zeros(size)
    blocks = _with_humps(streams, plain.blocks, humps)
    for block, sigma in zip(blocks, plain.sigmas, strict=True):
        weights = block.used / sigma
        rows = (block.x * weights[:, :, None]).reshape(-1, size)
        a += rows.T @ rows
        b += rows.T @ (block.y * weights).ravel()
    return a, b


def _with_humps(
    streams: Sequence[Conditioned], blocks: Sequence[Block], humps: Stribeck
) -> list[Block]:
    """Blocks with the columns of humps and of their speeds added."""
    count = len(humps.joints)
    added = []
    for stream, block in zip(streams, blocks, strict=True):
        slopes = stream.filtered(humps.slopes)
        more = np.zeros((*block.y.shape, 2 * count))
        for at, joint in enumerate(humps.joints):
            more[:, joint, [at, count + at]] = slopes[:, [at, count + at]]
        added.append(replace(block, x=np.concatenate([block.x, more], axis=2)))
    return added
