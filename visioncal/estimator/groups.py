"""Least squares over small groups of residuals, each of which is right or wrong as a whole.

A group is one touch of a tool or one measured point: a few residuals [m] that share one error. The
covariance of a group is what is known of it beforehand, plus one unknown level of noise per axis:
`known + sigma^2 I`, with sigma by restricted maximum likelihood. Which groups agree starts from a
consensus of small sets under the least median (Rousseeuw 1984), and is settled by F tests on
deletion residuals (Cook and Weisberg 1982, section 2.2), one group at a time.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import comb
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from visioncal.estimator.descend import Linearised, descend
from visioncal.estimator.linalg import covariance, damped_step, spectrum, squared_lengths
from visioncal.estimator.variance import (
    LEAST_SIGMA,
    Components,
    Knowledge,
    estimate_sigmas,
    profile_interval,
)
from visioncal.types import FloatArray, IntArray, Mask

State = TypeVar("State")

# For each number of groups that may be left out, noise leaves sound ones out in one set of a
# thousand.
_FALSE_ALARM = 1e-3
# With 40 % of the groups wrong, all 60 sets of three contain a wrong one with probability 3e-7.
_SETS = 60
_REFINED, _ROUNDS = 5, 10
_SETTLED = 1e-10
# Where fewer than this share of the groups agree, nothing tells which of them are right.
_LEAST_SHARE = 0.5
# One group is called wrong when that is so many times as likely as any other being it.
_ODDS = 100.0
# Under this scaled eigenvalue ratio the groups do not determine a direction.
_OPEN_RATIO = 1e-10
# Noise levels are started from above: at least here [m].
_START_SIGMA = 5e-4


@dataclass(frozen=True, eq=False)
class Groups:
    """A problem at one state: m groups of up to d residuals, which p unknowns explain.

    Attributes:
        residuals: (m, d) [m], zero where not observed.
        jacobian: (m, d, p) their derivatives by the unknowns' steps, zero where not observed.
        observed: (m, d) mask of the residuals that there are: groups may be smaller than d.
        known: (m, d, d) covariance that is known beforehand [m^2]; zeros where nothing is.
    """

    residuals: FloatArray
    jacobian: FloatArray
    observed: Mask
    known: FloatArray

    def __len__(self) -> int:
        return len(self.residuals)

    def subset(self, chosen: Mask) -> "Groups":
        """Returns the groups of an (m,) mask."""
        return Groups(
            self.residuals[chosen],
            self.jacobian[chosen],
            self.observed[chosen],
            self.known[chosen],
        )

    def spread(self, sigma: float) -> FloatArray:
        """Covariances (m, d, d) at a level of noise [m]; one where nothing was observed."""
        return self._components().total(np.array([sigma]))

    def _components(self) -> Components:
        both = self.observed[:, :, None] & self.observed[:, None, :]
        absent = np.eye(self.observed.shape[1]) * ~self.observed[:, None, :]
        level = np.eye(self.observed.shape[1]) * self.observed[:, None, :]
        return Components(np.where(both, self.known, 0.0) + absent, level[None])

    def level(self, start: float, *, free: bool = True) -> tuple[float, float]:
        """The most likely noise [m] and its negative log-likelihood; those of the start if held."""
        size = self.jacobian.shape[2]
        sigmas, value = estimate_sigmas(
            self.residuals,
            self.jacobian,
            self._components(),
            Knowledge(np.zeros((size, size)), np.zeros(size)),
            np.array([start]),
            free=np.array([free]),
        )
        return float(sigmas[0]), value

    def information(self, sigma: float) -> FloatArray:
        """Fisher information (p, p) on the unknowns at a level of noise [m]."""
        weighted = np.linalg.solve(self.spread(sigma), self.jacobian)
        return np.asarray(np.einsum("mij,mik->jk", self.jacobian, weighted))

    @property
    def freedom(self) -> int:
        """How many more residuals were observed than directions of the unknowns determined."""
        values = spectrum(np.einsum("mij,mik->jk", self.jacobian, self.jacobian)).values
        return int(self.observed.sum() - np.sum(values > _OPEN_RATIO * values[-1]))


class GroupProblem(Protocol[State]):
    """What is to be fitted: the unknowns are a state, and steps of (p,) numbers move it."""

    def guesses(self) -> Iterable[State]:
        """Gives starts: the first from all groups, more from small sets (see `small_sets`).

        Each must lie near the answer where its set is sound; others may be anywhere.
        """
        ...

    def linearise(self, state: State) -> Groups:
        """Gives the residuals of all m groups at a state, and their derivatives."""
        ...

    def move(self, state: State, step: FloatArray) -> State:
        """Takes a (p,) step from a state."""
        ...


@dataclass(frozen=True, eq=False)
class GroupFit(Generic[State]):
    """The answer from some groups.

    Attributes:
        state: The most likely unknowns.
        covariance: (p, p) of their steps; a direction that the groups leave open has a large but
            finite variance.
        sigma: Most likely noise of one residual [m], beyond what is known beforehand. Where the
            groups have no freedom left it is the expected one.
        freedom: How many more residuals were used than unknowns determined.
        groups: All groups at rest, used or not.
        used: (m,) mask of the groups that it was made from.
        settled: Whether the state came to rest.
    """

    state: State
    covariance: FloatArray
    sigma: float
    freedom: int
    groups: Groups
    used: Mask
    settled: bool

    @cached_property
    def sigma_95(self) -> tuple[float, float]:
        """95 % interval of sigma [m] by the profile likelihood; (0, inf) without any freedom."""
        if self.freedom < 1:
            return 0.0, float("inf")
        inside = self.groups.subset(self.used)

        def profile(logarithm: float) -> float:
            return inside.level(float(np.exp(logarithm)), free=False)[1]

        return profile_interval(
            profile, self.sigma, profile(float(np.log(max(self.sigma, LEAST_SIGMA))))
        )


@dataclass(frozen=True, eq=False)
class Agreement(Generic[State]):
    """The groups that agree, and their fit.

    Attributes:
        fit: From the groups that agree.
        agrees: (m,) mask of them.
        surprise: (m,) squared Mahalanobis distance of each group from what the others predict, over
            the number of directions in which they predict it: one on average where it is noise.
        limit: (m,) what it may be; infinite where the others do not predict the group at all.
        doubtful: (m,) groups of which some are wrong, while nothing tells which: all of them stay.
        explained: Whether noise explains the groups that stay: none is doubtful, and their misfit
            is within the chi-square limit of the expected level, where one was given.
    """

    fit: GroupFit[State]
    agrees: Mask
    surprise: FloatArray
    limit: FloatArray
    doubtful: Mask
    explained: bool


def small_sets(count: int, size: int) -> Iterator[IntArray]:
    """Gives sets of `size` of `count` groups: all that there are, or sixty by chance."""
    if comb(count, size) <= _SETS:
        yield from (np.array(rows) for rows in combinations(range(count), size))
        return
    rng = np.random.default_rng(0)
    yield from (np.sort(rng.choice(count, size, replace=False)) for _ in range(_SETS))


def fit_groups(
    problem: GroupProblem[State],
    used: Mask | None = None,
    start: State | None = None,
    expected_sigma: float = 0.0,
) -> GroupFit[State]:
    """Fits the unknowns and the noise's level to some groups.

    Args:
        problem: What is to be fitted.
        used: (m,) mask of the groups to use; all where None.
        start: Where to start; the problem's first guess where None.
        expected_sigma: Level of noise that is taken where the groups leave no freedom to tell [m].
    """
    state = next(iter(problem.guesses())) if start is None else start
    groups = problem.linearise(state)
    chosen = np.ones(len(groups), dtype=bool) if used is None else used
    sigma, settled = _rms(groups.subset(chosen)), False
    for _ in range(_ROUNDS):
        # Held at the start: weights that follow the state would reward states with large noise.
        weights = np.asarray(np.linalg.inv(groups.spread(sigma)), dtype=float)
        state, settled = _descended(problem, state, chosen, weights)
        groups = problem.linearise(state)
        before, sigma = sigma, groups.subset(chosen).level(max(sigma, LEAST_SIGMA))[0]
        if np.isclose(before, sigma, rtol=1e-4):
            break
    return _finished(state, groups, chosen, sigma, expected_sigma, settled=settled)


def agreeing_groups(
    problem: GroupProblem[State],
    expected_sigma: float | None = None,
    start: tuple[Mask, State] | None = None,
) -> Agreement[State]:
    """Finds the groups that agree with each other, and fits the unknowns to them.

    Args:
        problem: What is to be fitted.
        expected_sigma: Level of noise to be expected of one residual [m]: what stays is compared
            with it, and it stands for the level where there is no freedom. None where unknown.
        start: (m,) the groups that are thought to agree, and the state that they agree on; None
            for a search without any idea.

    Returns:
        The groups that agree. Where fewer than half do, nothing tells which are right: all stay.
    """
    expected = 0.0 if expected_sigma is None else expected_sigma
    guess = None if start is None else start[1]
    everything = fit_groups(problem, start=guess, expected_sigma=expected)
    count = len(everything.used)
    fit, doubtful = everything, np.zeros(count, dtype=bool)
    if everything.freedom > 1:
        first = _widened(problem, *_core(problem)) if start is None else fit_groups(problem, *start)
        fit = _settled(problem, first)
        if fit.used.sum() < max(_LEAST_SHARE * count, 1) or fit.freedom < 1:
            fit = everything
        doubtful = _doubtful(fit)
        if doubtful.any():
            fit = fit_groups(problem, fit.used | doubtful, fit.state)
    surprise, limit = _judged(fit, int(np.sum(~fit.used)))
    explained = not doubtful.any() and (
        expected_sigma is None or _is_explained(fit, expected_sigma)
    )
    return Agreement(fit, fit.used, surprise, limit, doubtful, explained)


def surprises(fit: GroupFit[State]) -> tuple[FloatArray, IntArray]:
    """Squared Mahalanobis distance of each group from what the other groups predict.

    For a group inside the fit this is the deletion residual's, by the identity of Cook and Weisberg
    (1982, section 2.2): its covariance is that of the noise less what the fit has taken.

    Returns:
        (m,) squared distances, and (m,) in how many directions the others predict the group.
    """
    groups = fit.groups
    spread = groups.spread(fit.sigma)
    taken = groups.jacobian @ fit.covariance @ np.swapaxes(groups.jacobian, 1, 2)
    left = spread + np.where(fit.used, -1.0, 1.0)[:, None, None] * taken
    squares, directions = squared_lengths(groups.residuals, left, spread)
    absent = np.sum(~groups.observed, axis=1)
    return squares, np.asarray(directions - absent)


def _finished(
    state: State,
    groups: Groups,
    chosen: Mask,
    sigma: float,
    expected_sigma: float,
    *,
    settled: bool,
) -> GroupFit[State]:
    inside = groups.subset(chosen)
    freedom = inside.freedom
    if freedom < 1:
        sigma = max(expected_sigma, LEAST_SIGMA)
    spread = covariance(inside.information(sigma))
    return GroupFit(state, spread, sigma, freedom, groups, chosen, settled)


def _rms(groups: Groups) -> float:
    square = float(np.sum(groups.residuals**2)) / max(int(groups.observed.sum()), 1)
    return max(float(np.sqrt(square)), _START_SIGMA)


def _descended(
    problem: GroupProblem[State], start: State, chosen: Mask, weights: FloatArray
) -> tuple[State, bool]:
    """Minimises the residuals of some groups at (m, d, d) weights."""
    weights = np.where(chosen[:, None, None], weights, 0.0)

    def linearise(at: State) -> Linearised[State]:
        groups = problem.linearise(at)
        weighted = weights @ groups.jacobian
        information = np.einsum("mij,mik->jk", groups.jacobian, weighted)
        gradient = np.einsum("mij,mi->j", weighted, groups.residuals)
        cost = np.einsum("mi,mij,mj->", groups.residuals, weights, groups.residuals)
        return Linearised(
            at,
            float(cost),
            lambda damping: problem.move(at, damped_step(information, gradient, damping)),
        )

    return descend(start, linearise, _SETTLED)


def _limits(directions: IntArray, freedom: int, excluded: int) -> FloatArray:
    """Largest surprise that noise may give, corrected for the number of ways to exclude groups.

    The level is estimated from the residuals that stay, which gives the surprise the tails of an F
    distribution; and the sets that stay were chosen for their small level among all of their size.
    """
    share = _FALSE_ALARM / comb(len(directions), excluded)
    predicted = np.maximum(directions, 1)
    limit = f_distribution.isf(share, predicted, max(freedom, 1))
    return np.where(directions > 0, limit, np.inf)


def _judged(fit: GroupFit[State], excluded: int) -> tuple[FloatArray, FloatArray]:
    """Surprise (m,) of each group per direction, and what it may be."""
    squares, directions = surprises(fit)
    limits = _limits(directions, fit.freedom, excluded)
    return squares / np.maximum(directions, 1), limits


def _core(problem: GroupProblem[State]) -> tuple[Mask, State]:
    """The half of the groups that agree best, and the state that they agree on."""
    found = []
    for guess in problem.guesses():
        away = _distances(problem.linearise(guess))
        half = (len(away) + 1) // 2 + 1
        found.append((float(np.sort(away)[:half].sum()), guess, away))
    found.sort(key=lambda item: item[0])
    refined = [_concentrated(problem, guess, away) for _, guess, away in found[:_REFINED]]
    _, chosen, state = min(refined, key=lambda item: item[0])
    return chosen, state


def _concentrated(
    problem: GroupProblem[State], state: State, away: FloatArray
) -> tuple[float, Mask, State]:
    """Solves from the nearest half, again and again (Rousseeuw and Van Driessen 1999)."""
    count = len(away)
    half = (count + 1) // 2 + 1
    chosen = np.argsort(away)[:half]
    mask = np.zeros(count, dtype=bool)
    mask[chosen] = True
    even = np.eye(problem.linearise(state).residuals.shape[1])[None].repeat(count, axis=0)
    for _ in range(_ROUNDS):
        state, _ = _descended(problem, state, mask, even)
        away = _distances(problem.linearise(state))
        before, mask = mask, np.zeros(count, dtype=bool)
        mask[np.argsort(away)[:half]] = True
        if np.array_equal(before, mask):
            break
    return float(away[mask].sum()), mask, state


def _distances(groups: Groups) -> FloatArray:
    """Squared distances (m,), comparable between groups of different size."""
    typical = chi2.median(np.maximum(groups.observed.sum(axis=1), 1))
    return np.asarray(np.sum(groups.residuals**2, axis=1) / typical)


def _widened(problem: GroupProblem[State], core: Mask, state: State) -> GroupFit[State]:
    """Grows the core to all groups within reach of its noise, which is scaled by the median.

    The noise of the half that agrees best is less than that of all.
    """
    fit = fit_groups(problem, core, state)
    for _ in range(_ROUNDS):
        squares, directions = surprises(fit)
        there = np.maximum(directions, 1)
        scale = max(float(np.median(squares / chi2.median(there))), 1.0)
        agrees = (squares < chi2.ppf(0.999, there) * scale) | (directions < 1)
        if np.array_equal(agrees, fit.used) or agrees.sum() < core.sum():
            break
        fit = fit_groups(problem, agrees, fit.state)
    return fit


def _settled(problem: GroupProblem[State], fit: GroupFit[State]) -> GroupFit[State]:
    """Takes groups in and out one at a time, with the noise estimated anew, until none moves."""
    for _ in range(2 * len(fit.used)):
        excluded = int(np.sum(~fit.used))
        surprise, limit = _judged(fit, excluded)
        over = surprise / limit
        outside = np.flatnonzero(~fit.used & (over < 1.0))
        if len(outside):
            agrees = fit.used.copy()
            agrees[outside[over[outside].argmin()]] = True
            fit = fit_groups(problem, agrees, fit.state)
            continue
        without = _without_the_worst(problem, fit, over)
        if without is None:
            break
        fit = without
    return fit


def _without_the_worst(
    problem: GroupProblem[State], fit: GroupFit[State], over: FloatArray
) -> GroupFit[State] | None:
    """Leaves the worst group out where noise that it has no say in does not explain it."""
    worst = int(np.where(fit.used, over, -1.0).argmax())
    fewer = fit.used.copy()
    fewer[worst] = False
    again = fit_groups(problem, fewer, fit.state)
    if again.freedom < 1:
        return None
    surprise, limit = _judged(again, int(np.sum(~fewer)))
    return again if surprise[worst] > limit[worst] else None


def _doubtful(fit: GroupFit[State]) -> Mask:
    """Groups that disagree while nothing tells which of them is wrong.

    Each excluded group is set against each that stays: under the mean-shift model, with a level of
    noise that is unknown, the odds of the one being wrong rather than the other are those of what
    is left of the squared residuals without it (Cook and Weisberg 1982, section 2.2.2).
    """
    doubtful = np.zeros(len(fit.used), dtype=bool)
    for one in np.flatnonzero(~fit.used):
        both = fit.used.copy()
        both[one] = True
        left = _left_without(fit, both)
        rivals = fit.used & (left < left[one] * _ODDS ** (2.0 / max(fit.freedom, 1)))
        if rivals.any():
            doubtful |= rivals
            doubtful[one] = True
    return doubtful


def _left_without(fit: GroupFit[State], used: Mask) -> FloatArray:
    """What is left (m,) of the whitened squared residuals without each group of a mask in turn."""
    inside = fit.groups.subset(used)
    spread = inside.spread(fit.sigma)
    fitted = covariance(inside.information(fit.sigma))
    pull = np.einsum("mij,mi->j", np.linalg.solve(spread, inside.jacobian), inside.residuals)
    residuals = inside.residuals - inside.jacobian @ (fitted @ pull)
    whole = np.einsum("mi,mi->", residuals, np.linalg.solve(spread, residuals[..., None])[..., 0])
    taken = inside.jacobian @ fitted @ np.swapaxes(inside.jacobian, 1, 2)
    left = np.full(len(used), np.inf)
    left[used] = whole - squared_lengths(residuals, spread - taken, spread)[0]
    return np.asarray(np.maximum(left, np.finfo(float).eps * whole))


def _is_explained(fit: GroupFit[State], expected_sigma: float) -> bool:
    inside = fit.groups.subset(fit.used)
    if fit.freedom < 1:
        return True
    white = np.linalg.solve(inside.spread(expected_sigma), inside.residuals[..., None])[..., 0]
    misfit = float(np.sum(inside.residuals * white))
    return misfit <= float(chi2.isf(_FALSE_ALARM, fit.freedom))
