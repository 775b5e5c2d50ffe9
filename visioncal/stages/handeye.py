"""Stage 5: the unknown edges, AX = XB and AX = ZB, by every solver."""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from visioncal.errors import ConvergenceError
from visioncal.estimation.arm import ArmErrors, misfit_covariance
from visioncal.estimation.chain import robot_part, scatter
from visioncal.estimation.observability import (
    Direction,
    check_observability,
    directions,
    refuse_too_few,
    title,
)
from visioncal.estimation.parts import ROBOT, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    estimate_noise,
    fit_problem,
    held_shift,
    solve_problem,
    starting_noise,
)
from visioncal.solvers import SOLVERS
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert
from visioncal.types import FloatArray, Mount, SolverName

SOLVER_NAMES: tuple[str, ...] = get_args(SolverName)

# The closed form that starts the joint fit: the most accurate of them on noisy poses.
_START = "park"


@dataclass(frozen=True, eq=False)
class Answer:
    """All edges (1 + b, 4, 4) by one solver, and the scatter of the targets that they leave.

    That of their rotation is None where places alone were read.
    """

    edges: FloatArray
    rms_m: float
    rms_rad: float | None


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """The answer of one solver.

    Attributes:
        problem: What was measured; its unknowns are the camera's edge, the targets' and the values
            of effects.
        fit: The unknowns and the noise.
        covariance: (p, p) of the unknowns.
        worst: The worst directions of each edge.
        held: (p,) how far the answer would move if what is held moved as well; its square is in
            the covariance.
    """

    problem: Problem
    fit: Solution
    covariance: FloatArray
    worst: tuple[Direction, ...]
    held: FloatArray

    @property
    def state(self) -> State:
        """The unknowns."""
        return self.fit.state

    @property
    def noise(self) -> Noise:
        """Of the flange, or of flange and camera as one."""
        return self.fit.noise


def solve_hand_eye(
    problem: Problem,
    mount: Mount,
    solver: SolverName = "joint",
    arm: ArmErrors | None = None,
    *,
    looks: bool = False,
    start: State | None = None,
) -> HandEyeResult:
    """Solves for all unknown edges.

    The covariance is that of the joint fit at the noise which the answer leaves. A closed form uses
    the views less well: for it, that is the least it can be.

    Args:
        problem: What was measured, one observation of a target at a stop.
        mount: Where the camera is.
        solver: `joint` for the whitened fit of all edges, or a closed form's name.
        arm: Errors that follow the arm's posture, at the same stops. Those of its links are among
            the effects; others are noise to the fit and count in the covariance.
        looks: Whether the views have to tell the first effect: lens and board, or further points.
        start: Where the joint fit begins, and how several targets lie to each other for a closed
            form; a closed form's edges where None.

    Returns:
        The answer with its covariance.

    Raises:
        DegenerateError: The motion leaves a direction of an edge open.
        ConvergenceError: The joint fit does not come to rest on motion that should allow it.
    """
    with one_blas_thread():
        refuse_too_few(problem, mount)
        if solver == "joint":
            fit = fit_problem(problem, start or _closed_form(problem, mount, _START))
        else:
            found, noise = _closed_form(problem, mount, solver, start), starting_noise(problem)
            fit = Solution(found, estimate_noise(problem, found, noise, from_above=True))
        check_observability(problem, fit.state, fit.noise, mount, looks=looks)
        # Away from its rest a closed form is pulled by more than what is held.
        shift = held_shift(problem, fit) * float(solver == "joint")
        spread = covariance_of(problem, fit) + np.outer(shift, shift)
        if arm is not None and not arm.is_estimated:
            spread = spread + misfit_covariance(problem, fit.state, fit.noise, ROBOT, arm)
    if not fit.settled:
        raise ConvergenceError(
            f"{title(mount)}: the joint fit of {len(problem)} views does not come to rest.",
            next_step="Take another solver with --solver, and look at the worst views.",
        )
    worst = directions(problem, fit.state, spread, mount)
    return HandEyeResult(problem, fit, spread, worst, shift)


def compare_solvers(result: HandEyeResult, mount: Mount, solver: SolverName) -> dict[str, Answer]:
    """What every solver makes of the same views, by its name.

    Args:
        result: The answer.
        mount: Where the camera is.
        solver: Whose it is.

    Returns:
        The answer first where it is the joint fit's, then every closed form where poses were read.
    """
    problem, found = result.problem, {"joint": result.state} if solver == "joint" else {}
    if not problem.points:
        found |= {it: _closed_form(problem, mount, it, result.state) for it in SOLVERS}
    return {name: _answer(problem, it) for name, it in found.items()}


def refit(problem: Problem, result: HandEyeResult, mount: Mount, solver: SolverName) -> State:
    """Solves again from fewer views, with the noise that is already known."""
    if solver == "joint":
        return solve_problem(problem, result.state, result.noise)[0]
    return _closed_form(problem, mount, solver, result.state)


def _closed_form(problem: Problem, mount: Mount, solver: str, start: State | None = None) -> State:
    """The edges by a closed form, which takes several targets for one; see `solve_hand_eye`."""
    seen, from_first = problem.observations, np.eye(4)[None]
    if start is not None:
        from_first = invert(start.edges[1:]) @ start.edges[1]
    shown = [problem.unknown[it] - 1 for it in seen.observed]
    robot = robot_part(problem.poses[ROBOT][seen.stops], mount)
    found = SOLVERS[solver](robot, seen.measured @ from_first[shown])
    return State(np.stack([found.x, *(found.z @ invert(from_first))]), problem.start_values)


def _answer(problem: Problem, state: State) -> Answer:
    away_m, away_rad = scatter(problem, problem, state)
    return Answer(
        state.edges,
        float(np.sqrt(np.mean(away_m**2))),
        None if problem.points else float(np.sqrt(np.mean(away_rad**2))),
    )
