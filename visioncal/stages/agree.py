"""Stage 5: takes out the views that are wrong as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.estimator.closure import Closure, Edges, distances
from visioncal.estimator.consensus import Agreement, agreeing_views
from visioncal.estimator.linalg import one_blas_thread
from visioncal.types import IntArray, Mask, Rejection


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
        stops: (m,) which stop of the robot each was taken at: a stop is right or wrong as a whole.
        start: What was found of the same views before; None for a search without any idea.

    Returns:
        The views that agree with each other, and why the others do not.
    """
    thought = None if start is None else np.bincount(stops, start.mask) > 0
    with one_blas_thread():
        found = agreeing_views(data.merged(stops), thought)
    mask = found.agrees[stops]
    seen = data.under(found.fit.edges.shared)
    away_m, away_rad = distances(seen.placed(found.fit.edges.x), found.fit.edges.z)
    return Agreed(
        mask,
        found.fit.edges,
        tuple(
            Rejection(views[at], _reason(found, stops[at], float(away_m[at]), float(away_rad[at])))
            for at in np.flatnonzero(~mask).tolist()
        ),
    )


def _reason(found: Agreement, stop: int, away_m: float, away_rad: float) -> str:
    sigmas, limit = (float(np.sqrt(it / 6.0)) for it in (found.surprise[stop], found.limit))
    return (
        f"disagrees with the other views: it places the target {1e3 * away_m:.2g} mm and "
        f"{np.rad2deg(away_rad):.2g} deg away, {sigmas:.1f} times the noise (limit {limit:.1f}); "
        "its pose or its image is wrong, or something had moved"
    )
