"""Which errors of the arm are told, and by which views."""

from dataclasses import replace

import numpy as np

from visioncal.estimation.armmodel import ArmModel, blocks_of
from visioncal.estimation.problem import ROBOT
from visioncal.pipeline.known import Known
from visioncal.pipeline.layout import without_lost_boards
from visioncal.stages.agree import agree
from visioncal.stages.kinematics import check_asked, choose_level, doubts, findings
from visioncal.transforms import distances, invert, mean_transform
from visioncal.types import Mask

# Poses and joints are written with so many digits [m, rad].
_ROUNDED = 1e-5


def with_views_back(stated: Known, calibrated: Known) -> Known | None:
    """The views that agree when the arm is calibrated; None where that brings none back."""
    before, all_of = stated.agreed, stated.candidates
    if before is None:
        return None
    mount = stated.session.mount
    again = agree(calibrated.problem(all_of), all_of, mount, calibrated.frames, before.mask)
    back = again.mask & (before.mask | _as_reported(stated, before.mask))
    if not (back & ~before.mask).any():
        return None
    return without_lost_boards(stated.agreeing(replace(again, mask=back, frames=before.frames)))


def _as_reported(stated: Known, agrees: Mask) -> Mask:
    """Which candidates' reported poses are those of their joints, as much as the others' are.

    A wrong report says nothing against joints and camera, but would mislead the fit.
    """
    robot, views = stated.zeroed_robot, stated.candidates
    if robot is None:
        return agrees
    nominal = robot.base_from_flange(stated.joints(views))
    tools = invert(nominal) @ stated.flange_poses(views)
    away = distances(tools, mean_transform(tools[agrees]))
    limits = (2.0 * it[agrees].max() + _ROUNDED for it in away)
    near = [it <= limit for it, limit in zip(away, limits, strict=True)]
    return np.asarray(np.all(near, axis=0))


def arm_told(known: Known) -> Known:
    """Chooses which errors of the arm are told, and takes them up as unknowns."""
    robot, agreed = known.zeroed_robot, known.agreed
    can = robot is not None and known.joints_rad is not None and known.solver == "joint"
    check_asked(known.level, can=can)
    if not can or known.level == "hand-eye" or robot is None or agreed is None:
        return known
    stated = replace(known, arm=None)
    first = np.unique(known.stops, return_index=True)[1]
    q, loads = known.joints(known.used), known.loads(known.used)
    model = ArmModel.of(robot, q, stated.flange_poses(known.used)).loaded(q, loads)
    loads = loads.chosen(first)
    bases = {name: model.columns(name, q[first], loads) for name in blocks_of(robot, loads)}
    problem, lost = stated.problem(known.used).merged(), stated.stated_problem(known.used)
    start, told = problem.start(known.frames), None if lost is None else lost.merged()
    found = choose_level(problem, start, ROBOT, bases, known.level, told)
    known = replace(known, kinematics=found, notes=(*known.notes, *findings(found)))
    known = known.noting((), doubts(found))
    if not found.errors:
        return known
    return replace(known, arm_model=model.erring(found.errors))
