"""Both edges of a chain, straight from what was measured: without images, outliers or an arm."""

from dataclasses import dataclass

import numpy as np

from visioncal.estimation.chain import FLANGE
from visioncal.estimation.observability import chain_words, check_determined, refuse_too_few
from visioncal.estimation.outliers import InlierFit, closed_form, find_inliers
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import covariance_of, fit_problem


@dataclass(frozen=True, eq=False)
class Solved:
    """The unknowns of a chain, its levels of noise, and the covariance of the unknowns."""

    state: State
    noise: Noise
    covariance: np.ndarray


def inliers_of(problem: Problem) -> InlierFit:
    """The observations of a chain that agree, found from a closed form of all."""
    return find_inliers(problem, closed_form(problem, np.arange(len(problem))))


def solved(problem: Problem) -> Solved:
    """Solves for both edges of a chain with one target, refusing motion that is too poor."""
    carried = problem.tree.branches["cam"].parent == FLANGE
    mount = "eye-in-hand" if carried else "eye-to-hand"
    refuse_too_few(problem, mount)
    fit = fit_problem(problem, closed_form(problem, np.arange(len(problem))))
    check_determined(problem, fit.state, fit.noise, chain_words(problem, mount))
    return Solved(fit.state, fit.noise, covariance_of(problem, fit))
