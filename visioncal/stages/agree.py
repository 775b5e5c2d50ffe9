"""Takes out the views that are wrong as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.estimator.closure import Closure, Edges, distances
from visioncal.estimator.consensus import agreeing_views, whole_units
from visioncal.estimator.linalg import one_blas_thread
from visioncal.figures import figure
from visioncal.types import IntArray, Mask, Mount, Rejection


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
    data: Closure, views: Sequence[int], stops: IntArray, start: Agreed | None = None
) -> Agreed:
    """Finds the views whose robot pose and image belong together.

    Args:
        data: The chain's known parts, one entry a view.
        views: The views' numbers.
        stops: (m,) which stop of the robot each was taken at. A stop is right or wrong as a whole,
            unless its own images contradict each other: then each is compared with the other stops.
        start: What was found of the same views before; None for a search without any idea.

    Returns:
        The views that agree with each other, and why the others do not.
    """
    with one_blas_thread():
        units = whole_units(data, stops)
        thought = None if start is None else np.bincount(units, start.mask) > 0
        found = agreeing_views(data.merged(units), thought)
    mask, edges = found.agrees[units], found.fit.edges
    away_m, away_rad = distances(data.under(edges.shared).placed(edges.x), edges.z)
    told = data.merged(units).told
    surprise, limit = (np.sqrt(it / told)[units] for it in (found.surprise, found.limit))
    seen = "target" if data.mount != "instrument" else "probe" if data.guess is None else "point"
    rejections = []
    for at in np.flatnonzero(~mask).tolist():
        turned = "" if data.guess is not None else f" and {figure(np.rad2deg(away_rad[at]))} deg"
        rejections.append(
            Rejection(
                views[at],
                f"disagrees with the other views: it places the {seen} {figure(1e3 * away_m[at])} "
                f"mm{turned} away, {figure(surprise[at])} times the noise (limit "
                f"{figure(limit[at])}); {_cause(views, (stops == stops[at]) & mask, data.mount)}",
            )
        )
    return Agreed(mask, edges, tuple(rejections))


def _cause(views: Sequence[int], agreeing_mates: Mask, mount: Mount) -> str:
    """What is wrong with a view, by the views of its stop that agree with all others."""
    observed = "reading" if mount == "instrument" else "image"
    mates = np.flatnonzero(agreeing_mates)
    if len(mates):
        return (
            f"view {views[mates[0]]} of the same stop agrees: the {observed} is wrong, or "
            "something moved in between"
        )
    return f"its pose or its {observed} is wrong, or something had moved"
