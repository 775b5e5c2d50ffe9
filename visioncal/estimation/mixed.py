"""One linear mixed model, whose sizes are estimated by restricted maximum likelihood (REML).

    r = J a + E v + n        n ~ N(0, known)        v_j ~ N(0, s_k^2)        a: flat or N(0, s_k^2)

`r` are residuals at a linearisation point, in units that share errors `v`; `a` are the unknowns
that all units have in common. The standard deviations `s_k` of unit errors, of common unknowns and
of noise are the sizes; each may be estimated (Patterson and Thompson 1971; in the form of Harville
1977, section 3), with average information as curvature (Gilmour, Thompson and Cullis 1995). Errors
of units are eliminated unit by unit, so that an evaluation is linear in the number of units.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.linalg import (
    LEAST_SIGMA,
    MOST_SIGMA,
    NULL_SHARE,
    ROUNDING,
    covariance_root,
    gram,
    inverse_roots,
    times_root,
)
from visioncal.core.quantiles import SURPRISE_95
from visioncal.core.types import FloatArray, IntArray, Mask

# Typical translation to rotation noise of arms and cameras [m/rad]: median, and standard deviation
# of its logarithm, a factor of five.
TYPICAL_RATIO, RATIO_LOG_SIGMA = 0.6, 1.5
# Most change of a size's logarithm in one step.
_LONGEST_STEP = 1.5
# A smaller gain of log-likelihood corresponds to a hundredth of the levels' uncertainty.
LITTLE = 2e-5
# Largest half width of the search of a crossing, in logarithms of the sigma.
_WIDEST = 4.0


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """Gaussian prior of p parameters, linearised."""

    information: FloatArray  # (p, p), zero for parameters without a prior.
    gradient: FloatArray  # (p,) half the gradient of the prior cost at the current state.
    cost: float = 0.0  # The prior cost there, up to a constant.

    @classmethod
    def flat(cls, count: int) -> "PriorInformation":
        """Zero information on some parameters."""
        return cls(np.zeros((count, count)), np.zeros(count))


@dataclass(frozen=True, eq=False)
class LikelihoodValue:
    """Negative log-likelihood with gradient and curvature by the logarithms of the sigmas."""

    value: float
    gradient: FloatArray
    curvature: FloatArray


class _Likelihood(Protocol):
    """A likelihood with slopes by the (k,) logarithms of sizes."""

    @property
    def logs(self) -> FloatArray: ...
    @property
    def value(self) -> float: ...
    @property
    def gradient(self) -> FloatArray: ...
    @property
    def curvature(self) -> FloatArray: ...


_Estimate = TypeVar("_Estimate", bound=_Likelihood)


@dataclass(frozen=True, eq=False)
class SizePrior:
    """Log-normal priors: m linear functions of the sizes' logarithms, of variance one."""

    jacobian: FloatArray  # (m, k).
    mean: FloatArray  # (m,).

    @classmethod
    def of_ratios(cls, pairs: Sequence[tuple[int, int]], count: int) -> "SizePrior":
        """Prior of the second size over the first, of some pairs among k sizes."""
        jacobian = np.zeros((len(pairs), count))
        for row, (first, second) in zip(jacobian, pairs, strict=True):
            row[first], row[second] = -1.0 / RATIO_LOG_SIGMA, 1.0 / RATIO_LOG_SIGMA
        return cls(jacobian, np.full(len(pairs), np.log(TYPICAL_RATIO) / RATIO_LOG_SIGMA))

    def with_sizes(self, typical: FloatArray, log_sigma: float) -> "SizePrior":
        """The prior with g more sizes, of (g,) typical logarithms within `log_sigma`."""
        return SizePrior(
            np.asarray(block_diag(self.jacobian, np.eye(len(typical)) / log_sigma)),
            np.append(self.mean, typical / log_sigma),
        )

    def at(self, logs: FloatArray) -> LikelihoodValue:
        """The prior's negative logarithm."""
        offset = self.jacobian @ logs - self.mean
        return LikelihoodValue(
            0.5 * float(offset @ offset), offset @ self.jacobian, self.jacobian.T @ self.jacobian
        )


@dataclass(frozen=True, eq=False)
class Units:
    """u units of d rows each, whose errors are independent of those of other units."""

    residuals: FloatArray  # (u, d).
    jacobian: FloatArray  # (u, d, q) by the common unknowns.
    known: FloatArray  # (u, d, d) covariance whose size is known.
    parts: FloatArray  # (j, u, d, d) covariance by each of j sizes, at a size of one.
    sizes: IntArray  # (j,) indices of these sizes.

    def total(self, logs: FloatArray) -> FloatArray:
        """Covariances (u, d, d) of the residuals at (k,) logarithms of the sizes."""
        squares = np.exp(2.0 * logs[self.sizes])
        # One product of matrices: NumPy's `tensordot` takes as long again for its axes.
        parts = squares @ self.parts.reshape(len(squares), math.prod(self.known.shape))
        return np.asarray(self.known + parts.reshape(self.known.shape))

    def white(self, logs: FloatArray) -> "WhiteUnits":
        """The units in units of their noise, at (k,) logarithms of the sizes."""
        whitening = inverse_roots(self.total(logs))
        residuals = (whitening @ self.residuals[:, :, None])[:, :, 0]
        return WhiteUnits(whitening, whitening @ self.jacobian, residuals)


@dataclass(frozen=True, eq=False)
class WhiteUnits:
    """Units at some sizes, in units of their noise."""

    whitening: FloatArray  # (u, d, d) inverse roots of the residuals' covariance.
    jacobian: FloatArray  # (u, d, q).
    residuals: FloatArray  # (u, d) at the most likely common unknowns.


@dataclass(frozen=True, eq=False)
class MixedEstimate(LikelihoodValue):
    """The restricted likelihood at some sizes, and the most likely common unknowns there."""

    logs: FloatArray  # (k,) logarithms of the sizes.
    values: FloatArray  # (q,) best linear unbiased prediction of the common unknowns.
    root: FloatArray  # (q, q) root of their covariance `root @ root^T`.


@dataclass(frozen=True, eq=False)
class MixedModel:
    """Units with q common unknowns, and k sizes."""

    units: Units
    # Of the common unknowns, by all else; its gradient is the pull (q,) of its residuals.
    common: PriorInformation
    # (q, k) variance of each common unknown by the square of each size; zeros where it is flat.
    shares: FloatArray
    # Prior of the sizes: it decides where the residuals cannot, because the common unknowns can
    # absorb one kind of them entirely.
    prior: SizePrior | None = None

    def at(self, logs: FloatArray, *, is_sloped: bool = True) -> MixedEstimate:
        """The likelihood at (k,) logarithms of the sizes; without slopes, these are zero."""
        sizes = np.exp(logs)
        is_random = self.shares.any(axis=1)
        variances = (self.shares @ sizes**2)[is_random]
        at, known = self.units.white(logs), self.common
        information = known.information + gram(at.jacobian, at.jacobian)
        information[is_random, is_random] += 1.0 / variances
        root = covariance_root(information)
        values = root @ (root.T @ (known.gradient + gram(at.jacobian, at.residuals)))
        left = WhiteUnits(at.whitening, at.jacobian, at.residuals - at.jacobian @ values)
        value = float(np.log(variances).sum() + np.sum(values[is_random] ** 2 / variances))
        value -= 2.0 * float(np.linalg.slogdet(at.whitening)[1].sum() + np.linalg.slogdet(root)[1])
        value += float(np.sum(left.residuals**2))
        value -= float(values @ (2.0 * known.gradient - known.information @ values))
        gradient, curvature = np.zeros(len(logs)), np.zeros((len(logs),) * 2)
        if is_sloped:
            gradient, curvature = self._slopes(logs, values, root, left)
        if self.prior is not None:
            prior = self.prior.at(logs)
            gradient, curvature = gradient + prior.gradient, curvature + prior.curvature
            value += 2.0 * prior.value
        return MixedEstimate(0.5 * value, gradient, curvature, logs, values, root)

    def _slopes(
        self, logs: FloatArray, values: FloatArray, root: FloatArray, at: WhiteUnits
    ) -> tuple[FloatArray, FloatArray]:
        """Gradient (k,) and average information (k, k) by the logarithms of the sizes."""
        variances = np.exp(2.0 * logs)
        by_size, unit = np.zeros(len(variances)), self.units
        is_random = self.shares.any(axis=1)
        random_variances = self.shares[is_random] @ variances
        # Variance of each random unknown by each size.
        parts = self.shares[is_random] * variances
        posterior = np.sum(root[is_random] ** 2, axis=1) + values[is_random] ** 2
        by_size += (1.0 / random_variances - posterior / random_variances**2) @ parts
        # Working variates: derivatives of the covariance by the logarithm of each size, times the
        # weighted residuals. The variates' products, less what the unknowns absorb, are the
        # information.
        along = np.zeros((len(values), len(variances)))
        along[is_random] = 2.0 * parts * (values[is_random] / random_variances)[:, None]
        back = np.swapaxes(at.whitening, 1, 2)
        fitted = times_root(at.jacobian, root)
        remaining = np.eye(fitted.shape[1]) - fitted @ np.swapaxes(fitted, 1, 2)
        remaining = back @ remaining @ at.whitening
        pulled = back @ at.residuals[:, :, None]
        pulls = (unit.parts @ pulled)[..., 0]
        traces = unit.parts.reshape(len(unit.parts), remaining.size) @ remaining.ravel()
        squares = variances[unit.sizes]
        by_size[unit.sizes] += squares * (traces - np.sum(pulls * pulled[..., 0], axis=(1, 2)))
        working = at.jacobian @ along
        working[:, :, unit.sizes] += at.whitening @ (2.0 * squares * pulls.transpose(1, 2, 0))
        products = self.common.information @ along
        average = gram(working, working) + along.T @ products
        projected = root.T @ (gram(at.jacobian, working) + products)
        return by_size, 0.5 * (average - projected.T @ projected)

    def likely_size(
        self, estimate: MixedEstimate, moved: FloatArray, among: Mask
    ) -> tuple[float, float]:
        """Maximum-likelihood size of more random unknowns of equal variance, beside an estimate.

        With the other sizes held, the likelihood of a size is a sum over the eigenvalues of the
        unknowns' information. `moved` is the (n, d, j) Jacobian of the n units in the (u,)
        mask `among`. Returns the size within a tenth, and its gain of log-likelihood, or zeros.
        """
        white = self.units.white(estimate.logs)
        residuals = white.residuals - white.jacobian @ estimate.values
        moved = white.whitening[among] @ moved
        absorbed = estimate.root.T @ gram(white.jacobian[among], moved)
        information = gram(moved, moved) - absorbed.T @ absorbed
        values, vectors = np.linalg.eigh(information)
        # Directions that the parameters absorb entirely hold rounding only.
        kept = values > NULL_SHARE * np.trace(information + absorbed.T @ absorbed)
        values, vectors = values[kept], vectors[:, kept]
        squares = (gram(moved, residuals[among]) @ vectors) ** 2
        sizes = np.exp(np.arange(np.log(LEAST_SIGMA), np.log(MOST_SIGMA), 0.2))[:, None]
        added = 1.0 + sizes**2 * values
        change = 0.5 * np.sum(np.log(added) - sizes**2 * squares / added, axis=1)
        best = int(np.argmin(change))
        return (float(sizes[best, 0]), -float(change[best])) if change[best] < 0.0 else (0.0, 0.0)

    def maximised(
        self,
        logs: FloatArray,
        low: FloatArray | float,
        high: FloatArray | float,
        little: float = LITTLE,
    ) -> MixedEstimate:
        """Finds the most likely sizes from (k,) initial logarithms; see `maximised`."""
        low, high = np.broadcast_to(low, logs.shape), np.broadcast_to(high, logs.shape)
        return maximised(self.at, logs, low, high, little)[0]


def maximised(
    at: Callable[[FloatArray], _Estimate],
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    little: float,
) -> tuple[_Estimate, int]:
    """Finds the most likely sizes by damped Newton steps of their (k,) logarithms.

    The curvature is the average information, no direction's below a share of that of each size
    alone (Levenberg 1944).

    Args:
        at: The negative log-likelihood with its slopes, at (k,) logarithms.
        start: (k,) where the search begins.
        low: (k,) lower bounds; equal to `high` for sizes that are held.
        high: (k,) upper bounds.
        little: Gain that is negligible.

    Returns:
        The estimate, and how many likelihoods it took.
    """
    found, count, damping = at(np.clip(start, low, high)), 1, 0.0
    # Most steps.
    for _ in range(60):
        # Sizes at a bound that they would cross are held there.
        inside = (high > low) & ~((found.logs <= low) & (found.gradient > 0.0))
        inside &= ~((found.logs >= high) & (found.gradient < 0.0))
        step, promised = _step(found, np.flatnonzero(inside), damping)
        if promised < little:
            break
        trial, count = None, count + 1
        # Sizes of very different magnitude can make matrices numerically singular.
        with suppress(np.linalg.LinAlgError):
            trial = at(np.clip(found.logs + step, low, high))
        if trial is not None and trial.value < found.value:
            found, damping = trial, damping / 10.0 if damping > 1e-2 else 0.0
        else:
            damping = max(10.0 * damping, 1.0)
    return found, count


def _step(found: _Likelihood, inside: IntArray, damping: float) -> tuple[FloatArray, float]:
    """A damped Newton step (k,) of some sizes, none longer than the longest, and what it promises.

    Clipped components are fixed, and the others are solved anew: a size that vanishes goes far. The
    average information may be indefinite: all solve the one matrix that is not.
    """
    step, slope = np.zeros(len(found.logs)), found.gradient[inside]
    curvature = found.curvature[inside[:, None], inside]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 1e-8))
    values, vectors = np.linalg.eigh(curvature * np.outer(scale, scale))
    # Beside a direction that is steeper by far, one that is flat would be rounding: the curvature
    # is at least so much of that of each size alone.
    flat = max(0.1, ROUNDING * float(values.max(initial=0.0)))
    values, slope = np.maximum(values, flat) + damping, scale * slope
    along = slope @ vectors
    promised, moved = 0.5 * float(along @ (along / values)), -(vectors @ (along / values))
    beyond = np.abs(scale * moved) > _LONGEST_STEP
    if not beyond.any():
        step[inside] = scale * moved
        return step, promised
    moved, rest = np.clip(moved, -_LONGEST_STEP / scale, _LONGEST_STEP / scale), ~beyond
    curvature = (vectors * values) @ vectors.T
    while rest.any():
        pull = (slope + curvature @ np.where(rest, 0.0, moved))[rest]
        moved[rest] = -np.linalg.solve(curvature[rest][:, rest], pull)
        beyond = rest & (np.abs(scale * moved) > _LONGEST_STEP)
        if not beyond.any():
            break
        moved, rest = np.clip(moved, -_LONGEST_STEP / scale, _LONGEST_STEP / scale), rest & ~beyond
    step[inside] = scale * moved
    return step, promised


def profile_interval(
    profile: Callable[[float], float], sigma: float, lowest: float
) -> tuple[float, float]:
    """95 % interval of a standard deviation by its negative log-likelihood, `lowest` at `sigma`.

    The low end is zero if the residuals do not exclude zero noise, and the high one about fifty
    times the sigma if they do not exclude that. `profile` is by the logarithm of the sigma.
    """
    middle = float(np.log(max(sigma, LEAST_SIGMA)))
    # A fit at a local maximum has its interval about that maximum.
    local = profile(middle)
    if 2.0 * (local - lowest) > SURPRISE_95**2:
        lowest = local

    def crossing(side: float, limit: float) -> float:
        inner, outer, width = (0.0, 0.0), None, 0.125
        while True:
            # The root is about linear in the width; between two widths that enclose it.
            root = float(np.sqrt(max(2.0 * (profile(middle + side * width) - lowest), 0.0)))
            if root < SURPRISE_95:
                inner = width, root
            else:
                outer = width, root
            if outer is not None:
                share = (SURPRISE_95 - inner[1]) / (outer[1] - inner[1])
                following = inner[0] + share * (outer[0] - inner[0])
            elif width == _WIDEST:
                return limit
            else:
                following = min(width * min(1.1 * SURPRISE_95 / max(root, 1e-9), 4.0), _WIDEST)
            # Tolerance of the half width, in logarithms of the sigma.
            if not abs(following - width) >= 0.02:
                return float(np.exp(middle + side * following))
            width = following

    return crossing(-1.0, 0.0), crossing(1.0, float(np.exp(middle + _WIDEST)))
