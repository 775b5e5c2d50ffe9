"""Both edges of a chain, straight from what was measured: without images, outliers or an arm."""

from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.estimation.chain import FLANGE
from visioncal.estimation.observability import (
    Direction,
    chain_words,
    check_determined,
    directions,
    refuse_too_few,
)
from visioncal.estimation.outliers import InlierFit, closed_form, find_inliers
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    estimate_noise,
    fit_problem,
    starting_noise,
)


@dataclass(frozen=True, eq=False)
class Solved:
    """The answer of one solver."""

    problem: Problem
    fit: Solution
    covariance: np.ndarray
    worst: tuple[Direction, ...]

    @property
    def state(self) -> State:
        """The unknowns."""
        return self.fit.state

    @property
    def noise(self) -> Noise:
        """Its levels."""
        return self.fit.noise


def mount_of(problem: Problem) -> str:
    """Where the camera of a chain is."""
    carried = problem.tree.branches["cam"].parent == FLANGE
    return "eye-in-hand" if carried else "eye-to-hand"


def inliers_of(problem: Problem) -> InlierFit:
    """The observations of a chain that agree, found from a closed form of all."""
    return find_inliers(problem, closed_form(problem, np.arange(len(problem))))


def solved(problem: Problem, solver: str = "joint") -> Solved:
    """Solves for both edges of a chain with one target, refusing motion that is too poor."""
    mount = mount_of(problem)
    refuse_too_few(problem, mount)
    start = closed_form(problem, np.arange(len(problem)))
    if solver == "joint":
        fit = fit_problem(problem, start)
    else:
        state = closed_form_state(problem, solver, start, mount)
        noise = starting_noise(problem)
        fit = Solution(state, estimate_noise(problem, state, noise, from_above=True))
    words = chain_words(problem, mount)
    check_determined(problem, fit.state, fit.noise, words)
    covariance = covariance_of(problem, fit)
    worst = directions(problem, fit.state, covariance, words.names)
    return Solved(problem, fit, covariance, tuple(direction for _, direction in worst))
