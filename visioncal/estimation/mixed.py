"""One linear mixed model, whose sizes are estimated by restricted maximum likelihood (REML).

    r = J a + E v + n        n ~ N(0, known)        v_j ~ N(0, s_k^2)        a: flat or N(0, s_k^2)

`r` are residuals at a linearisation point, in units that share errors `v`; `a` are the unknowns
that all units have in common. The standard deviations `s_k` of unit errors, of common unknowns and
of noise are the sizes; each may be estimated (Patterson and Thompson 1971; in the form of Harville
1977, section 3), with average information as curvature (Gilmour, Thompson and Cullis 1995). Errors
of units are eliminated unit by unit, so that an evaluation is linear in the number of units.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import expit, logit

from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.linalg import NULL_SHARE, covariance_root, gram, inverse_roots, times_root

# Bounds of the standard deviations, in units of the residuals [rad and m].
LEAST_SIGMA, MOST_SIGMA = 1e-10, 1e2
# A step changes a sigma by a factor of e at most, unless it vanishes.
_LONGEST_STEP = 1.0
# A smaller gain of log-likelihood corresponds to a hundredth of the levels' uncertainty.
LITTLE = 2e-5
# Sizes near zero have a gradient below this, and at most this ratio of curvature to gradient (that
# of a variance is 2): they become zero at once.
_HARDLY, _VARIANCES = 0.1, 3.0
# The actual gain is rarely more than this multiple of the second-order prediction, for steps up to
# this length: at three times the initial level it is three times the prediction.
_SURELY, _SHORT_STEP = 3.0, 0.5
# Square root of the likelihood-ratio limit of a 95 % interval of one unknown.
SURPRISE_95 = float(np.sqrt(chi2_limit(0.05, 1)))
# First and largest half width and tolerance of its search, in logarithms of the sigma.
_FIRST_WIDTH, _WIDEST, _EXACT = 0.125, 4.0, 0.02


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


@dataclass(frozen=True, eq=False)
class SizePrior:
    """Log-normal priors: m linear functions of the sizes' logarithms, of variance one."""

    jacobian: FloatArray  # (m, k).
    mean: FloatArray  # (m,).

    @classmethod
    def of_ratios(
        cls, pairs: Sequence[tuple[int, int]], count: int, ratio: float, log_sigma: float
    ) -> "SizePrior":
        """Prior of the second size over the first, of some pairs among k sizes."""
        jacobian = np.zeros((len(pairs), count))
        for row, (first, second) in zip(jacobian, pairs, strict=True):
            row[first], row[second] = -1.0 / log_sigma, 1.0 / log_sigma
        return cls(jacobian, np.full(len(pairs), np.log(ratio) / log_sigma))

    def beside(self, typical: FloatArray, log_sigma: float) -> "SizePrior":
        """The same with g more sizes, of (g,) typical logarithms within `log_sigma`."""
        return SizePrior(
            np.asarray(block_diag(self.jacobian, np.eye(len(typical)) / log_sigma)),
            np.append(self.mean, typical / log_sigma),
        )

    def at(self, logs: FloatArray) -> LikelihoodValue:
        """Its negative logarithm."""
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
        return np.asarray(self.known + np.tensordot(squares, self.parts, axes=1))

    def white(self, logs: FloatArray) -> "WhiteUnits":
        """The units in units of their noise, at (k,) logarithms of the sizes."""
        whitening = inverse_roots(self.total(logs))
        residuals = (whitening @ self.residuals[:, :, None])[:, :, 0]
        return WhiteUnits(whitening, whitening @ self.jacobian, residuals)


@dataclass(frozen=True, eq=False)
class CommonRows:
    """Rows that depend on the common unknowns alone, by their products; a prior is one, too."""

    information: FloatArray  # (q, q) at a noise size of one.
    gradient: FloatArray  # (q,) product of their Jacobian and their residuals.
    cost: float = 0.0  # Squared residuals.
    rows: float = 0.0  # Number of rows.
    noise: int = -1  # Index of the size of their noise; -1 where their covariance is absolute.

    def beside(self, count: int) -> "CommonRows":
        """The same with `count` more unknowns, on which they do not depend."""
        return replace(
            self,
            information=np.pad(self.information, (0, count)),
            gradient=np.pad(self.gradient, (0, count)),
        )

    def left(self, values: FloatArray) -> tuple[FloatArray, float]:
        """(q,) gradient and squared residuals at (q,) values."""
        gradient = self.gradient - self.information @ values
        return gradient, self.cost - float(values @ (self.gradient + gradient))


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
    """Units and common rows, with q common unknowns and k sizes."""

    units: tuple[Units, ...]
    common: tuple[CommonRows, ...]
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
        gradient = np.zeros(len(self.shares))
        information = np.diag(gradient)
        information[is_random, is_random] = 1.0 / variances
        value, white = float(np.log(variances).sum()), []
        for unit in self.units:
            at = unit.white(logs)
            information += gram(at.jacobian, at.jacobian)
            gradient += gram(at.jacobian, at.residuals)
            value -= 2.0 * float(np.linalg.slogdet(at.whitening)[1].sum())
            white.append(at)
        for rows in self.common:
            weight = 1.0 if rows.noise < 0 else sizes[rows.noise] ** -2.0
            information += weight * rows.information
            gradient += weight * rows.gradient
            if rows.noise >= 0:
                value += 2.0 * rows.rows * float(logs[rows.noise])
        root = covariance_root(information)
        values = root @ (root.T @ gradient)
        value += float(np.sum(values[is_random] ** 2 / variances))
        value -= 2.0 * float(np.linalg.slogdet(root)[1])
        left = [replace(at, residuals=at.residuals - at.jacobian @ values) for at in white]
        value += sum(float(np.sum(at.residuals**2)) for at in left)
        for rows in self.common:
            weight = 1.0 if rows.noise < 0 else sizes[rows.noise] ** -2.0
            value += weight * rows.left(values)[1]
        flat = np.zeros(len(logs)), np.zeros((len(logs),) * 2)
        here = MixedEstimate(0.5 * value, *flat, logs, values, root)
        gradient, curvature = self._slopes(here, left) if is_sloped else flat
        if self.prior is not None:
            prior = self.prior.at(logs)
            gradient, curvature = gradient + prior.gradient, curvature + prior.curvature
            value += 2.0 * prior.value
        return replace(here, value=0.5 * value, gradient=gradient, curvature=curvature)

    def _slopes(
        self, here: MixedEstimate, white: Sequence[WhiteUnits]
    ) -> tuple[FloatArray, FloatArray]:
        """Gradient (k,) and average information (k, k) by the logarithms of the sizes."""
        variances, values, root = np.exp(2.0 * here.logs), here.values, here.root
        by_size = np.zeros(len(variances))
        is_random = self.shares.any(axis=1)
        own = self.shares[is_random] @ variances
        # Variance of each random unknown by each size.
        parts = self.shares[is_random] * variances
        posterior = np.sum(root[is_random] ** 2, axis=1) + values[is_random] ** 2
        by_size += (1.0 / own - posterior / own**2) @ parts
        # Working variates: derivatives of the covariance by the logarithm of each size, times the
        # weighted residuals. Their products, less what the unknowns absorb, are the information.
        along = np.zeros((len(values), len(variances)))
        along[is_random] = 2.0 * parts * (values[is_random] / own)[:, None]
        average, absorbed = np.zeros((len(variances),) * 2), np.zeros_like(along)
        for unit, at in zip(self.units, white, strict=True):
            back = np.swapaxes(at.whitening, 1, 2)
            fitted = times_root(at.jacobian, root)
            remaining = np.eye(fitted.shape[1]) - fitted @ np.swapaxes(fitted, 1, 2)
            remaining = back @ remaining @ at.whitening
            pulled = back @ at.residuals[:, :, None]
            pulls = (unit.parts @ pulled)[..., 0]
            traces = np.tensordot(unit.parts, remaining, axes=([1, 2, 3], [0, 1, 2]))
            squares = variances[unit.sizes]
            by_size[unit.sizes] += squares * (traces - np.sum(pulls * pulled[..., 0], axis=(1, 2)))
            working = at.jacobian @ along
            moved = at.whitening @ np.moveaxis(2.0 * squares[:, None, None] * pulls, 0, 2)
            working[:, :, unit.sizes] += moved
            average += gram(working, working)
            absorbed += gram(at.jacobian, working)
        for rows in self.common:
            weight = 1.0 if rows.noise < 0 else 1.0 / variances[rows.noise]
            rest, cost = rows.left(values)
            products = rows.information @ along
            average += weight * along.T @ products
            absorbed += weight * products
            if rows.noise < 0:
                continue
            trace = float(np.sum(root * (rows.information @ root)))
            by_size[rows.noise] += rows.rows - weight * (cost + trace)
            crossed = 2.0 * weight * rest @ along
            average[rows.noise] += crossed
            average[:, rows.noise] += crossed
            average[rows.noise, rows.noise] += 4.0 * weight * cost
            absorbed[:, rows.noise] += 2.0 * weight * rest
        projected = root.T @ absorbed
        return by_size, 0.5 * (average - projected.T @ projected)

    def likely_size(
        self, here: MixedEstimate, moved: FloatArray, among: Mask
    ) -> tuple[float, float]:
        """Maximum-likelihood size of more random unknowns of equal variance, beside an estimate.

        With the other sizes held, the likelihood of a size is a sum over the eigenvalues of the
        unknowns' information. `moved` is the (n, d, j) Jacobian of the n first units in the (u,)
        mask `among`. Returns the size within a tenth, and its gain of log-likelihood, or zeros.
        """
        own = self.units[0].white(here.logs)
        residuals = own.residuals - own.jacobian @ here.values
        moved = own.whitening[among] @ moved
        absorbed = here.root.T @ gram(own.jacobian[among], moved)
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
        enough: float = np.inf,
        little: float = LITTLE,
    ) -> MixedEstimate:
        """Finds the most likely sizes by damped Newton steps of their (k,) logarithms.

        The curvature is the average information, corrected by the changes of the gradient along
        the last steps (Dennis, Gay and Welsch 1981).

        Args:
            logs: (k,) initial logarithms.
            low: Lower bounds; equal to `high` for fixed sizes.
            high: Upper bounds.
            enough: The search ends once it is unlikely to reach a value below this.
            little: Predicted gain of log-likelihood below which the search has converged.
        """
        low, high = np.broadcast_to(low, logs.shape), np.broadcast_to(high, logs.shape)
        logs = np.clip(logs, low, high)
        # A prior of its ratio to another keeps a size from becoming zero at once.
        is_untied = np.ones(len(logs), dtype=bool)
        if self.prior is not None:
            is_untied &= ~self.prior.jacobian.any(axis=0)
        now, damping, correction = self.at(logs), 1e-3, np.zeros((len(logs),) * 2)
        for _ in range(60):
            # Levels at a bound that they would cross are held there.
            free = np.where(now.gradient > 0.0, logs > low, logs < high) & (low < high)
            second = now.curvature + correction
            curvature = second + damping * np.diag(np.maximum(np.diag(second), 1.0))
            near_zero = (now.gradient > 0.0) & (now.gradient < _HARDLY) & (damping < 1.0)
            vanishing = (
                free & is_untied & near_zero & (np.diag(now.curvature) < _VARIANCES * now.gradient)
            )
            moving, least = free & ~vanishing, low - logs
            # A vanishing variance affects the other levels like half a step of its logarithm.
            fall = np.where(vanishing, 0.5 * np.expm1(2.0 * least), 0.0)
            newton = _bounded_step(
                now.gradient + curvature @ fall, curvature,
                np.where(moving, np.maximum(least, -_LONGEST_STEP), 0.0),
                np.where(moving, np.minimum(high - logs, _LONGEST_STEP), 0.0),
            )  # fmt: skip
            step = np.where(vanishing, least, newton)
            predicted = -float(newton @ (now.gradient + second @ (fall + 0.5 * newton)))
            predicted += 0.5 * float(now.gradient[vanishing].sum())
            is_short = damping < 1.0 and np.abs(newton).max(initial=0.0) < _SHORT_STEP
            if predicted < little or (is_short and now.value - _SURELY * predicted > enough):
                break
            trial = None
            # Levels of very different size can make matrices numerically singular.
            with suppress(np.linalg.LinAlgError):
                trial = self.at(logs + step)
            if trial is not None and trial.value <= now.value:
                change = trial.gradient - now.gradient - now.curvature @ fall
                correction = _corrected(trial.curvature, correction, newton, change)
                logs, now, damping = logs + step, trial, max(damping / 10, 1e-6)
            else:  # The next step is at most half as long.
                damping = max(10.0 * damping, 1.0)
        return now


def _corrected(
    curvature: FloatArray, correction: FloatArray, step: FloatArray, change: FloatArray
) -> FloatArray:
    """A correction of the curvature by the gradient's change along a short step; or zero."""
    moved = step != 0.0
    if np.abs(step).max(initial=0.0) > _SHORT_STEP or not moved.any():
        return np.zeros_like(correction)
    inner = np.ix_(moved, moved)
    step, change, second = step[moved], change[moved], (curvature + correction)[inner]
    along = second @ step
    corrected = correction.copy()
    # The gradient has to change by a share of what is predicted at least; of exact data nothing is.
    if step @ change > 0.05 * (step @ along) > 0.0:
        corrected[inner] += np.outer(change, change) / (step @ change)
        corrected[inner] -= np.outer(along, along) / (step @ along)
    return corrected


def _bounded_step(
    gradient: FloatArray, curvature: FloatArray, least: FloatArray, most: FloatArray
) -> FloatArray:
    """Newton step (k,) within bounds: clipped components are fixed and the others solved anew."""
    step, bound = np.zeros(len(gradient)), least == most
    for _ in range(len(gradient)):
        rest = ~bound
        target = -(gradient + curvature @ np.where(bound, step, 0.0))[rest]
        step[rest] = np.linalg.solve(curvature[np.ix_(rest, rest)], target)
        violated = rest & ((step < least) | (step > most))
        if not violated.any():
            break
        step, bound = np.clip(step, least, most), bound | violated
    return step


def level_weight(gain: float, prior: float = 0.5) -> float:
    """Akaike weight of a non-zero level (Akaike 1974: each parameter costs 1 in log-likelihood).

    `gain` is the decrease of twice the log-likelihood without it, `prior` its prior probability.
    """
    return float(expit(0.5 * gain - 1.0 + logit(prior)))


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
        inner, outer, width = (0.0, 0.0), None, _FIRST_WIDTH
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
            if not abs(following - width) >= _EXACT:
                return float(np.exp(middle + side * following))
            width = following

    return crossing(-1.0, 0.0), crossing(1.0, float(np.exp(middle + _WIDEST)))
