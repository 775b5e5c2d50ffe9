"""Hand-eye calibration by closed forms, AX = XB and AX = ZB, for one robot and one camera."""

from collections.abc import Sequence

import numpy as np

from visioncal.core.transforms import invert, robot_part
from visioncal.core.types import Mount
from visioncal.estimation.chain import scatter
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.results import SolverResult


def compare_solvers(
    problem: Problem, state: State, mount: Mount, solver: str, names: Sequence[str]
) -> dict[str, SolverResult]:
    """Results of all solvers for the same views, by solver.

    Args:
        problem: The measurements; the unknown frames are the camera's and the targets'.
        state: The fitted state.
        mount: Mount of the camera.
        solver: Solver of the fitted state.
        names: Names of the edges in results, the camera's first.

    Returns:
        The joint fit's result, where it is the solver; closed forms, where poses were measured.
    """
    states = {"joint": state} if solver == "joint" else {}
    if not problem.points:
        states |= {name: closed_form_state(problem, name, state, mount) for name in SOLVERS}
    return {name: _answer(problem, state, names) for name, state in states.items()}


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


def _answer(problem: Problem, state: State, names: Sequence[str]) -> SolverResult:
    residuals_m, residuals_rad = scatter(problem, problem, state)
    rms_rad = None if problem.points else np.sqrt(np.mean(residuals_rad**2))
    return SolverResult(
        dict(zip(names, state.edges, strict=False)),
        1e3 * float(np.sqrt(np.mean(residuals_m**2))),
        None if rms_rad is None else float(np.rad2deg(rms_rad)),
    )
