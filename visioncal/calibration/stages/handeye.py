"""The unknown edges of one robot and one camera, AX = XB and AX = ZB, by every closed form."""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from visioncal.core.choices import SolverName
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount
from visioncal.estimation.chain import robot_part, scatter
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem

SOLVER_NAMES: tuple[str, ...] = get_args(SolverName)


@dataclass(frozen=True, eq=False)
class Answer:
    """All edges (1 + b, 4, 4) by one solver, and the scatter of the targets that they leave.

    That of their rotation is None where places alone were read.
    """

    edges: FloatArray
    rms_m: float
    rms_rad: float | None


def compare_solvers(problem: Problem, state: State, mount: Mount, solver: str) -> dict[str, Answer]:
    """What every solver makes of the same views, by its name.

    Args:
        problem: What was measured; its unknown frames are the camera's and the targets'.
        state: The answer.
        mount: Where the camera is.
        solver: Whose it is.

    Returns:
        The answer first where it is the joint fit's, then every closed form where poses were read.
    """
    found = {"joint": state} if solver == "joint" else {}
    if not problem.points:
        found |= {name: closed_form_state(problem, name, state, mount) for name in SOLVERS}
    return {name: _answer(problem, item) for name, item in found.items()}


def closed_form_state(problem: Problem, solver: str, start: State, mount: Mount) -> State:
    """The edges by a closed form, which takes several targets for one.

    Args:
        problem: What was measured.
        solver: The closed form's name.
        start: How the targets lie to each other, and the values of effects.
        mount: Where the camera is.
    """
    seen, from_first = problem.observations, invert(start.edges[1:]) @ start.edges[1]
    shown = [problem.unknown[name] - 1 for name in seen.observed]
    robot = robot_part(problem.poses[problem.robots[0]][seen.stops], mount)
    found = SOLVERS[solver](robot, seen.measured @ from_first[shown])
    return State(np.stack([found.x, *(found.z @ invert(from_first))]), start.values)


def _answer(problem: Problem, state: State) -> Answer:
    away_m, away_rad = scatter(problem, problem, state)
    return Answer(
        state.edges,
        float(np.sqrt(np.mean(away_m**2))),
        None if problem.points else float(np.sqrt(np.mean(away_rad**2))),
    )
