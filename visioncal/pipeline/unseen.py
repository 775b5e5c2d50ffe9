"""Views that no fit has seen: left out in turn, and held back, by the arm as stated and by ours."""

from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem
from visioncal.pipeline.known import Known
from visioncal.pipeline.views import chain_px
from visioncal.stages.handeye import refit
from visioncal.stages.kinematics import Kinematics, unseen_rows
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


def held_back(known: Known, found: Kinematics) -> list[dict[str, Any]]:
    """How far views that no fit may use are off: by the nominal arm with its own edges, by ours."""
    views = sorted(known.measurable_held_back)
    stated = replace(known, calibrated=known.robot_arm.erring(None))
    problem = stated.problem(views)
    lost = stated.arm_at(stated.first_of_stops(views)).stated(problem)
    before = apart(problem if lost is None else lost, found.fits[0].fit.state)
    after = apart(known.problem(views), known.solved.state)
    turned = np.full(len(views), not problem.points)
    was, now = (np.stack(it[::-1], axis=1) for it in (before, after))
    return list(unseen_rows(views, was, now, turned))
