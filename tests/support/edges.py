"""Both edges of a chain, straight from what was measured: without images, outliers or an arm."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import robot_part
from visioncal.estimation.chain import FLANGE
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.observability import chain_words, check_determined, refuse_too_few
from visioncal.estimation.outliers import InlierFit, find_inliers
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT, Noise, State
from visioncal.estimation.solve import covariance_of, fit_problem
from visioncal.fit.consensus import Candidates, partial_hand_eye


@dataclass(frozen=True, eq=False)
class Solved:
    """The unknowns of a chain, its levels of noise, and the covariance of the unknowns."""

    state: State
    noise: Noise
    covariance: np.ndarray


def mount_of(problem: Problem) -> str:
    """The mount of a chain's camera."""
    carried = problem.tree.branches["cam"].parent == FLANGE
    return "eye-in-hand" if carried else "eye-to-hand"


def sides_of(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """(m, 4, 4) parts of a chain by its robot and by its camera."""
    seen = problem.observations
    return robot_part(problem.poses[ROBOT][seen.stops], mount_of(problem)), seen.measured


def inliers_of(problem: Problem) -> InlierFit:
    """The observations of a chain that agree, found from a consensus."""
    robot, seen = sides_of(problem)
    turns, valid = np.zeros((len(seen), 1), dtype=int), np.ones((len(seen), 1), dtype=bool)
    edges, _ = partial_hand_eye(robot, Candidates(seen[:, None], turns, valid))
    return find_inliers(problem, State(np.array([edges.x, edges.z]), problem.start_values))


def solved(problem: Problem) -> Solved:
    """Solves for both edges of a chain with one target, refusing motion that is too poor."""
    mount = mount_of(problem)
    refuse_too_few(problem, mount)
    edges = SOLVERS["park"](*sides_of(problem))
    fit = fit_problem(problem, State(np.array([edges.x, edges.z]), problem.start_values))
    check_determined(problem, fit.state, fit.noise, chain_words(problem, mount))
    return Solved(fit.state, fit.noise, covariance_of(problem, fit))
