"""Noise levels from residuals: restricted maximum likelihood of variance components."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.linalg import covariance_root, gram, weighted_gram

# Standard deviations stay within these, in units of the residuals [rad and m].
LEAST_SIGMA, MOST_SIGMA = 1e-10, 1e2
_ITERATIONS = 60
# A step changes a sigma by a factor of e at most; 1e-4 of it is far below its own uncertainty.
_LONGEST_STEP, SETTLED = 1.0, 1e-4
_WORST_DAMPING = 1e6
# A step that gains less of the log-likelihood is a thousandth of the levels' own uncertainty.
_LITTLE = 1e-6
# Levels that all but vanish gain less than this by falling on, for each value that they are of,
# and curve hardly more than their variance does: they fall by longer steps.
HARDLY, _VARIANCES, _LONGEST_FALL = 0.1, 3.0, 2.0
# A gain is rarely so many times as large as the second order has it, for steps up to so long: a
# level three times as large as where the search began has gained thrice that.
_SURELY, _SHORT_STEP = 3.0, 0.5
# The root of twice the log-likelihood that a 95 % interval of one unknown gives away (chi-square),
# and how far and how exactly it is followed, in logarithms.
_SURPRISE_95, _FIRST_WIDTH, _WIDEST, _EXACT = 1.96, 0.125, 4.0, 0.02

# Logarithms of sizes of random effects that are compared lie so far apart.
_SIZE_STEP = 0.2
# Information of so small a share of what there was is rounding.
_ROUNDING = 1e-9

# Logarithms of the ratio of a value's variance to that of its measurement; and a share of a
# measurement that is not worth following.
_LIKELY_RANGE, _FOLLOWED = (-7.0, 12.0), 1e-2


@dataclass(frozen=True, eq=False)
class Components:
    """What the covariance of m residuals of size d is made of: `known + sum sigma_k^2 parts_k`.

    Attributes:
        known: (m, d, d) the part that needs no estimate.
        parts: (k, m, d) diagonals of what each component adds, at a standard deviation of one.
    """

    known: FloatArray
    parts: FloatArray

    def total(self, sigmas: FloatArray) -> FloatArray:
        """Covariances (m, d, d) of the residuals at some (k,) standard deviations."""
        added = np.tensordot(sigmas**2, self.parts, axes=1)
        return np.asarray(self.known + added[:, :, None] * np.eye(added.shape[1]))


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """What is known of p parameters from elsewhere.

    Attributes:
        information: (p, p), zero on those of which nothing is known.
        gradient: (p,) half the gradient of what is known, at the present state.
    """

    information: FloatArray
    gradient: FloatArray

    def beside(self, count: int) -> "PriorInformation":
        """The same with so many more parameters, the last ones, of which nothing is known."""
        return PriorInformation(
            np.pad(self.information, (0, count)), np.pad(self.gradient, (0, count))
        )


@dataclass(frozen=True, eq=False)
class LikelihoodValue:
    """Negative log-likelihood at some logarithms of the sigmas, its gradient and its curvature."""

    value: float
    gradient: FloatArray
    curvature: FloatArray


Found = TypeVar("Found", bound=LikelihoodValue)


@dataclass(frozen=True)
class RatioPrior:
    """What is known beforehand of the ratio of two sigmas, as a log-normal.

    Attributes:
        ratio: The second over the first, typically.
        log_sigma: Standard deviation of the ratio's logarithm.
        places: Which two sigmas these are; of several pairs, all of them.
    """

    ratio: float
    log_sigma: float
    places: tuple[tuple[int, int], ...] = ((0, 1),)

    def beside(self, found: "LikelihoodValue", logs: FloatArray) -> "LikelihoodValue":
        """The likelihood at some logarithms of all sigmas, with what is known of their ratios."""
        lean = np.zeros((len(self.places), len(logs)))
        for row, (first, second) in zip(lean, self.places, strict=True):
            row[first], row[second] = -1.0 / self.log_sigma, 1.0 / self.log_sigma
        offset = lean @ logs - np.log(self.ratio) / self.log_sigma
        return LikelihoodValue(
            found.value + 0.5 * float(offset @ offset),
            found.gradient + offset @ lean,
            found.curvature + lean.T @ lean,
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
    section 3), which accounts for the parameters that the residuals have been fitted with, by
    Newton's steps on the logarithms of the sigmas, and by Fisher's scoring where the likelihood is
    not convex: scoring alone takes fifty rounds where the residuals say little of a level. Start
    from above, and go down by short steps: a long one may end in a false optimum without any noise.

    Args:
        residuals: (m, d) at a state near the best one.
        jacobian: (m, d, p) their derivatives by the parameters.
        components: What the covariance is made of.
        known: What is known of the parameters from elsewhere.
        start: (k,) sigmas to start from.
        free: (k,) which of them to estimate; the others stay at their start.
        prior: Of the ratio of pairs of sigmas: it decides where the residuals cannot, because one
            kind of them can be fitted away altogether. None where nothing is known of it.
        least: Below which they are not sought: one for all, or (k,).
        settled: The step of the logarithms under which they have come to rest.
        enough: See `most_likely`.

    Returns:
        (k,) standard deviations, and the negative log-likelihood there.
    """
    low = np.broadcast_to(np.log(least), start.shape)
    logs = np.clip(np.log(np.maximum(start, LEAST_SIGMA)), low, np.log(MOST_SIGMA))
    low, high = np.where(free, low, logs), np.where(free, np.log(MOST_SIGMA), logs)

    def at(there: FloatArray) -> LikelihoodValue:
        return likelihood(residuals, jacobian, components, known, there, prior)

    logs, found = most_likely(at, logs, low, high, settled, enough)
    return np.asarray(np.exp(logs), dtype=float), found.value


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
    """Finds the most likely logarithms of levels, by damped steps of Newton.

    Args:
        at: The likelihood at some (k,) logarithms.
        logs: Where to start, within the limits.
        low: (k,) the least logarithms; what is closed is no less than its `high`.
        high: (k,) the largest ones.
        settled: The step under which they have come to rest, too.
        enough: Where steps do not seem to lead below this value, the search ends.
        little: What a step gains of the log-likelihood once they have come to rest.
        hardly: (k,) slopes under which levels may all but vanish; or one for all.

    Returns:
        The logarithms, and what is found there.
    """
    now, damping = at(logs), 1e-3
    for _ in range(_ITERATIONS):
        # What is at a limit and would go on is held there.
        free = np.where(now.gradient > 0.0, logs > low, logs < high) & (low < high)
        curvature = now.curvature + damping * np.diag(np.maximum(np.diag(now.curvature), 1.0))
        fading = (now.gradient > 0.0) & (now.gradient < hardly) & (damping < 1.0)
        falling = free & fading & (np.diag(now.curvature) < _VARIANCES * now.gradient)
        least = np.maximum(low - logs, np.where(falling, -_LONGEST_FALL, -_LONGEST_STEP))
        # A variance that falls to nothing moves all else like half a step of its logarithm.
        fall = np.where(falling, 0.5 * np.expm1(2.0 * least), 0.0)
        near = _bounded_step(
            now.gradient + curvature @ fall, curvature, np.where(free & ~falling, least, 0.0),
            np.where(free & ~falling, np.minimum(high - logs, _LONGEST_STEP), 0.0),
        )  # fmt: skip
        step = np.where(falling, least, near)
        candidate, moved = logs + step, np.abs(step).max(initial=0.0)
        gained = -float(near @ (now.gradient + now.curvature @ (fall + 0.5 * near)))
        gained += 0.5 * float(now.gradient[falling].sum())
        if damping < 1.0:
            if moved < settled or gained < little:
                logs = candidate
                break
            is_short = np.abs(near).max(initial=0.0) < _SHORT_STEP
            if is_short and now.value - _SURELY * gained > enough:
                break
        then = None
        # Of levels too far apart, one is lost in the rounding of the other.
        with suppress(np.linalg.LinAlgError):
            then = at(candidate)
        if then is not None and then.value <= now.value:
            logs, now, damping = candidate, then, max(damping / 10, 1e-6)
        else:  # Half a step at most is next.
            damping = max(10.0 * damping, 1.0)
        # Where no step goes down any more, rounding is all that is left.
        if moved < settled or damping > _WORST_DAMPING:
            break
    return logs, now


def _bounded_step(
    slope: FloatArray, curvature: FloatArray, least: FloatArray, most: FloatArray
) -> FloatArray:
    """Newton's step (k,) within bounds: where some of it would leave them, the rest follows."""
    step, bound = np.zeros(len(slope)), least == most
    for _ in range(len(slope)):
        rest = ~bound
        left = -(slope + curvature @ np.where(bound, step, 0.0))[rest]
        step[rest] = np.linalg.solve(curvature[np.ix_(rest, rest)], left)
        beyond = rest & ((step < least) | (step > most))
        if not beyond.any():
            break
        step, bound = np.clip(step, least, most), bound | beyond
    return step


def level_weight(gain: float) -> float:
    """How likely it is that a level is not zero (Akaike 1974: one more costs one of the logarithm).

    Args:
        gain: By how much twice the logarithm of the likelihood falls without it.
    """
    return float(1.0 / (1.0 + np.exp(1.0 - 0.5 * gain)))


def likely_sigma(found: FloatArray, covariance: FloatArray) -> float:
    """The size of k values that may be zero, averaged over their being so.

    Args:
        found: (k,) the values, as they were measured.
        covariance: (k, k) of that.

    Returns:
        The standard deviation under which the values would be expected where they are on average:
        those of restricted likelihood, and zero, each as likely as it is.
    """
    from scipy.optimize import minimize_scalar

    variances, axes = np.linalg.eigh(covariance)
    squares, typical = (axes.T @ found) ** 2, float(variances.mean())

    def unlikely(log: float) -> float:
        total = variances + typical * np.exp(log)
        return float(np.sum(np.log(total) + squares / total))

    best = minimize_scalar(unlikely, bounds=_LIKELY_RANGE, method="bounded")
    weight = level_weight(unlikely(-np.inf) - best.fun)
    ratio = float(np.exp(best.x))
    followed = weight * ratio / (1.0 + ratio)
    return float(np.sqrt(typical * followed / (1.0 - followed))) if followed > _FOLLOWED else 0.0


def profile_interval(
    profile: Callable[[float], float], sigma: float, lowest: float
) -> tuple[float, float]:
    """95 % interval of a standard deviation by its profile likelihood.

    Args:
        profile: The negative log-likelihood at a logarithm of the sigma.
        sigma: The most likely one.
        lowest: The negative log-likelihood there.

    Returns:
        Low and high: a low of zero where the residuals do not speak against no noise at all, and a
        high of fifty times the sigma where they do not speak against that.
    """
    middle = float(np.log(max(sigma, LEAST_SIGMA)))
    # A fit that rests at another maximum than the highest has its interval about that.
    here = profile(middle)
    if 2.0 * (here - lowest) > _SURPRISE_95**2:
        lowest = here

    def crossing(side: float, beyond: float) -> float:
        inner, outer, width = (0.0, 0.0), None, _FIRST_WIDTH
        while True:
            # It is about linear in the width.
            root = float(np.sqrt(max(2.0 * (profile(middle + side * width) - lowest), 0.0)))
            if root < _SURPRISE_95:
                inner = width, root
            else:
                outer = width, root
            if outer is not None:
                share = (_SURPRISE_95 - inner[1]) / (outer[1] - inner[1])
                then = inner[0] + share * (outer[0] - inner[0])
            elif width == _WIDEST:
                return beyond
            else:
                then = min(width * min(1.1 * _SURPRISE_95 / max(root, 1e-9), 4.0), _WIDEST)
            if not abs(then - width) >= _EXACT:
                return float(np.exp(middle + side * then))
            width = then

    return crossing(-1.0, 0.0), crossing(1.0, float(np.exp(middle + _WIDEST)))


@dataclass(frozen=True, eq=False)
class WeightedResiduals:
    """Residuals (m, d) weighed by some sigmas, and what the parameters leave of them.

    Attributes:
        sigmas: (k,) the sigmas.
        weights: (m, d, d) the inverse of the residuals' covariance.
        weighted: (m, d, p) their Jacobian times that.
        root: (p, p) the root of the parameters' covariance.
        pulled: (m, d) weighted residuals at the best parameters.
        value: The negative log-likelihood.
    """

    sigmas: FloatArray
    weights: FloatArray
    weighted: FloatArray
    root: FloatArray
    pulled: FloatArray
    value: float

    @classmethod
    def of(
        cls,
        residuals: FloatArray,
        jacobian: FloatArray,
        components: Components,
        known: PriorInformation,
        logs: FloatArray,
    ) -> "WeightedResiduals":
        """Weighs them by some logarithms of the sigmas; see `estimate_sigmas`."""
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
        """The most likely size of more random effects, all of one size, beside these sigmas.

        With the sigmas as they are, the likelihood of a size is a sum over the eigenvalues of the
        effects' information.

        Args:
            moved: (n, d, q) how some residuals move with the effects.
            among: (m,) which these are; no other moves.

        Returns:
            The size within a tenth, and by how much the log-likelihood grows with it; zero where
            none is likelier.
        """
        taken = self.root.T @ gram(self.weighted[among], moved)
        information = gram(moved, self.weights[among] @ moved) - taken.T @ taken
        values, vectors = np.linalg.eigh(information)
        # What the parameters take as a whole is rounding, and pulls at nothing.
        kept = values > _ROUNDING * np.trace(information + taken.T @ taken)
        values, vectors = values[kept], vectors[:, kept]
        squares = (gram(moved, self.pulled[among]) @ vectors) ** 2
        sizes = np.exp(np.arange(np.log(LEAST_SIGMA), np.log(MOST_SIGMA), _SIZE_STEP))[:, None]
        added = 1.0 + sizes**2 * values
        unlikely = 0.5 * np.sum(np.log(added) - sizes**2 * squares / added, axis=1)
        best = int(np.argmin(unlikely))
        return (
            (float(sizes[best, 0]), -float(unlikely[best])) if unlikely[best] < 0.0 else (0.0, 0.0)
        )


def likelihood(
    residuals: FloatArray,
    jacobian: FloatArray,
    components: Components,
    known: PriorInformation,
    logs: FloatArray,
    prior: RatioPrior | None,
) -> LikelihoodValue:
    """The restricted likelihood of some logarithms of the sigmas; see `estimate_sigmas`."""
    found, columns = (
        WeightedResiduals.of(residuals, jacobian, components, known, logs),
        jacobian.shape[-1],
    )
    weights, weighted, pulled = found.weights, found.weighted, found.pulled
    # How the residuals' covariance grows with the logarithm of each sigma.
    growth = 2 * found.sigmas[:, None, None] ** 2 * components.parts
    # What the parameters have taken of the weights, as y y^T.
    y = (weighted.reshape(-1, columns) @ found.root).reshape(weighted.shape)
    removed = y @ np.swapaxes(y, 1, 2)
    left_over = np.diagonal(weights - removed, axis1=1, axis2=2)
    asked = growth * pulled
    slope = 0.5 * np.einsum("kmi,mi->k", growth, left_over - pulled**2)
    # Traces of P G_k P G_l, where P is the weight less what the parameters have taken of it.
    shrunk = np.array([weighted_gram(y, value) for value in growth])
    crossed = growth[:, :, None, :] @ ((weights - 2.0 * removed) * weights)
    flat = shrunk.reshape(len(shrunk), -1)
    expected = 0.5 * (np.tensordot(crossed[:, :, 0], growth, axes=([1, 2], [1, 2])) + flat @ flat.T)
    # Products of y P G_k P G_l P y: with them the second derivative itself, not its expectation.
    answer = (weights @ asked[..., None])[..., 0]
    by_unknowns = asked.reshape(len(asked), -1) @ y.reshape(-1, columns)
    seen = np.einsum("kmi,lmi->kl", asked, answer) - by_unknowns @ by_unknowns.T
    curvature = seen - expected + 2.0 * np.diag(slope)
    if np.linalg.eigvalsh(curvature)[0] <= 0.0:
        curvature = expected
    likely = LikelihoodValue(found.value, slope, curvature)
    return likely if prior is None else prior.beside(likely, logs)
