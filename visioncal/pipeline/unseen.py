"""Views that no fit has seen: left out in turn, and held back, by the arm as stated and by ours."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from visioncal.estimation.closure import Closure
from visioncal.estimation.problem import State
from visioncal.pipeline.known import Known
from visioncal.stages.handeye import refit
from visioncal.stages.kinematics import Kinematics
from visioncal.stages.validate import HeldOut, apart, chain_rms_px, validate
from visioncal.types import FloatArray, IntArray, Mask


def left_out(known: Known) -> HeldOut:
    """Residuals of the used views, each by a fit without its stop."""
    data, result, stops = known.closure(known.used), known.solved, known.stops
    problem, boards, seen = data.problem, known.shown(known.used), known.seen(known.used)

    def again(kept: Mask) -> State:
        numbered = np.unique(stops[kept], return_inverse=True)[1]
        return refit(data.subset(kept).merged(numbered), result, known.solver).state

    def own(state: State) -> FloatArray:
        return boards.moved(state.values).first_from_own

    def pixels(rows: IntArray, state: State) -> FloatArray:
        chosen = np.isin(np.arange(len(problem)), rows)
        poses = problem.subset(chosen).predicted(state) @ own(state)[rows]
        return chain_rms_px([seen[it] for it in rows], poses, known.free, state.values)

    needs = [(boards.names[it],) for it in boards.shown]
    found = validate(problem, stops, needs, again, pixels, own)
    fit = "whole fit" if data.mount == "instrument" else "hand-eye fit"
    unknown = np.full(len(problem), np.nan)
    return replace(
        found,
        method=f"{found.method}, of the {fit}",
        away_rad=found.away_rad if data.guess is None else unknown,
    )


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
    stated = replace(known, arm=None, arm_model=None, frames=known.compared_frames)
    lost = stated.stated_closure(views)
    data = (stated.closure(views) if lost is None else lost, known.closure(views))
    states = (found.fits[0].fit.state, known.solved.edges.state)
    before, after = (
        _apart(one, two, it, views)
        for one, two, it in zip((stated, known), data, states, strict=True)
    )
    return np.stack(before[::-1], axis=1), np.stack(after[::-1], axis=1)


def _apart(
    known: Known, data: Closure, state: State, views: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """How far (m,) [m] and (m,) [rad] views place their boards from where the edges do."""
    own = known.shown(views).moved(state.values).first_from_own
    return apart(data.problem, state, own)


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
