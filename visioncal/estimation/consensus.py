"""Which views belong together: swapped rows, slipped boards and wrong images, told from noise.

A wrong view is wrong as a whole: the unit of rejection is the 6-vector by which a view places the
target away from where the others place it. The start is a consensus of small sets of views
(Fischler and Bolles 1981) under the least trimmed sum of distances (Rousseeuw 1984); what follows
works on squared Mahalanobis distances with the noise estimated from the views that agree.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from visioncal.chance import chi2_limit, f_limit
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closure import (
    Closure,
    ClosureFit,
    Edges,
    Noise,
    distances,
    fit_closure,
    normal_equations,
    residual_blocks,
)
from visioncal.estimation.linalg import covariance, squared_lengths
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.variance import LEAST_SIGMA
from visioncal.solvers import SOLVERS
from visioncal.transforms import invert, log
from visioncal.types import FloatArray, IntArray, Mask

# A sound view is lost in one session of a thousand.
_FALSE_ALARM = 1e-3
# With 40 % of 20 views wrong, all 60 sets of three contain a wrong one with probability 3e-6.
_SETS, _SET_SIZE = 60, 3
_REFINED, _ROUNDS = 5, 10
# The noise of measured poses differs by so much from view to view: with tilt and distance.
_UNEVEN = 3.0
# Where fewer than this share of the views agree, nothing tells which of them are right.
_LEAST_SHARE = 0.5
# Views that agree, at the least: with fewer, wrong ones cannot be told from noise.
LEAST_VIEWS = 5
# Distances are compared with the limit once more, without the view's own say in the noise, when
# they come this near.
_SUSPECT_SHARE = 0.4


@dataclass(frozen=True, eq=False)
class Agreement:
    """The views that agree, and their fit.

    Attributes:
        fit: Edges and noise from the views that agree.
        agrees: (m,) mask of them.
        surprise: (m,) squared Mahalanobis distance of each view from what the others predict; as
            many on average as it tells directions (`Closure.told`) where it is noise.
        limit: (m,) what it may be.
    """

    fit: ClosureFit
    agrees: Mask
    surprise: FloatArray
    limit: FloatArray


def agreeing_views(data: Closure, start: Mask | None = None) -> Agreement:
    """Finds the views that agree with each other, and fits both edges to them.

    Args:
        data: The views.
        start: (m,) those that are thought to agree; None for a search without any idea.

    Returns:
        The views that agree. Where fewer than half do, or those only to within more than any
        result may be off, nothing tells which are right: all stay.
    """
    everything = np.ones(len(data), dtype=bool)
    if len(data) > LEAST_VIEWS:
        agrees, fit = _widened(data, *_core(data)) if start is None else _fitted(data, start)
        agrees, fit = _settled(data, agrees, fit)
        if agrees.sum() >= max(_LEAST_SHARE * len(data), LEAST_VIEWS) and _is_noise(fit.noise):
            return _kept(data, agrees, fit)
    return _kept(data, *_fitted(data, everything))


def whole_units(data: Closure, stops: IntArray) -> IntArray:
    """Which views are right or wrong together: those of one stop, as far as their images agree.

    Views of one stop share the robot's pose, and must see the target at one place up to the
    camera's noise alone. Those that do not are units by themselves, so that a wrong image does not
    take a sound one with it. Where the camera's noise is unknown, it is what pairs of views of one
    stop show in the median.

    Args:
        data: The views.
        stops: (m,) the stop of each view, numbered from 0 in the order of first appearance.

    Returns:
        (m,) the unit of each view, numbered likewise.
    """
    if len(np.unique(stops)) == len(stops):
        return stops
    first, second = np.nonzero(np.triu(stops[:, None] == stops, 1))
    away = log(invert(data.camera[first]) @ data.camera[second])
    if data.camera_covariance is None:
        apart = np.median(np.sum(away.reshape(-1, 2, 3) ** 2, axis=2), axis=0)
        typical = apart / chi2_limit(0.5, 3)
        spread = _UNEVEN**2 * np.diag(np.repeat(np.maximum(typical, LEAST_SIGMA**2), 3))[None]
    else:
        spread = data.camera_covariance[first] + data.camera_covariance[second]
    squared = np.einsum("pi,pi->p", away, np.linalg.solve(spread, away[:, :, None])[:, :, 0])
    alike = squared < chi2_limit(_FALSE_ALARM / len(first), 6)
    pairs = (np.ones(alike.sum()), (first[alike], second[alike]))
    links = coo_array(pairs, shape=(len(data), len(data)))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _is_noise(noise: Noise) -> bool:
    return noise.sigma_m < SIGMA_LIMIT_M and noise.sigma_rad < SIGMA_LIMIT_RAD


def _fitted(data: Closure, mask: Mask) -> tuple[Mask, ClosureFit]:
    return mask, fit_closure(data.subset(mask), _closed_form(data, np.flatnonzero(mask)))


def _kept(data: Closure, agrees: Mask, fit: ClosureFit) -> Agreement:
    return Agreement(fit, agrees, surprises(data, agrees, fit), _limit(data, agrees))


def surprises(data: Closure, agrees: Mask, fit: ClosureFit) -> FloatArray:
    """Squared Mahalanobis distance (m,) of each view from what the other views predict.

    For a view inside the fit this is the deletion residual's, by the identity of Cook and Weisberg
    (1982, section 2.2): its covariance is that of the noise less what the fit has taken.

    Args:
        data: The views.
        agrees: (m,) those that the fit was made from.
        fit: The edges and the noise.
    """
    residuals, jacobian, spread = residual_blocks(data, fit.edges, fit.noise)
    information, _ = normal_equations(data.subset(agrees), fit.edges, fit.noise)
    taken = jacobian @ covariance(information) @ np.swapaxes(jacobian, 1, 2)
    left = spread + np.where(agrees, -1.0, 1.0)[:, None, None] * taken
    return squared_lengths(residuals, left, spread)[0]


def _limit(data: Closure, agrees: Mask) -> FloatArray:
    """Largest surprise (m,) that noise may give, corrected for the number of views.

    The noise's two levels are estimated from half of the residuals each, which gives the surprise
    the tails of an F distribution. Poses that were measured by others are better in some views than
    in others, and nobody says how much.
    """
    told = data.told
    freedom = max(0.5 * float(told[agrees].sum()) - 6.0, 6.0)
    limit = told * f_limit(_FALSE_ALARM / len(data), told, freedom)
    return np.asarray(limit if data.camera_covariance is not None else _UNEVEN**2 * limit)


def _core(data: Closure) -> tuple[Mask, Edges]:
    """The half of the views that agree best, and their edges."""
    half = (len(data) + 1) // 2 + 1
    found = [(float(np.sort(away)[:half].sum()), edges, away) for edges, away in _candidates(data)]
    found.sort(key=lambda item: item[0])
    refined = [_concentrated(data, edges, away, half) for _, edges, away in found[:_REFINED]]
    _, chosen, edges = min(refined, key=lambda item: item[0])
    return chosen, edges


def _candidates(data: Closure) -> Iterator[tuple[Edges, FloatArray]]:
    """Edges from all views and from small sets, each with all views' distances."""
    rng = np.random.default_rng(0)
    sets = [np.arange(len(data))]
    if data.guess is None:
        sets += [rng.choice(len(data), _SET_SIZE, replace=False) for _ in range(_SETS)]
    for rows in sets:
        edges = _closed_form(data, rows)
        yield edges, _distances(data, edges)


def _concentrated(
    data: Closure, edges: Edges, away: FloatArray, half: int
) -> tuple[float, Mask, Edges]:
    """Solves from the nearest half, again and again (Rousseeuw and Van Driessen 1999)."""
    chosen = np.sort(np.argsort(away)[:half])
    for _ in range(_ROUNDS):
        edges = _closed_form(data, chosen)
        away = _distances(data, edges)
        before, chosen = chosen, np.sort(np.argsort(away)[:half])
        if np.array_equal(before, chosen):
            break
    mask = np.zeros(len(data), dtype=bool)
    mask[chosen] = True
    return float(away[chosen].sum()), mask, edges


def _closed_form(data: Closure, rows: IntArray) -> Edges:
    if data.guess is not None:
        return Edges(data.guess.x, data.guess.z, data.unchanged)
    solution = SOLVERS["park"](data.robot[rows], data.camera[rows])
    return Edges(solution.x, solution.z, data.unchanged)


def _distances(data: Closure, edges: Edges) -> FloatArray:
    """Distance (m,) [m] between where each view places the target, and where the edges do."""
    away_m, away_rad = distances(data.placed(edges.x), edges.z)
    return np.asarray(away_m + LEVER_M * away_rad)


def _widened(data: Closure, core: Mask, edges: Edges) -> tuple[Mask, ClosureFit]:
    """Grows the core to all views within reach of its noise, which is scaled by the median.

    The noise of the half that agrees best is less than that of all.
    """
    agrees, fit = core, fit_closure(data.subset(core), edges)
    allowed, typical = chi2_limit(0.001, data.told), chi2_limit(0.5, data.told)
    for _ in range(_ROUNDS):
        surprise = surprises(data, agrees, fit)
        scale = max(float(np.median(surprise / typical)), 1.0)
        before, agrees = agrees, surprise < allowed * scale
        if np.array_equal(before, agrees) or agrees.sum() < LEAST_VIEWS:
            break
        fit = fit_closure(data.subset(agrees), fit.edges)
    return agrees, fit


def _settled(data: Closure, agrees: Mask, fit: ClosureFit) -> tuple[Mask, ClosureFit]:
    """Takes views in and out one at a time, with the noise estimated anew, until none moves.

    Of hundreds, one in a hundred goes in at a time.
    """
    step = max(len(data) // 100, 1)
    for _ in range(len(data)):
        if agrees.sum() < LEAST_VIEWS:
            break
        surprise, limit = surprises(data, agrees, fit), _limit(data, agrees)
        outside = np.flatnonzero(~agrees & (surprise < limit))
        if len(outside):
            agrees = agrees.copy()
            nearest = (surprise / limit)[outside].argsort()[:step]
            agrees[outside[nearest]] = True
            fit = fit_closure(data.subset(agrees), fit.edges)
            continue
        without = _without_the_worst(data, agrees, surprise, limit, fit)
        if without is None:
            break
        agrees, fit = without
    return agrees, fit


def _without_the_worst(
    data: Closure, agrees: Mask, surprise: FloatArray, limit: FloatArray, fit: ClosureFit
) -> tuple[Mask, ClosureFit] | None:
    """Leaves the worst view out where noise that it has no say in does not explain it."""
    worst = int(np.where(agrees, surprise / limit, -1.0).argmax())
    if surprise[worst] < _SUSPECT_SHARE * limit[worst] or agrees.sum() <= LEAST_VIEWS:
        return None
    fewer = agrees.copy()
    fewer[worst] = False
    again = fit_closure(data.subset(fewer), fit.edges)
    beyond = surprises(data, fewer, again)[worst] > limit[worst]
    return (fewer, again) if beyond else None
