"""Views that no fit has seen: left out in turn, and held back, by the arm as stated and by ours."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from visioncal.estimation.problem import Problem, State
from visioncal.pipeline.known import Known
from visioncal.pipeline.views import chain_px
from visioncal.stages.handeye import refit
from visioncal.stages.kinematics import Kinematics
from visioncal.stages.validate import HeldOut, apart, validate
from visioncal.types import FloatArray, IntArray


def left_out(known: Known) -> HeldOut:
    """Residuals of the used views, each by a fit without its stop."""
    result, mount = known.solved, known.session.mount
    problem, views = known.problem(known.used), np.array(known.used)

    def again(part: Problem) -> State:
        return refit(part.merged(), result, mount, known.solver)

    def pixels(rows: IntArray, state: State) -> FloatArray:
        part = problem.subset(np.isin(np.arange(len(problem)), rows))
        return chain_px(known, views[rows].tolist(), part, state)

    fit = "whole fit" if mount == "instrument" else "hand-eye fit"
    return validate(problem, again, pixels, f", of the {fit}")


def unseen_views(known: Known, found: Kinematics) -> dict[str, list[dict[str, Any]]]:
    """How far such views are off by both arms: left out in turn, and held back by the session.

    What one stop shows of a target goes by its first view.
    """
    before, after = (_lengths(fit.left_out) for fit in found.fits)
    first = np.unique(known.problem(known.used).of_one_stop, return_index=True)[1]
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
    stated = replace(known, calibrated=known.robot_arm.erring(None))
    problem = stated.problem(views)
    lost = stated.arm_at(stated.first_of_stops(views)).stated(problem)
    before = apart(problem if lost is None else lost, found.fits[0].fit.state)
    after = apart(known.problem(views), known.solved.state)
    return np.stack(before[::-1], axis=1), np.stack(after[::-1], axis=1)


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
