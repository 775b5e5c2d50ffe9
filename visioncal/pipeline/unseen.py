"""What an arm as stated and the calibrated one make of views that the fit had not seen."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from visioncal.estimation.closure import Closure, Edges, distances
from visioncal.pipeline.known import Known
from visioncal.stages.kinematics import Kinematics
from visioncal.types import FloatArray


def unseen_views(known: Known, found: Kinematics) -> dict[str, list[dict[str, Any]]]:
    """How far such views are off by both arms: left out in turn, and held back by the session.

    A stop that was left out goes by its first view.
    """
    before, after = (_lengths(fit.left_out) for fit in found.fits)
    first = np.unique(known.stops, return_index=True)[1]
    left_out = [known.used[int(at)] for at in first]
    rows = partial(_rows, turned=known.readings is None or known.readings.are_poses)
    documents = {"left_out": list(rows(left_out, before, after))}
    views = sorted(known.measurable_held_back)
    if views:
        before, after = _held_back(known, found, views)
        documents["holdout"] = list(rows(views, before, after))
    return documents


def _held_back(
    known: Known, found: Kinematics, views: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Residuals of views that no fit may use: by the nominal arm with its own edges, and by ours.

    Returns:
        Twice (m, 2) rotation [rad] and distance [m].
    """
    stated = replace(known, arm=None, arm_model=None, from_first=known.compared_from_first)
    lost = stated.stated_closure(views)
    data = (stated.closure(views) if lost is None else lost, known.closure(views))
    nominal = found.fits[0].fit.state
    edges = (Edges(nominal.edges[0], nominal.edges[1], nominal.values), known.solved.edges)
    before, after = (
        _distances(one, two, it, views)
        for one, two, it in zip((stated, known), data, edges, strict=True)
    )
    return np.stack(before[::-1], axis=1), np.stack(after[::-1], axis=1)


def _distances(
    known: Known, data: Closure, edges: Edges, views: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """How far (m,) [m] and (m,) [rad] views place their boards from where the edges do."""
    own = known.shown(views).moved(edges.shared).first_from_own
    placed = data.under(edges.shared).placed(edges.x)
    return distances(placed @ own, edges.z @ own)


def _lengths(twists: FloatArray) -> FloatArray:
    """(m, 2) angles [rad] and distances [m] of (m, 6) residuals."""
    return np.asarray(np.linalg.norm(twists.reshape(-1, 2, 3), axis=2))


def _rows(
    views: Sequence[int], before: FloatArray, after: FloatArray, *, turned: bool
) -> Iterator[dict[str, Any]]:
    """One row a view; without degrees where places alone were read."""
    for view, was, now in zip(views, before, after, strict=True):
        row: dict[str, Any] = {
            "view": view,
            "nominal_mm": 1e3 * float(was[1]),
            "nominal_deg": float(np.rad2deg(was[0])),
            "mm": 1e3 * float(now[1]),
            "deg": float(np.rad2deg(now[0])),
        }
        yield {name: it for name, it in row.items() if turned or not name.endswith("deg")}
