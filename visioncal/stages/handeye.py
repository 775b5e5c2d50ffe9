"""Stage 5: the two unknown edges, AX = XB and AX = ZB, by every solver."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from visioncal.errors import DataError
from visioncal.estimator.closure import (
    Closure,
    ClosureFit,
    Noise,
    closure_information,
    deviations,
    estimate_noise,
    fit_closure,
    moved_by,
    solve_closure,
)
from visioncal.estimator.linalg import covariance, one_blas_thread
from visioncal.estimator.observability import Direction, check_observability
from visioncal.solvers import SOLVERS
from visioncal.transforms import invert, mean_transform
from visioncal.types import FloatArray, Mount, SolverName

SOLVER_NAMES: tuple[str, ...] = get_args(SolverName)

# The closed form that starts the joint fit: the most accurate of them on noisy poses.
_START = "park"


@dataclass(frozen=True, eq=False)
class Solution:
    """Both edges (4, 4) by one solver, and the scatter of the target that they leave."""

    x: FloatArray
    z: FloatArray
    rms_m: float
    rms_rad: float


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """The answer, and what the other solvers make of the same views.

    Attributes:
        x: (4, 4) `flange_from_cam` or `base_from_cam`.
        z: (4, 4) `base_from_target` or `flange_from_target`.
        covariance: (12, 12) of both, right perturbations, x first.
        noise: Of the residuals in the target's frame.
        solutions: Every solver's edges by name, the answer's own among them.
        worst: The worst directions of each edge.
    """

    x: FloatArray
    z: FloatArray
    covariance: FloatArray
    noise: Noise
    solutions: Mapping[str, Solution]
    worst: tuple[Direction, ...]


@dataclass(frozen=True, eq=False)
class LensUncertainty:
    """What estimated intrinsics leave open: an error that all views share.

    Attributes:
        covariance: (k, k) of the intrinsics.
        camera_shift: (m, 6, k) how each view's `cam_from_target` moves with them.
    """

    covariance: FloatArray
    camera_shift: FloatArray


def robot_part(base_from_flange: FloatArray, mount: Mount) -> FloatArray:
    """The robot's part (m, 4, 4) of the chain `robot * x * camera = z`."""
    return base_from_flange if mount == "eye-in-hand" else invert(base_from_flange)


def solve_hand_eye(
    data: Closure,
    mount: Mount,
    solver: SolverName = "joint",
    lens: LensUncertainty | None = None,
) -> HandEyeResult:
    """Solves for both unknown edges.

    Args:
        data: The used views.
        mount: Which tree it is.
        lens: What is open about estimated intrinsics; it widens the covariance.
        solver: `joint` for the whitened fit of both edges, or a closed form's name.

    Returns:
        The answer with its covariance.

    Raises:
        DataError: There is no such solver.
        DegenerateError: The motion leaves a direction of an edge open.
    """
    if solver not in SOLVER_NAMES:
        raise DataError(f"solver {solver!r} is not one of {', '.join(SOLVER_NAMES)}.")
    with one_blas_thread():
        if len(data) < 3:
            # Raises, and says what is missing: no solver can answer.
            check_observability(data, np.eye(4), np.eye(4), Noise(1.0, 1.0), mount)
        closed = {name: solve(data.robot, data.camera) for name, solve in SOLVERS.items()}
        start = closed[_START if solver == "joint" else solver]
        if solver == "joint":
            fit = fit_closure(data, start.x, start.z)
        else:
            fit = ClosureFit(start.x, start.z, estimate_noise(data, start.x, start.z))
        common = np.zeros((12, 12))
        if lens is not None:
            moved = moved_by(data, fit.x, fit.z, fit.noise, lens.camera_shift)
            common = moved @ lens.covariance @ moved.T
        worst = check_observability(data, fit.x, fit.z, fit.noise, mount, common)
        spread = covariance(closure_information(data, fit.x, fit.z, fit.noise)) + common
    solutions = {"joint": _solution(data, fit.x, fit.z)} if solver == "joint" else {}
    solutions |= {name: _solution(data, it.x, it.z) for name, it in closed.items()}
    return HandEyeResult(fit.x, fit.z, spread, fit.noise, solutions, worst)


def refit(
    data: Closure, result: HandEyeResult, solver: SolverName
) -> tuple[FloatArray, FloatArray]:
    """Solves again from fewer views, with the noise that is already known."""
    if solver == "joint":
        return solve_closure(data, result.x, result.z, result.noise)
    again = SOLVERS[solver](data.robot, data.camera)
    return again.x, mean_transform(data.placed(again.x))


def _solution(data: Closure, x: FloatArray, z: FloatArray) -> Solution:
    away_m, away_rad = deviations(data.placed(x))
    return Solution(x, z, float(np.sqrt(np.mean(away_m**2))), float(np.sqrt(np.mean(away_rad**2))))
