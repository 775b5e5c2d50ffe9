"""Stage 5: the two unknown edges, AX = XB and AX = ZB, by every solver."""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from visioncal.errors import ConvergenceError
from visioncal.estimation.arm import ArmErrors, misfit_covariance
from visioncal.estimation.boards import Boards
from visioncal.estimation.closure import (
    Closure,
    ClosureFit,
    Edges,
    Noise,
    closure_information,
    estimate_noise,
    fit_closure,
    solve_closure,
)
from visioncal.estimation.linalg import covariance
from visioncal.estimation.observability import (
    Direction,
    check_observability,
    directions,
    refuse_too_few,
    title,
)
from visioncal.estimation.problem import ROBOT
from visioncal.estimation.solve import Solution as Solved
from visioncal.estimation.solve import held_shift
from visioncal.solvers import SOLVERS
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert
from visioncal.types import FloatArray, Mount, SolverName

SOLVER_NAMES: tuple[str, ...] = get_args(SolverName)

# The closed form that starts the joint fit: the most accurate of them on noisy poses.
_START = "park"


@dataclass(frozen=True, eq=False)
class Solution:
    """Both edges (4, 4) by one solver, and the scatter of the target that they leave.

    That of its rotation is None where places alone were read.
    """

    x: FloatArray
    z: FloatArray
    rms_m: float
    rms_rad: float | None


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """The answer of one solver.

    Attributes:
        edges: x is `flange_from_cam` or `base_from_cam`; z is `base_from_target` or
            `flange_from_target`; with them the change of lens, board and links.
        covariance: (12 + k, 12 + k) of x, z (right perturbations) and of what the views share.
        noise: Of the flange, or of both together.
        worst: The worst directions of each edge, those of further boards behind the others.
        held: (12 + k,) how far the answer would move if what is held moved as well; its square is
            in the covariance.
    """

    edges: Edges
    covariance: FloatArray
    noise: Noise
    worst: tuple[Direction, ...]
    held: FloatArray


def robot_part(base_from_flange: FloatArray, mount: Mount) -> FloatArray:
    """The robot's part (m, 4, 4) of the chain `robot * x * camera = z`."""
    return base_from_flange if mount == "eye-in-hand" else invert(base_from_flange)


def solve_hand_eye(
    data: Closure,
    solver: SolverName = "joint",
    arm: ArmErrors | None = None,
    looks: int = 0,
    boards: Boards | None = None,
    start: Edges | None = None,
) -> HandEyeResult:
    """Solves for both unknown edges.

    The covariance is that of the joint fit at the noise which the answer leaves. A closed form uses
    the views less well: for it, that is the least it can be.

    Args:
        data: The used views.
        solver: `joint` for the whitened fit of both edges, or a closed form's name.
        arm: Errors that follow the arm's posture, at the same views. Those of its links are among
            what the views share; others are noise to the fit and count in the covariance.
        looks: How many of the unknowns that the views share are of lens and board; they come first.
        boards: What the views show, where there are several boards; of a stop that shows several,
            one of them.
        start: Where the joint fit begins; a closed form's edges where none are given.

    Returns:
        The answer with its covariance.

    Raises:
        DegenerateError: The motion leaves a direction of an edge open.
        ConvergenceError: The joint fit does not come to rest on motion that should allow it.
    """
    boards = boards or Boards.one(len(data))
    with one_blas_thread():
        refuse_too_few(data)
        if solver == "joint":
            begin = data.guess or start or SOLVERS[_START](data.robot, data.camera)
            fit = fit_closure(data, Edges(begin.x, begin.z, data.unchanged))
        else:
            edges = _closed_form(data, solver)
            fit = ClosureFit(edges, estimate_noise(data, edges))
        check_observability(data, fit.edges, fit.noise, boards, looks)
        # Away from its rest a closed form is pulled by more than what is held.
        rest = Solved(fit.edges.state, fit.noise.levels)
        shift = held_shift(data.problem, rest) * float(solver == "joint")
        spread = covariance(closure_information(data, fit.edges, fit.noise))
        spread = spread + np.outer(shift, shift)
        if arm is not None and not arm.is_estimated:
            spread = spread + misfit_covariance(
                data.problem, fit.edges.state, fit.noise.levels, ROBOT, arm
            )
    if not fit.settled:
        raise ConvergenceError(
            f"{title(data.mount)}: the joint fit of {len(data)} views does not come to rest.",
            next_step="Take another solver with --solver, and look at the worst views.",
        )
    worst = directions(spread, fit.edges, data.mount, boards)
    return HandEyeResult(fit.edges, spread, fit.noise, worst, shift)


def compare_solvers(
    data: Closure, edges: Edges, solver: SolverName, boards: Boards
) -> dict[str, Solution]:
    """What every solver makes of the same views, by its name.

    Args:
        data: The used views.
        edges: The answer.
        solver: Whose it is.
        boards: What the views show.

    Returns:
        The answer first where it is the joint fit's, then every closed form where poses were read.
    """
    found = {"joint": edges} if solver == "joint" else {}
    if data.guess is None:
        found |= {name: _closed_form(data, name) for name in SOLVERS}
    return {name: _solution(data, it, boards) for name, it in found.items()}


def refit(data: Closure, result: HandEyeResult, solver: SolverName) -> Edges:
    """Solves again from fewer views, with the noise that is already known."""
    if solver == "joint":
        return solve_closure(data, result.edges, result.noise)[0]
    return _closed_form(data, solver)


def _closed_form(data: Closure, solver: str) -> Edges:
    found = SOLVERS[solver](data.robot, data.camera)
    return Edges(found.x, found.z, data.unchanged)


def _solution(data: Closure, edges: Edges, boards: Boards) -> Solution:
    placed = data.under(edges.shared).placed(edges.x)
    away_m, away_rad = boards.deviations(placed, edges.shared)
    return Solution(
        edges.x,
        edges.z,
        float(np.sqrt(np.mean(away_m**2))),
        float(np.sqrt(np.mean(away_rad**2))) if data.guess is None else None,
    )
