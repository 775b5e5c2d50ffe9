"""The search for outliers, whatever is fitted: least trimmed squares, then F tests.

It starts from the state under which the nearest half of all units is nearest (least trimmed
squares: Rousseeuw 1984), found by concentration steps (Rousseeuw and Van Driessen 1999). Then units
go in and out one at a time, by their deletion residuals (Cook and Weisberg 1982, section 2.2). A
unit is right or wrong as a whole: a view, a touch, a point, an image.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Protocol, TypeVar

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import FloatArray, IntArray, Mask

Fit = TypeVar("Fit")
State = TypeVar("State")

_ROUNDS = 10
# With 40 % of the units wrong, all 60 sets of three contain a wrong one with probability 3e-7.
_SETS = 60
# A sound unit beside the core is missed with this chance, until units are looked at one by one.
_MISSED = 1e-3


@dataclass(frozen=True, eq=False)
class Distances:
    """How far each of m units is from what the others predict.

    Attributes:
        squares: (m,) squared Mahalanobis distances.
        directions: (m,) in how many directions the others predict the unit.
        limit: (m,) largest square that noise may give.
    """

    squares: FloatArray
    directions: FloatArray
    limit: FloatArray

    @property
    def beyond(self) -> FloatArray:
        """(m,) the squares as shares of what they may be."""
        return np.asarray(self.squares / self.limit)


class Robust(Protocol[Fit]):
    """What is fitted to units, some of which may be outliers."""

    def fit(self, used: Mask, start: Fit) -> Fit:
        """Fits the unknowns and the noise to the units of a mask, from another fit's unknowns."""
        ...

    def distances(self, used: Mask, fit: Fit) -> Distances:
        """Gives how far all units are, by a fit of those of a mask."""
        ...


def small_sets(count: int, size: int) -> Iterator[IntArray]:
    """Gives sets of `size` of `count` units: all that there are, or sixty by chance."""
    if comb(count, size) <= _SETS:
        yield from (np.array(rows) for rows in combinations(range(count), size))
        return
    rng = np.random.default_rng(0)
    yield from (np.sort(rng.choice(count, size, replace=False)) for _ in range(_SETS))


def half_of(count: int) -> int:
    """How many of some units the start goes by: one more than half."""
    return (count + 1) // 2 + 1


def nearest(away: FloatArray, count: int) -> Mask:
    """(m,) mask of the nearest units."""
    mask = np.zeros(len(away), dtype=bool)
    mask[np.argsort(away)[:count]] = True
    return mask


def trimmed_sum(away: FloatArray, count: int) -> float:
    """The sum of the distances of the nearest units."""
    return float(np.sort(away)[:count].sum())


def trimmed_start(
    starts: Iterable[State],
    away: Callable[[State], FloatArray],
    solve: Callable[[Mask, State], State],
    count: int,
    followed: int = 5,
) -> tuple[Mask, State]:
    """Finds the units that are nearest to what they alone say.

    Args:
        starts: States to try, of all units and of small sets.
        away: Gives the distances (m,) of all units under a state, in any unit.
        solve: Solves from the units of an (m,) mask, near a state.
        count: How many units are taken for inliers.
        followed: How many of the starts are followed up by concentration steps, the best first.

    Returns:
        (m,) mask of these units, and the state that they agree on.
    """
    found = [(start, away(start)) for start in starts]
    found.sort(key=lambda pair: trimmed_sum(pair[1], count))
    refined = [_concentrated(*pair, away, solve, count) for pair in found[:followed]]
    return min(refined, key=lambda pair: pair[0])[1:]


def _concentrated(
    state: State,
    distances: FloatArray,
    away: Callable[[State], FloatArray],
    solve: Callable[[Mask, State], State],
    count: int,
) -> tuple[float, Mask, State]:
    """Solves from the nearest units while that brings them nearer; gives how near they are first.

    What is solved for may be another measure than the distances: their sum may rise.
    """
    least, mask = trimmed_sum(distances, count), nearest(distances, count)
    for _ in range(_ROUNDS):
        then = solve(mask, state)
        distances = away(then)
        if (lower := trimmed_sum(distances, count)) >= least:
            break
        least, mask, state = lower, nearest(distances, count), then
    return least, mask, state


def widened(
    search: Robust[Fit], used: Mask, fit: Fit, among: Mask | None = None
) -> tuple[Mask, Fit]:
    """Takes all units within reach of the noise, and fits to them, in turn.

    Args:
        search: What is fitted.
        used: (m,) units that are inliers.
        fit: Their fit.
        among: (m,) the units to choose from, of which most are inliers; the noise is scaled by
            their median, because that of the nearest half is less than that of all. Where None, all
            are chosen from, within their limits at the noise of those that are used.
    """
    fewest = int(used.sum()) if among is not None else 1
    for _ in range(_ROUNDS):
        distances = search.distances(used, fit)
        directions = np.maximum(distances.directions, 1)
        shares = distances.squares / chi2_limit(0.5, directions)
        scale = max(float(np.median(shares[used if among is None else among])), 1.0)
        limit = distances.limit if among is None else chi2_limit(_MISSED, directions)
        reached = (distances.squares < scale * limit) | (distances.directions < 1)
        if among is not None:
            reached &= among
        if np.array_equal(reached, used) or reached.sum() < fewest:
            break
        used, fit = reached, search.fit(reached, fit)
    return used, fit


def settled(
    search: Robust[Fit], used: Mask, fit: Fit, fewest: int, suspect: float
) -> tuple[Mask, Fit]:
    """Takes units in and out one at a time, with the noise estimated anew, until none moves.

    Of hundreds, one in a hundred goes in at a time.

    Args:
        search: What is fitted.
        used: (m,) units that are thought to be inliers.
        fit: Their fit.
        fewest: So many are left in.
        suspect: A unit is judged once more, by noise that it has no say in, where its square comes
            within this share of the limit.
    """
    step = max(len(used) // 100, 1)
    for _ in range(2 * len(used)):
        if used.sum() < fewest:
            break
        beyond = search.distances(used, fit).beyond
        outside = np.flatnonzero(~used & (beyond < 1.0))
        if len(outside):
            used = used.copy()
            used[outside[beyond[outside].argsort()[:step]]] = True
            fit = search.fit(used, fit)
            continue
        worst = int(np.where(used, beyond, -1.0).argmax())
        if beyond[worst] < suspect or used.sum() <= fewest:
            break
        fewer = used.copy()
        fewer[worst] = False
        again = search.fit(fewer, fit)
        if search.distances(fewer, again).beyond[worst] <= 1.0:
            break
        used, fit = fewer, again
    return used, fit
