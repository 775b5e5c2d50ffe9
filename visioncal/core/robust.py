"""Outlier search for any fit: least trimmed squares, then F tests.

It starts from the state with the least sum of distances of the nearest half of all units (least
trimmed squares: Rousseeuw 1984), found by concentration steps (Rousseeuw and Van Driessen 1999).
Then units are included or excluded one at a time, by their deletion residuals (Cook and Weisberg
1982, section 2.2). A unit is an inlier or outlier as a whole: a view, a touch, a point, an image.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Protocol, TypeVar

import numpy as np

from visioncal.core.quantiles import FALSE_REJECTION, chi2_limit
from visioncal.core.types import FloatArray, IntArray, Mask

Fit = TypeVar("Fit")
State = TypeVar("State")

# Most rounds in which inliers and fit follow each other: most take three.
ROUNDS = 10
# Number of small sets: with 40 % outliers, all 60 sets of three contain one with probability 3e-7.
SETS = 60
# Starts that concentration steps refine.
REFINED = 5


@dataclass(frozen=True, eq=False)
class Distances:
    """Distance of each of m units from the prediction of the others."""

    squares: FloatArray  # (m,) squared Mahalanobis distances.
    directions: FloatArray  # (m,) number of predicted directions of the unit.
    limit: FloatArray  # (m,) largest square of noise.

    @property
    def beyond(self) -> FloatArray:
        """(m,) the squares over their limits."""
        return np.asarray(self.squares / self.limit)


class Robust(Protocol[Fit]):
    """A fit to units, some of which may be outliers."""

    def fit(self, used: Mask, start: Fit) -> Fit:
        """Fits the unknowns and the noise to the units of a mask, starting at another fit."""
        ...

    def distances(self, used: Mask, fit: Fit) -> Distances:
        """Distances of all units, for a fit of those of a mask."""
        ...


def small_sets(count: int, size: int) -> Iterator[IntArray]:
    """Yields sets of `size` of `count` units: all of them, or sixty at random."""
    if comb(count, size) <= SETS:
        yield from (np.array(rows) for rows in combinations(range(count), size))
        return
    rng = np.random.default_rng(0)
    yield from (np.sort(rng.choice(count, size, replace=False)) for _ in range(SETS))


def half_of(count: int) -> int:
    """Size of the trimmed set: one more than half."""
    return (count + 1) // 2 + 1


def nearest(distances: FloatArray, count: int) -> Mask:
    """(m,) mask of the nearest units."""
    mask = np.zeros(len(distances), dtype=bool)
    mask[np.argsort(distances)[:count]] = True
    return mask


def trimmed_sum(distances: FloatArray, count: int) -> float:
    """The sum of the distances of the nearest units."""
    return float(np.sort(distances)[:count].sum())


def trimmed_start(
    starts: Iterable[State],
    away: Callable[[State], FloatArray],
    solve: Callable[[Mask, State], State],
    count: int,
) -> tuple[Mask, State]:
    """Least-trimmed-squares start: the units nearest to the state that they determine.

    The best starts are refined by concentration steps.

    Args:
        starts: States to try, of all units and of small sets.
        away: Distances (m,) of all units under a state, in any unit.
        solve: Solves from the units of an (m,) mask, near a state.
        count: Number of units taken for inliers.

    Returns:
        (m,) mask of these units, and their state.
    """
    candidates = [(start, away(start)) for start in starts]
    candidates.sort(key=lambda pair: trimmed_sum(pair[1], count))
    refined = [_concentrated(*pair, away, solve, count) for pair in candidates[:REFINED]]
    return min(refined, key=lambda pair: pair[0])[1:]


def _concentrated(
    state: State,
    distances: FloatArray,
    distances_of: Callable[[State], FloatArray],
    solve: Callable[[Mask, State], State],
    count: int,
) -> tuple[float, Mask, State]:
    """Concentration steps while the trimmed sum falls; returns that, the mask and the state.

    `solve` may minimise another measure than the distances: their sum may rise.
    """
    least, mask = trimmed_sum(distances, count), nearest(distances, count)
    for _ in range(ROUNDS):
        trial = solve(mask, state)
        distances = distances_of(trial)
        if (lower := trimmed_sum(distances, count)) >= least:
            break
        least, mask, state = lower, nearest(distances, count), trial
    return least, mask, state


def widened(
    search: Robust[Fit], used: Mask, fit: Fit, among: Mask | None = None
) -> tuple[Mask, Fit]:
    """Includes all units within the noise's reach and refits, until the set is stable.

    Args:
        search: The fit.
        used: (m,) inlier mask.
        fit: Their fit.
        among: (m,) the candidates, mostly inliers; the noise is scaled by their median, because the
            nearest half has less noise than all. Where None, all are candidates, within their
            limits at the noise of the used ones.
    """
    fewest, before = int(used.sum()) if among is not None else 1, used
    for _ in range(ROUNDS):
        distances = search.distances(used, fit)
        directions = np.maximum(distances.directions, 1)
        shares = distances.squares / chi2_limit(0.5, directions)
        scale = max(float(np.median(shares[used if among is None else among])), 1.0)
        limit = distances.limit if among is None else chi2_limit(FALSE_REJECTION, directions)
        reached = (distances.squares < scale * limit) | (distances.directions < 1)
        if among is not None:
            reached &= among
        # Units at the limit may come and go with the noise: two sets in turn end it, too.
        if any(np.array_equal(reached, known) for known in (used, before)):
            break
        if reached.sum() < fewest:
            break
        before, used, fit = used, reached, search.fit(reached, fit)
    return used, fit


def settled(
    search: Robust[Fit], used: Mask, fit: Fit, fewest: int, suspect: float
) -> tuple[Mask, Fit]:
    """Includes or excludes units one at a time, with the noise re-estimated, until stable.

    Of hundreds of units, one in a hundred is included at a time.

    Args:
        search: The fit.
        used: (m,) presumed inliers.
        fit: Their fit.
        fewest: Fewest inliers.
        suspect: Share of the limit from which a unit is tested again, with noise estimated without
            it.
    """
    step, tried = max(len(used) // 100, 1), set[bytes]()
    for _ in range(2 * len(used)):
        # Units at the limit may come and go with the noise.
        if used.sum() < fewest or used.tobytes() in tried:
            break
        tried.add(used.tobytes())
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
        refit = search.fit(fewer, fit)
        if search.distances(fewer, refit).beyond[worst] <= 1.0:
            break
        used, fit = fewer, refit
    return used, fit
