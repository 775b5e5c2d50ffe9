"""Which groups of residuals agree: wrong touches and points, told from noise.

The start is a consensus of small sets under least trimmed squares (Rousseeuw 1984); what follows
are F tests on deletion residuals (Cook and Weisberg 1982, section 2.2), one group at a time.
"""

from dataclasses import dataclass
from math import comb
from typing import Generic

import numpy as np

from visioncal.chance import chi2_limit, f_limit
from visioncal.estimation.groups import GroupFit, GroupProblem, Groups, State, descended, fit_groups
from visioncal.estimation.linalg import covariance, gram, squared_lengths
from visioncal.types import FloatArray, IntArray, Mask

# Noise leaves sound groups out in one set of a thousand.
_FALSE_ALARM = 1e-3
_REFINED, _ROUNDS = 5, 10
# Where fewer than this share of the groups agree, nothing tells which of them are right.
_LEAST_SHARE = 0.5
# One group is called wrong when that is so many times as likely as any other being it.
_ODDS = 100.0


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


def _limits(directions: IntArray, freedom: int, excluded: int) -> FloatArray:
    """Largest surprise that noise may give, corrected for the number of ways to exclude groups.

    The level is estimated from the residuals that stay, which gives the surprise the tails of an F
    distribution; and the sets that stay were chosen for their small level among all of their size.
    """
    # Half of the false alarms go to the first group that is left out, a quarter to the second ...
    share = _FALSE_ALARM / 2.0**excluded / comb(len(directions), excluded)
    predicted = np.maximum(directions, 1)
    limit = f_limit(share, predicted, max(freedom, 1))
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
        state, _ = descended(problem, state, mask, even)
        away = _distances(problem.linearise(state))
        before, mask = mask, np.zeros(count, dtype=bool)
        mask[np.argsort(away)[:half]] = True
        if np.array_equal(before, mask):
            break
    return float(away[mask].sum()), mask, state


def _distances(groups: Groups) -> FloatArray:
    """Squared distances (m,), comparable between groups of different size."""
    typical = chi2_limit(0.5, np.maximum(groups.observed.sum(axis=1), 1))
    return np.asarray(np.sum(groups.residuals**2, axis=1) / typical)


def _widened(problem: GroupProblem[State], core: Mask, state: State) -> GroupFit[State]:
    """Grows the core to all groups within reach of its noise, which is scaled by the median.

    The noise of the half that agrees best is less than that of all.
    """
    fit = fit_groups(problem, core, state)
    for _ in range(_ROUNDS):
        squares, directions = surprises(fit)
        there = np.maximum(directions, 1)
        scale = max(float(np.median(squares / chi2_limit(0.5, there))), 1.0)
        agrees = (squares < chi2_limit(0.001, there) * scale) | (directions < 1)
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
    pull = gram(np.linalg.solve(spread, inside.jacobian), inside.residuals)
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
    return misfit <= float(chi2_limit(_FALSE_ALARM, fit.freedom))
