"""What an arm as stated and the calibrated one make of views that the fit had not seen."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.estimator.closure import distances
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
    documents = {"left_out": list(_rows(left_out, before, after))}
    held = known.held_back & known.poses.keys() & known.base_from_flange.keys()
    if held:
        views = sorted(held)
        before, after = _held_back(known, found, views)
        documents["holdout"] = list(_rows(views, before, after))
    return documents


def _held_back(
    known: Known, found: Kinematics, views: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Residuals of views that no fit may use: by the nominal arm with its own edges, and by ours.

    Returns:
        Twice (m, 2) rotation [rad] and distance [m].
    """
    stated = replace(known, arm=None, arm_model=None)
    lost = stated.stated_closure(views)
    data = (stated.closure(views) if lost is None else lost, known.closure(views))
    edges = (found.fits[0].fit.edges, known.solved.edges)
    before, after = (
        distances(one.under(it.shared).placed(it.x), it.z)
        for one, it in zip(data, edges, strict=True)
    )
    return np.stack(before[::-1], axis=1), np.stack(after[::-1], axis=1)


def _lengths(twists: FloatArray) -> FloatArray:
    """(m, 2) angles [rad] and distances [m] of (m, 6) residuals."""
    return np.asarray(np.linalg.norm(twists.reshape(-1, 2, 3), axis=2))


def _rows(views: Sequence[int], before: FloatArray, after: FloatArray) -> Iterator[dict[str, Any]]:
    for view, was, now in zip(views, before, after, strict=True):
        yield {
            "view": view,
            "nominal_mm": 1e3 * float(was[1]),
            "nominal_deg": float(np.rad2deg(was[0])),
            "mm": 1e3 * float(now[1]),
            "deg": float(np.rad2deg(now[0])),
        }
