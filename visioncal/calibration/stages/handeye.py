"""Hand-eye calibration by closed forms, AX = XB and AX = ZB, for one robot and one camera."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount
from visioncal.estimation.chain import robot_part, scatter
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Edges (1 + b, 4, 4) by one solver, and the rms scatter of the targets.

    The scatter of rotation is None where only positions were measured.
    """

    edges: FloatArray
    rms_m: float
    rms_rad: float | None


def compare_solvers(
    problem: Problem, state: State, mount: Mount, solver: str
) -> dict[str, SolverResult]:
    """Results of all solvers for the same views, by solver.

    Args:
        problem: The measurements; the unknown frames are the camera's and the targets'.
        state: The fitted state.
        mount: Mount of the camera.
        solver: Solver of the fitted state.

    Returns:
        The joint fit's result, where it is the solver; closed forms, where poses were measured.
    """
    states = {"joint": state} if solver == "joint" else {}
    if not problem.points:
        states |= {name: closed_form_state(problem, name, state, mount) for name in SOLVERS}
    return {name: _answer(problem, state) for name, state in states.items()}


def closed_form_state(problem: Problem, solver: str, start: State, mount: Mount) -> State:
    """Edges by a closed form, with all targets transformed to the first one.

    Args:
        problem: The measurements.
        solver: Name of the closed form.
        start: Relative poses of the targets, and values of effects.
        mount: Mount of the camera.
    """
    seen, from_first = problem.observations, invert(start.edges[1:]) @ start.edges[1]
    targets = [problem.unknown[name] - 1 for name in seen.observed]
    robot = robot_part(problem.poses[problem.robots[0]][seen.stops], mount)
    edges = SOLVERS[solver](robot, seen.measured @ from_first[targets])
    return State(np.stack([edges.x, *(edges.z @ invert(from_first))]), start.values)


def _answer(problem: Problem, state: State) -> SolverResult:
    residuals_m, residuals_rad = scatter(problem, problem, state)
    return SolverResult(
        state.edges,
        float(np.sqrt(np.mean(residuals_m**2))),
        None if problem.points else float(np.sqrt(np.mean(residuals_rad**2))),
    )
