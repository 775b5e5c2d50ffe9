"""Restricted maximum likelihood (REML) estimation of variance components."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.linalg import covariance_root, gram, weighted_gram

# Bounds of the standard deviations, in units of the residuals [rad and m].
LEAST_SIGMA, MOST_SIGMA = 1e-10, 1e2
_ITERATIONS = 60
# A step changes a sigma by a factor of e at most; a change of 1e-4 is far below its uncertainty.
_LONGEST_STEP, SETTLED = 1.0, 1e-4
_WORST_DAMPING = 1e6
# A smaller gain of log-likelihood corresponds to a thousandth of the levels' uncertainty.
_LITTLE = 1e-6
# Levels near zero have a gradient below this per value that they describe, and at most this ratio
# of curvature to gradient (that of a variance is 2): they decrease by longer steps.
HARDLY, _VARIANCES, _LONGEST_FALL = 0.1, 3.0, 2.0
# The actual gain is rarely more than this multiple of the second-order prediction, for steps up to
# this length: at three times the initial level it is three times the prediction.
_SURELY, _SHORT_STEP = 3.0, 0.5
# Square root of the likelihood-ratio limit of a 95 % interval of one unknown (chi-square); first
# and largest half width and tolerance of its search, in logarithms of the sigma.
_SURPRISE_95, _FIRST_WIDTH, _WIDEST, _EXACT = 1.96, 0.125, 4.0, 0.02

# Spacing of the grid over the logarithm of a random effect's size.
_SIZE_STEP = 0.2
# Eigenvalues of the remaining information below this share of the original trace are rounding.
_ROUNDING = 1e-9

# Bounds of the logarithm of the ratio of a value's variance to its measurement variance; shrinkage
# factor below which the value counts as zero.
_LIKELY_RANGE, _FOLLOWED = (-7.0, 12.0), 1e-2


@dataclass(frozen=True, eq=False)
class Components:
    """Variance components of m residuals of size d: `known + sum sigma_k^2 parts_k`."""

    known: FloatArray  # (m, d, d) known part of the covariance.
    parts: FloatArray  # (k, m, d) diagonal of each component at a standard deviation of one.

    def total(self, sigmas: FloatArray) -> FloatArray:
        """Covariances (m, d, d) of the residuals at (k,) standard deviations."""
        added = np.tensordot(sigmas**2, self.parts, axes=1)
        return np.asarray(self.known + added[:, :, None] * np.eye(added.shape[1]))


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """Gaussian prior of p parameters, linearised."""

    information: FloatArray  # (p, p), zero for parameters without a prior.
    gradient: FloatArray  # (p,) half the gradient of the prior cost at the current state.

    def beside(self, count: int) -> "PriorInformation":
        """The same with `count` parameters without a prior appended."""
        return PriorInformation(
            np.pad(self.information, (0, count)), np.pad(self.gradient, (0, count))
        )


@dataclass(frozen=True, eq=False)
class LikelihoodValue:
    """Negative log-likelihood with gradient and curvature by the logarithms of the sigmas."""

    value: float
    gradient: FloatArray
    curvature: FloatArray


Found = TypeVar("Found", bound=LikelihoodValue)


@dataclass(frozen=True)
class RatioPrior:
    """Log-normal prior of the ratio of two sigmas."""

    ratio: float  # Median of the second sigma over the first.
    log_sigma: float  # Standard deviation of the ratio's logarithm.
    # Indices of each pair of sigmas that the prior applies to.
    places: tuple[tuple[int, int], ...] = ((0, 1),)

    def beside(self, found: "LikelihoodValue", logs: FloatArray) -> "LikelihoodValue":
        """Adds the prior of the ratios to a likelihood at logarithms of all sigmas."""
        jacobian = np.zeros((len(self.places), len(logs)))
        for row, (first, second) in zip(jacobian, self.places, strict=True):
            row[first], row[second] = -1.0 / self.log_sigma, 1.0 / self.log_sigma
        offset = jacobian @ logs - np.log(self.ratio) / self.log_sigma
        return LikelihoodValue(
            found.value + 0.5 * float(offset @ offset),
            found.gradient + offset @ jacobian,
            found.curvature + jacobian.T @ jacobian,
        )


def estimate_sigmas(
    residuals: FloatArray,
    jacobian: FloatArray,
    components: Components,
    known: PriorInformation,
    start: FloatArray,
    free: Mask,
    prior: RatioPrior | None = None,
    least: FloatArray | float = LEAST_SIGMA,
    settled: float = SETTLED,
    enough: float = np.inf,
) -> tuple[FloatArray, float]:
    """Estimates the standard deviations of variance components.

    Maximises the restricted likelihood (Patterson and Thompson 1971; in the form of Harville 1977,
    section 3), which accounts for the parameters fitted to the residuals, by Newton steps on the
    logarithms of the sigmas, and by Fisher scoring where the negative log-likelihood is not convex:
    scoring alone takes fifty iterations where the residuals hardly determine a level. The search
    starts from above and takes short steps: a long one may end in a false optimum at zero noise.

    Args:
        residuals: (m, d) at a state near the optimum.
        jacobian: (m, d, p) of the residuals.
        components: The variance components.
        known: Prior of the parameters.
        start: (k,) initial sigmas.
        free: (k,) mask of the sigmas to estimate; the others keep their initial value.
        prior: Prior of the ratio of pairs of sigmas: it decides where the residuals cannot, because
            the parameters can absorb one kind of them entirely. None for no prior.
        least: Lower bound, scalar or (k,).
        settled: Step of the logarithms below which the search has converged.
        enough: See `most_likely`.

    Returns:
        (k,) standard deviations, and the negative log-likelihood there.
    """
    low = np.broadcast_to(np.log(least), start.shape)
    logs = np.clip(np.log(np.maximum(start, LEAST_SIGMA)), low, np.log(MOST_SIGMA))
    low, high = np.where(free, low, logs), np.where(free, np.log(MOST_SIGMA), logs)

    def at(sigma_logs: FloatArray) -> LikelihoodValue:
        return likelihood(residuals, jacobian, components, known, sigma_logs, prior)

    logs, optimum = most_likely(at, logs, low, high, settled, enough)
    return np.asarray(np.exp(logs), dtype=float), optimum.value


def most_likely(
    at: Callable[[FloatArray], Found],
    logs: FloatArray,
    low: FloatArray,
    high: FloatArray,
    settled: float = SETTLED,
    enough: float = np.inf,
    little: float = _LITTLE,
    hardly: FloatArray | float = HARDLY,
) -> tuple[FloatArray, Found]:
    """Finds the maximum-likelihood logarithms of levels by damped Newton steps.

    Args:
        at: Evaluates the likelihood at (k,) logarithms.
        logs: (k,) initial logarithms, within the bounds.
        low: (k,) lower bounds; equal to `high` for fixed levels.
        high: (k,) upper bounds.
        settled: Step below which the search has converged.
        enough: The search ends once it is unlikely to reach a value below this.
        little: Predicted gain of log-likelihood below which the search has converged, too.
        hardly: Gradient below which a level may be near zero, scalar or (k,).

    Returns:
        The logarithms, and the likelihood there.
    """
    now, damping = at(logs), 1e-3
    for _ in range(_ITERATIONS):
        # Levels at a bound that they would cross are held there.
        free = np.where(now.gradient > 0.0, logs > low, logs < high) & (low < high)
        curvature = now.curvature + damping * np.diag(np.maximum(np.diag(now.curvature), 1.0))
        near_zero = (now.gradient > 0.0) & (now.gradient < hardly) & (damping < 1.0)
        vanishing = free & near_zero & (np.diag(now.curvature) < _VARIANCES * now.gradient)
        least = np.maximum(low - logs, np.where(vanishing, -_LONGEST_FALL, -_LONGEST_STEP))
        # A vanishing variance affects the other levels like half a step of its logarithm.
        fall = np.where(vanishing, 0.5 * np.expm1(2.0 * least), 0.0)
        newton = _bounded_step(
            now.gradient + curvature @ fall, curvature, np.where(free & ~vanishing, least, 0.0),
            np.where(free & ~vanishing, np.minimum(high - logs, _LONGEST_STEP), 0.0),
        )  # fmt: skip
        step = np.where(vanishing, least, newton)
        candidate, length = logs + step, np.abs(step).max(initial=0.0)
        predicted = -float(newton @ (now.gradient + now.curvature @ (fall + 0.5 * newton)))
        predicted += 0.5 * float(now.gradient[vanishing].sum())
        if damping < 1.0:
            if length < settled or predicted < little:
                logs = candidate
                break
            is_short = np.abs(newton).max(initial=0.0) < _SHORT_STEP
            if is_short and now.value - _SURELY * predicted > enough:
                break
        trial = None
        # Levels of very different size can make matrices numerically singular.
        with suppress(np.linalg.LinAlgError):
            trial = at(candidate)
        if trial is not None and trial.value <= now.value:
            logs, now, damping = candidate, trial, max(damping / 10, 1e-6)
        else:  # The next step is at most half as long.
            damping = max(10.0 * damping, 1.0)
        # If no step lowers the value any more, only rounding is left.
        if length < settled or damping > _WORST_DAMPING:
            break
    return logs, now


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


def level_weight(gain: float) -> float:
    """Akaike weight of a non-zero level (Akaike 1974: each parameter costs 1 in log-likelihood).

    Args:
        gain: Decrease of twice the log-likelihood without the level.
    """
    return float(1.0 / (1.0 + np.exp(1.0 - 0.5 * gain)))


def likely_sigma(found: FloatArray, covariance: FloatArray) -> float:
    """Model-averaged standard deviation of k values that may be zero.

    Args:
        found: (k,) measured values.
        covariance: (k, k) of the measurement.

    Returns:
        The prior standard deviation that gives the average of the shrinkage at the most likely
        size and at zero, weighted by their Akaike weights.
    """
    from scipy.optimize import minimize_scalar

    variances, axes = np.linalg.eigh(covariance)
    squares, typical = (axes.T @ found) ** 2, float(variances.mean())

    def deviance(log_ratio: float) -> float:
        total = variances + typical * np.exp(log_ratio)
        return float(np.sum(np.log(total) + squares / total))

    best = minimize_scalar(deviance, bounds=_LIKELY_RANGE, method="bounded")
    weight = level_weight(deviance(-np.inf) - best.fun)
    ratio = float(np.exp(best.x))
    shrinkage = weight * ratio / (1.0 + ratio)
    return float(np.sqrt(typical * shrinkage / (1.0 - shrinkage))) if shrinkage > _FOLLOWED else 0.0


def profile_interval(
    profile: Callable[[float], float], sigma: float, lowest: float
) -> tuple[float, float]:
    """95 % interval of a standard deviation by its profile likelihood.

    Args:
        profile: Negative log-likelihood as a function of the logarithm of the sigma.
        sigma: The maximum-likelihood estimate.
        lowest: Negative log-likelihood there.

    Returns:
        Low and high: low is zero if the residuals do not exclude zero noise, and high is about
        fifty times the sigma if they do not exclude that.
    """
    middle = float(np.log(max(sigma, LEAST_SIGMA)))
    # A fit at a local maximum has its interval about that maximum.
    local = profile(middle)
    if 2.0 * (local - lowest) > _SURPRISE_95**2:
        lowest = local

    def crossing(side: float, limit: float) -> float:
        inner, outer, width = (0.0, 0.0), None, _FIRST_WIDTH
        while True:
            # The root is about linear in the width.
            root = float(np.sqrt(max(2.0 * (profile(middle + side * width) - lowest), 0.0)))
            if root < _SURPRISE_95:
                inner = width, root
            else:
                outer = width, root
            if outer is not None:
                fraction = (_SURPRISE_95 - inner[1]) / (outer[1] - inner[1])
                next_width = inner[0] + fraction * (outer[0] - inner[0])
            elif width == _WIDEST:
                return limit
            else:
                next_width = min(width * min(1.1 * _SURPRISE_95 / max(root, 1e-9), 4.0), _WIDEST)
            if not abs(next_width - width) >= _EXACT:
                return float(np.exp(middle + side * next_width))
            width = next_width

    return crossing(-1.0, 0.0), crossing(1.0, float(np.exp(middle + _WIDEST)))


@dataclass(frozen=True, eq=False)
class WeightedResiduals:
    """Generalised least-squares fit of residuals (m, d) at given sigmas."""

    sigmas: FloatArray  # (k,) the sigmas.
    weights: FloatArray  # (m, d, d) inverse covariance of the residuals.
    weighted: FloatArray  # (m, d, p) weights times the Jacobian.
    root: FloatArray  # (p, p) square root of the parameters' covariance.
    pulled: FloatArray  # (m, d) weighted residuals at the fitted parameters.
    value: float  # Negative log-likelihood.

    @classmethod
    def of(
        cls,
        residuals: FloatArray,
        jacobian: FloatArray,
        components: Components,
        known: PriorInformation,
        logs: FloatArray,
    ) -> "WeightedResiduals":
        """Fits the parameters at given logarithms of the sigmas; see `estimate_sigmas`."""
        sigmas = np.exp(logs)
        total = components.total(sigmas)
        weights = np.asarray(np.linalg.inv(total), dtype=float)
        weighted = weights @ jacobian
        root = covariance_root(gram(jacobian, weighted) + known.information)
        gradient = gram(weighted, residuals) + known.gradient
        best = root @ (root.T @ gradient)
        left = residuals - jacobian @ best
        pulled = (weights @ left[:, :, None])[:, :, 0]
        value = 0.5 * float(
            np.linalg.slogdet(total)[1].sum()
            - 2.0 * np.linalg.slogdet(root)[1]
            + np.einsum("mi,mi->", left, pulled)
            + best @ (known.information @ best - 2 * known.gradient)
        )
        return cls(sigmas, weights, weighted, root, pulled, value)

    def likely_size(self, moved: FloatArray, among: Mask) -> tuple[float, float]:
        """Maximum-likelihood size of additional random effects of equal variance.

        With the sigmas held, the likelihood of a size is a sum over the eigenvalues of the effects'
        information.

        Args:
            moved: (n, d, q) Jacobian of the affected residuals by the effects.
            among: (m,) mask of the n affected residuals.

        Returns:
            The size within a tenth, and the gain of log-likelihood; zeros if no size gains any.
        """
        absorbed = self.root.T @ gram(self.weighted[among], moved)
        information = gram(moved, self.weights[among] @ moved) - absorbed.T @ absorbed
        values, vectors = np.linalg.eigh(information)
        # Directions that the parameters absorb entirely hold rounding only.
        kept = values > _ROUNDING * np.trace(information + absorbed.T @ absorbed)
        values, vectors = values[kept], vectors[:, kept]
        squares = (gram(moved, self.pulled[among]) @ vectors) ** 2
        sizes = np.exp(np.arange(np.log(LEAST_SIGMA), np.log(MOST_SIGMA), _SIZE_STEP))[:, None]
        added = 1.0 + sizes**2 * values
        change = 0.5 * np.sum(np.log(added) - sizes**2 * squares / added, axis=1)
        best = int(np.argmin(change))
        return (float(sizes[best, 0]), -float(change[best])) if change[best] < 0.0 else (0.0, 0.0)


def likelihood(
    residuals: FloatArray,
    jacobian: FloatArray,
    components: Components,
    known: PriorInformation,
    logs: FloatArray,
    prior: RatioPrior | None,
) -> LikelihoodValue:
    """Restricted likelihood at logarithms of the sigmas; see `estimate_sigmas`."""
    fit, columns = (
        WeightedResiduals.of(residuals, jacobian, components, known, logs),
        jacobian.shape[-1],
    )
    weights, weighted, pulled = fit.weights, fit.weighted, fit.pulled
    # Derivatives G_k of the residuals' covariance by the logarithm of each sigma (diagonal).
    growth = 2 * fit.sigmas[:, None, None] ** 2 * components.parts
    # Part of the weights absorbed by the parameters, absorbed_root absorbed_root^T.
    absorbed_root = (weighted.reshape(-1, columns) @ fit.root).reshape(weighted.shape)
    absorbed = absorbed_root @ np.swapaxes(absorbed_root, 1, 2)
    remaining = np.diagonal(weights - absorbed, axis1=1, axis2=2)
    scaled = growth * pulled
    gradient = 0.5 * np.einsum("kmi,mi->k", growth, remaining - pulled**2)
    # Traces of P G_k P G_l, where P is the weights less the part absorbed by the parameters.
    products = np.array([weighted_gram(absorbed_root, value) for value in growth])
    cross = growth[:, :, None, :] @ ((weights - 2.0 * absorbed) * weights)
    flat = products.reshape(len(products), -1)
    expected = 0.5 * (np.tensordot(cross[:, :, 0], growth, axes=([1, 2], [1, 2])) + flat @ flat.T)
    # Products r P G_k P G_l P r of the residuals: they give the observed second derivative, not its
    # expectation.
    answer = (weights @ scaled[..., None])[..., 0]
    by_parameters = scaled.reshape(len(scaled), -1) @ absorbed_root.reshape(-1, columns)
    observed = np.einsum("kmi,lmi->kl", scaled, answer) - by_parameters @ by_parameters.T
    curvature = observed - expected + 2.0 * np.diag(gradient)
    if np.linalg.eigvalsh(curvature)[0] <= 0.0:
        curvature = expected
    at_sigmas = LikelihoodValue(fit.value, gradient, curvature)
    return at_sigmas if prior is None else prior.beside(at_sigmas, logs)
