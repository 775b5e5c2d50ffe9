"""Which groups of residuals are outliers: wrong touches and points, separated from noise."""

from dataclasses import dataclass, replace
from math import comb
from typing import Generic

import numpy as np

from visioncal.core.quantiles import chi2_limit, f_limit
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.groups import GroupFit, GroupProblem, State, descended, fit_groups
from visioncal.estimation.linalg import covariance_from, gram, squared_lengths
from visioncal.estimation.robust import Distances, half_of, settled, trimmed_start, widened

# Noise leaves sound groups out in one set of a thousand.
_FALSE_ALARM = 1e-3
# Where fewer than this share of the groups agree, which of them are right is unknown.
_LEAST_SHARE = 0.5
# One group is called wrong when that is so many times as likely as any other being it.
_ODDS = 100.0


@dataclass(frozen=True, eq=False)
class GroupInliers(Generic[State]):
    """The groups that agree, and their fit.

    Attributes:
        fit: From the groups that agree.
        agrees: (m,) mask of them.
        mahalanobis_sq: (m,) squared Mahalanobis distance of each group from what the others
            predict, over the number of directions in which they predict it: one on average where
            it is noise.
        limit: (m,) what it may be; infinite where the others do not predict the group at all.
        doubtful: (m,) groups of which some are wrong, not known which: all of them stay.
        explained: Whether noise explains the groups that stay: none is doubtful, and their misfit
            is within the chi-square limit of the expected level, where one was given.
    """

    fit: GroupFit[State]
    agrees: Mask
    mahalanobis_sq: FloatArray
    limit: FloatArray
    doubtful: Mask
    explained: bool

    @property
    def off_m(self) -> FloatArray:
        """(m,) how far each group is off, in as many directions as are observed [m]."""
        return np.asarray(np.linalg.norm(self.fit.groups.residuals, axis=1))


def agreeing_groups(
    problem: GroupProblem[State],
    expected_sigma: float | None = None,
    start: tuple[Mask, State] | None = None,
) -> GroupInliers[State]:
    """Finds the groups that agree with each other, and fits the unknowns to them.

    Args:
        problem: What is to be fitted.
        expected_sigma: Level of noise to be expected of one residual [m]: what stays is compared
            with it, and it stands for the level where there is no freedom. None where unknown.
        start: (m,) the groups that are thought to agree, and the state that they agree on; None
            for a search without any idea.

    Returns:
        The groups that agree. Where fewer than half do, the right ones are unknown: all stay.
    """
    expected = 0.0 if expected_sigma is None else expected_sigma
    guess = None if start is None else start[1]
    everything = fit_groups(problem, start=guess, expected_sigma=expected)
    count = len(everything.used)
    fit, doubtful = everything, np.zeros(count, dtype=bool)
    if everything.freedom > 1:
        first = _core(problem, count) if start is None else fit_groups(problem, *start)
        fit = settled(_GroupSearch(problem), first.used, first, fewest=1, suspect=0.0)[1]
        if fit.used.sum() < max(_LEAST_SHARE * count, 1) or fit.freedom < 1:
            fit = everything
        doubtful = _doubtful(fit)
        if doubtful.any():
            fit = fit_groups(problem, fit.used | doubtful, fit.state)
    away = distances(fit)
    per = np.maximum(away.directions, 1)
    explained = not doubtful.any() and (
        expected_sigma is None or _is_explained(fit, expected_sigma)
    )
    return GroupInliers(fit, fit.used, away.squares / per, away.limit / per, doubtful, explained)


@dataclass(frozen=True, eq=False)
class _GroupSearch(Generic[State]):
    """The search among the groups of a problem."""

    problem: GroupProblem[State]

    def fit(self, used: Mask, start: GroupFit[State]) -> GroupFit[State]:
        return fit_groups(self.problem, used, start.state)

    def distances(self, used: Mask, fit: GroupFit[State]) -> Distances:
        found = distances(fit)
        # Without any freedom, nothing contradicts anything.
        return found if fit.freedom > 0 else replace(found, squares=np.zeros(len(used)))


def distances(fit: GroupFit[State]) -> Distances:
    """How far each group is from what the other groups predict.

    For a group inside the fit this is the deletion residual's, by the identity of Cook and Weisberg
    (1982, section 2.2): its covariance is that of the noise less what the fit has taken.
    """
    groups = fit.groups
    covariance = groups.covariance(fit.sigma)
    taken = groups.jacobian @ fit.covariance @ np.swapaxes(groups.jacobian, 1, 2)
    left = covariance + np.where(fit.used, -1.0, 1.0)[:, None, None] * taken
    squares, directions = squared_lengths(groups.residuals, left, covariance)
    directions = directions - np.sum(~groups.observed, axis=1)
    # The level is estimated from the residuals that stay, which gives the squares the tails of an F
    # distribution; and the sets that stay were chosen for their small level among all of their
    # size. Half of the false alarms go to the first group that is left out, a quarter to the next.
    excluded = int(np.sum(~fit.used))
    share = _FALSE_ALARM / 2.0**excluded / comb(len(fit.used), excluded)
    there = np.maximum(directions, 1)
    limit = there * f_limit(share, there, max(fit.freedom, 1))
    return Distances(squares, directions, np.where(directions > 0, limit, np.inf))


def _core(problem: GroupProblem[State], count: int) -> GroupFit[State]:
    """The trimmed start, and all groups within its reach."""
    groups = problem.linearise(next(iter(problem.guesses())))
    even = np.eye(groups.residuals.shape[1])[None].repeat(count, axis=0)
    # So that groups of different size compare.
    typical = chi2_limit(0.5, np.maximum(groups.observed.sum(axis=1), 1))

    def away(state: State) -> FloatArray:
        return np.asarray(np.sum(problem.linearise(state).residuals ** 2, axis=1) / typical)

    def solve(mask: Mask, state: State) -> State:
        return descended(problem, state, mask, even)[0]

    mask, state = trimmed_start(problem.guesses(), away, solve, half_of(count))
    fit = fit_groups(problem, mask, state)
    return widened(_GroupSearch(problem), mask, fit, np.ones(count, dtype=bool))[1]


def _doubtful(fit: GroupFit[State]) -> Mask:
    """Groups that disagree, of which the wrong ones are unknown."""
    # Each excluded group is set against each that stays: under the mean-shift model, with a level
    # of noise that is unknown, the odds of the one being wrong rather than the other are those of
    # what is left of the squared residuals without it (Cook and Weisberg 1982, section 2.2.2).
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
    covariance = inside.covariance(fit.sigma)
    fitted = covariance_from(inside.information(fit.sigma))
    gradient = gram(np.linalg.solve(covariance, inside.jacobian), inside.residuals)
    residuals = inside.residuals - inside.jacobian @ (fitted @ gradient)
    whole = np.einsum(
        "mi,mi->", residuals, np.linalg.solve(covariance, residuals[..., None])[..., 0]
    )
    taken = inside.jacobian @ fitted @ np.swapaxes(inside.jacobian, 1, 2)
    left = np.full(len(used), np.inf)
    left[used] = whole - squared_lengths(residuals, covariance - taken, covariance)[0]
    return np.asarray(np.maximum(left, np.finfo(float).eps * whole))


def _is_explained(fit: GroupFit[State], expected_sigma: float) -> bool:
    inside = fit.groups.subset(fit.used)
    if fit.freedom < 1:
        return True
    white = np.linalg.solve(inside.covariance(expected_sigma), inside.residuals[..., None])[..., 0]
    misfit = float(np.sum(inside.residuals * white))
    return misfit <= float(chi2_limit(_FALSE_ALARM, fit.freedom))
