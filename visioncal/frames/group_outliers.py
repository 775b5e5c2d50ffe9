"""Outlier rejection for groups of residuals: wrong touches and points."""

from dataclasses import dataclass, replace
from math import comb

import numpy as np

from visioncal.core.linalg import squared_lengths
from visioncal.core.quantiles import FALSE_REJECTION, chi2_limit, f_limit
from visioncal.core.robust import Distances, half_of, settled, trimmed_start, widened
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.points import (
    GroupFit,
    Groups,
    Placement,
    PointProblem,
    descended,
    fit_groups,
)


@dataclass(frozen=True, eq=False)
class GroupInliers:
    """The inlier groups, and their fit."""

    fit: GroupFit  # From the inlier groups.
    # (m,) squared Mahalanobis distance of each group from the prediction of the others, over its
    # limit; zero where the others do not predict the group at all.
    beyond: FloatArray
    doubtful: Mask  # (m,) groups of which some are wrong, not known which: all of them stay.
    # Whether noise explains the inliers: none is doubtful, and their misfit is within the
    # chi-square limit of the expected level, where one was given.
    explained: bool

    @property
    def mask(self) -> Mask:
        """(m,) mask of the inliers."""
        return self.fit.used

    @property
    def off_m(self) -> FloatArray:
        """(m,) residual distance of each group over the observed directions [m]."""
        return np.asarray(np.linalg.norm(self.fit.groups.residuals, axis=1))

    @property
    def suspected(self) -> tuple[int, float] | None:
        """The inlier that is likeliest wrong, and the noise level of the others [m].

        Its deletion residual exceeds what one of twenty such fits has by chance: too little to
        leave it out. None without one.
        """
        fit = self.fit
        found, total = distances(fit), _misfit(fit.groups.subset(fit.used), fit.sigma)
        left, freedom = total - found.squares, fit.freedom - found.directions
        known = fit.used & (freedom > 0) & (left > 0.0) & (found.directions > 0)
        left, freedom = np.where(known, left, np.inf), np.maximum(freedom, 1)
        directions = np.maximum(found.directions, 1)
        ratios = found.squares / directions / (left / freedom)
        at = int(np.argmax(ratios))
        if ratios[at] <= f_limit(0.05 / len(ratios), directions[at], freedom[at]):
            return None
        return at, float(fit.sigma * np.sqrt(left[at] / freedom[at]))


def find_inlier_groups(
    problem: PointProblem,
    expected_sigma: float | None = None,
    start: tuple[Mask, Placement] | None = None,
) -> GroupInliers:
    """Finds the inlier groups, and fits the unknowns to them.

    Args:
        problem: The problem to fit.
        expected_sigma: Expected noise of one residual [m]: the inliers' misfit is tested against
            it, and it is the level where there are no degrees of freedom. None where unknown.
        start: (m,) presumed inliers, and the state by them; None for a search from scratch.

    Returns:
        The inliers. Where fewer than half are, the outliers cannot be identified: all stay.
    """
    expected = 0.0 if expected_sigma is None else expected_sigma
    guess = None if start is None else start[1]
    all_groups = fit_groups(problem, start=guess, expected_sigma=expected)
    count = len(all_groups.used)
    fit, doubtful = all_groups, np.zeros(count, dtype=bool)
    if all_groups.freedom > 1:
        first = _core(problem, count) if start is None else fit_groups(problem, *start)
        fit = settled(_GroupSearch(problem), first.used, first, fewest=1, suspect=0.0)[1]
        if 2 * fit.used.sum() < count or fit.freedom < 1:
            fit = all_groups
        doubtful = _doubtful(problem, fit)
        if doubtful.any():
            fit = fit_groups(problem, fit.used | doubtful, fit.state)
    explained = not doubtful.any()
    if explained and expected_sigma is not None and fit.freedom > 0:
        misfit = _misfit(fit.groups.subset(fit.used), expected_sigma)
        explained = misfit <= float(chi2_limit(FALSE_REJECTION, fit.freedom))
    return GroupInliers(fit, distances(fit).beyond, doubtful, explained)


@dataclass(frozen=True, eq=False)
class _GroupSearch:
    """The search among the groups of a problem."""

    problem: PointProblem

    def fit(self, used: Mask, start: GroupFit) -> GroupFit:
        return fit_groups(self.problem, used, start.state)

    def distances(self, used: Mask, fit: GroupFit) -> Distances:
        found = distances(fit)
        # Without degrees of freedom nothing is rejected.
        return found if fit.freedom > 0 else replace(found, squares=np.zeros(len(used)))


def distances(fit: GroupFit) -> Distances:
    """Mahalanobis distance of each group from the prediction of the other groups.

    For a group inside the fit this is the deletion residual's, by the identity of Cook and Weisberg
    (1982, section 2.2): its covariance is that of the noise less the fit's leverage.
    """
    groups = fit.groups
    covariance = groups.covariance(fit.sigma)
    leverage = groups.jacobian @ fit.covariance @ np.swapaxes(groups.jacobian, 1, 2)
    residual_covariance = covariance + np.where(fit.used, -1.0, 1.0)[:, None, None] * leverage
    squares, directions = squared_lengths(groups.residuals, residual_covariance, covariance)
    directions = directions - np.sum(~groups.observed, axis=1)
    # The level is estimated from the inliers' residuals, which gives the squares an F distribution;
    # and the inliers were selected for their small level among all sets of their size. Half of the
    # false alarms go to the first excluded group, a quarter to the next.
    excluded = int(np.sum(~fit.used))
    share = FALSE_REJECTION / 2.0**excluded / comb(len(fit.used), excluded)
    positive = np.maximum(directions, 1)
    limit = positive * f_limit(share, positive, max(fit.freedom, 1))
    return Distances(squares, directions, np.where(directions > 0, limit, np.inf))


def _core(problem: PointProblem, count: int) -> GroupFit:
    """Least-trimmed-squares start, extended by all groups it predicts."""
    groups = problem.linearise(next(iter(problem.guesses())))
    even = np.eye(groups.residuals.shape[1])[None].repeat(count, axis=0)
    # Makes groups of different size comparable.
    typical = chi2_limit(0.5, np.maximum(groups.observed.sum(axis=1), 1))

    def normalised_squares(state: Placement) -> FloatArray:
        return np.asarray(np.sum(problem.linearise(state).residuals ** 2, axis=1) / typical)

    def solve(mask: Mask, state: Placement) -> Placement:
        return descended(problem, state, mask, even)

    mask, state = trimmed_start(problem.guesses(), normalised_squares, solve, half_of(count))
    fit = fit_groups(problem, mask, state)
    return widened(_GroupSearch(problem), mask, fit, np.ones(count, dtype=bool))[1]


def _doubtful(problem: PointProblem, fit: GroupFit) -> Mask:
    """Groups among which the outliers cannot be identified."""
    # Each excluded group is compared with each inlier: under the mean-shift model with unknown
    # noise, the odds of one or the other being wrong are those of the squared residuals left
    # without it (Cook and Weisberg 1982, section 2.2.2). Odds of a hundred decide.
    doubtful = np.zeros(len(fit.used), dtype=bool)
    for excluded in np.flatnonzero(~fit.used):
        used = fit.used.copy()
        used[excluded] = True
        refit = fit_groups(problem, used, fit.state)
        inside = refit.groups.subset(used)
        left, total = np.full(len(used), np.inf), _misfit(inside, refit.sigma)
        left[used] = total - distances(refit).squares[used]
        least = max(left[excluded], np.finfo(float).eps * total)
        rivals = fit.used & (left < least * 100.0 ** (2.0 / max(fit.freedom, 1)))
        if rivals.any():
            doubtful |= rivals
            doubtful[excluded] = True
    return doubtful


def _misfit(inside: Groups, sigma: float) -> float:
    """Sum of the whitened squared residuals at a noise level [m]."""
    white = np.linalg.solve(inside.covariance(sigma), inside.residuals[..., None])[..., 0]
    return float(np.sum(inside.residuals * white))
