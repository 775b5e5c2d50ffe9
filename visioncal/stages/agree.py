"""Takes out the views that are wrong as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from visioncal.chance import chi2_limit
from visioncal.estimation.boards import Boards
from visioncal.estimation.closure import Closure, Edges, distances
from visioncal.estimation.outliers import LEAST_VIEWS, inliers
from visioncal.estimation.problem import State
from visioncal.estimation.variance import LEAST_SIGMA
from visioncal.figures import figure
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert, log
from visioncal.types import IntArray, Mask, Mount, Rejection

# Two sound images of one stop disagree in one session of a thousand.
_FALSE_ALARM = 1e-3
# The noise of measured poses differs by so much from view to view: with tilt and distance.
_UNEVEN = 3.0


@dataclass(frozen=True, eq=False)
class Agreed:
    """The views that agree.

    Attributes:
        mask: (m,) which ones.
        edges: Both edges as they see them.
        rejections: The others, with the figures.
    """

    mask: Mask
    edges: Edges
    rejections: tuple[Rejection, ...]


def agree(
    data: Closure,
    views: Sequence[int],
    stops: IntArray,
    start: Agreed | None = None,
    boards: Boards | None = None,
) -> Agreed:
    """Finds the views whose robot pose and image belong together.

    Args:
        data: The chain's known parts, one entry a view.
        views: The views' numbers.
        stops: (m,) which stop of the robot each was taken at. A stop is right or wrong as a whole,
            unless its own images contradict each other: then each is compared with the other stops.
            So are its views of several boards.
        start: What was found of the same views before; None for a search without any idea.
        boards: What the views show, where there are several boards.

    Returns:
        The views that agree with each other, and why the others do not.
    """
    with one_blas_thread():
        units = whole_units(data, stops if boards is None else boards.units(stops))
        merged, thought = data.merged(units), None
        if start is not None:
            thought = np.bincount(units, start.mask) > 0
        elif boards is not None and boards.unknowns:
            thought = _board_by_board(merged, units, boards)
        found = inliers(merged.problem, _guess(merged), thought)
    mask, state = found.used[units], found.fit.state
    edges = Edges(state.edges[0], state.edges[1], state.values)
    placed, z = data.under(edges.shared).placed(edges.x), edges.z[None]
    if boards is not None:
        own = boards.moved(edges.shared).first_from_own
        placed, z = placed @ own, z @ own
    away_m, away_rad = distances(placed, z)
    away = found.distances
    counted = np.maximum(away.directions, 1)
    surprise, limit = (np.sqrt(it / counted)[units] for it in (away.squares, away.limit))
    seen = "target" if data.mount != "instrument" else "probe" if data.guess is None else "point"
    rejections = []
    for at in np.flatnonzero(~mask).tolist():
        turned = "" if data.guess is not None else f" and {figure(np.rad2deg(away_rad[at]))} deg"
        of_its_board = np.zeros(len(views), dtype=bool)
        if boards is not None and boards.unknowns:
            of_its_board = (boards.shown == boards.shown[at]) & mask
        cause = _cause(views, (stops == stops[at]) & mask, of_its_board, data.mount)
        rejections.append(
            Rejection(
                views[at],
                f"disagrees with the other views: it places the {seen} {figure(1e3 * away_m[at])} "
                f"mm{turned} away, {figure(surprise[at])} times the noise (limit "
                f"{figure(limit[at])}); {cause}",
            )
        )
    return Agreed(mask, edges, tuple(rejections))


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
    mates = (np.flatnonzero(stops == it).tolist() for it in np.flatnonzero(np.bincount(stops) > 1))
    first, second = np.array([pair for it in mates for pair in combinations(it, 2)]).T
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


def _guess(data: Closure) -> State | None:
    return None if data.guess is None else replace(data.guess, shared=data.unchanged).state


def _board_by_board(merged: Closure, units: IntArray, boards: Boards) -> Mask:
    """Which units agree with the others of their board.

    An arm that errs and a board of another size look like noise from each board alone, as both
    edges make up for them, and like a wrong board from another one. A board with few views is
    left to the others to judge.
    """
    own = boards.shown[np.unique(units, return_index=True)[1]]
    agrees = np.ones(len(merged), dtype=bool)
    for board in range(len(boards.names)):
        mine = own == board
        if mine.sum() > LEAST_VIEWS:
            agrees[mine] = inliers(merged.subset(mine).with_first(boards.begin).problem).used
    return agrees


def _cause(views: Sequence[int], agreeing_mates: Mask, of_its_board: Mask, mount: Mount) -> str:
    """What is wrong with a view, by those of its stop and its board that agree with all others."""
    if of_its_board.sum() == 1:
        other = views[int(np.flatnonzero(of_its_board)[0])]
        return f"it and view {other} alone show this target, and either may be wrong"
    observed = "reading" if mount == "instrument" else "image"
    mates = np.flatnonzero(agreeing_mates)
    if len(mates):
        return (
            f"view {views[mates[0]]} of the same stop agrees: the {observed} is wrong, or "
            "something moved in between"
        )
    return f"its pose or its {observed} is wrong, or something had moved"
