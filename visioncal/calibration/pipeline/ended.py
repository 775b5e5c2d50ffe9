"""The fit as a session ends: with a frame that was moved at once where it has stood since."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.arm_results import STEP, covariance_from_other_sources
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.fit import Fit
from visioncal.estimation.moves import moved
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import Solution
from visioncal.estimation.steps import FRAME, Step, with_step


def as_it_ends(fit: Fit, problem: Problem, arms: Mapping[str, Arm], steps: Sequence[Step]) -> Fit:
    """The fit after the likeliest step, if that is of a frame; itself after none, or another one.

    Picks come after the session. The covariance is that of a fit with the step, with what others
    about as likely make of it. Views before the step are off by it. The `problem` is that of the
    fit, or has views from the step on, too.
    """
    if not steps or steps[0].kind != FRAME:
        return fit
    ends = [_after(replace(fit, problem=problem), step) for step in steps]
    (wide, columns, state), *_ = ends
    solution = Solution(state, wide.noise)
    ended = replace(fit, solution=solution)
    weights = np.exp(0.5 * np.array([step.gain - steps[0].gain for step in steps]))
    away = np.array([_apart(state, other) for *_, other in ends])
    spread = np.einsum("k,ki,kj->ij", weights / weights.sum(), away, away)
    part = np.ix_(columns, columns)
    sources = covariance_from_other_sources(wide, arms, ())
    by_source = {**fit.by_source, **{name: source[part] for name, source in sources.items()}}
    by_source[STEP] = spread + wide.by_noise[part] - ended.by_noise
    return replace(ended, by_source=by_source)


def as_it_went(cell_fit: CellFit, steps: Sequence[Step]) -> CellFit:
    """The fit with the likeliest step, if that is of a frame, as a move; itself after none.

    Residuals are those of it: before and after, each view by the frame as it stood then.
    """
    if not steps or steps[0].kind != FRAME:
        return cell_fit
    inliers, frame = cell_fit.inlier_fit, steps[0].of
    for step in (*steps[0].earlier, steps[0]):
        problem, fit, move = moved(inliers.problem, inliers.fit, frame, step.stop, step.value)
        inliers = replace(inliers, problem=problem, fit=fit, moves=(*inliers.moves, move))
        frame = move.twin
    return replace(cell_fit, inlier_fit=inliers.refitted())


def _after(fit: Fit, step: Step) -> tuple[Fit, IntArray, State]:
    """A fit with a step, the columns of what it has last of each unknown, and their state."""
    problem, solution = with_step(fit.problem, fit.solution, step)
    names, last = [*problem.unknown], {step.of: [*problem.unknown][-1]}
    last = last if step.kind == FRAME else {}
    final = [last.get(name, name) for name in fit.problem.unknown]
    others = np.arange(6 * len(names), problem.size)[: fit.problem.size - 6 * len(final)]
    columns = [np.r_[problem.edge_columns(name)] for name in final]
    edges = solution.state.edges[[names.index(name) for name in final]]
    state = State(edges, solution.state.values[: len(fit.state.values)])
    wide = replace(fit, problem=problem, solution=solution)
    return wide, np.concatenate([*columns, others]), state


def _apart(one: State, other: State) -> FloatArray:
    """(p,) the step from one state to another."""
    between = log(invert(one.edges) @ other.edges)
    return np.concatenate([between.ravel(), other.values - one.values])
