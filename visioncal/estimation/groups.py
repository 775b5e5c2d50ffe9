"""Least squares over small groups of residuals, each of which is an inlier or outlier as a whole.

A group is one touch of a tool or one measured point: a few residuals [m] that share one error. The
covariance of a group is its stated one plus one unknown level of noise per axis: `known + sigma^2
I`, with sigma by restricted maximum likelihood.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_from, damped_step, gram, spectrum
from visioncal.estimation.mixed import (
    LEAST_SIGMA,
    MOST_SIGMA,
    MixedModel,
    Units,
    profile_interval,
)

State = TypeVar("State")

_ROUNDS = 10
_CONVERGED = 1e-10
# Scaled eigenvalue ratio below which a direction is undetermined.
_NULL_RATIO = 1e-10
# Least start of the noise level [m]: it is searched from above.
_START_SIGMA = 5e-4


@dataclass(frozen=True, eq=False)
class Groups:
    """A problem linearised at one state: m groups of up to d residuals, by p unknowns."""

    residuals: FloatArray  # (m, d) [m], zero where not observed.
    jacobian: FloatArray  # (m, d, p) by the unknowns' steps, zero where not observed.
    observed: Mask  # (m, d) mask of the existing residuals: groups may be smaller than d.
    known: FloatArray  # (m, d, d) stated covariance [m^2]; zeros where none is.

    def __len__(self) -> int:
        return len(self.residuals)

    def subset(self, chosen: Mask) -> "Groups":
        """Returns the groups of an (m,) mask."""
        return Groups(
            self.residuals[chosen],
            self.jacobian[chosen],
            self.observed[chosen],
            self.known[chosen],
        )

    def covariance(self, sigma: float) -> FloatArray:
        """Covariances (m, d, d) at a noise level [m]; identity where nothing was observed."""
        return self._units().total(np.log([sigma]))

    def _units(self) -> Units:
        both = self.observed[:, :, None] & self.observed[:, None, :]
        identity = np.eye(self.observed.shape[1])
        absent = identity * ~self.observed[:, None, :]
        return Units(
            self.residuals,
            self.jacobian,
            np.where(both, self.known, 0.0) + absent,
            (identity * self.observed[:, None, :])[None],
            np.zeros(1, dtype=np.int64),
        )

    def level(self, start: float, *, free: bool = True) -> tuple[float, float]:
        """Maximum-likelihood noise [m] and its negative log-likelihood; at the start if held."""
        model = MixedModel((self._units(),), (), np.zeros((self.jacobian.shape[2], 1)))
        logs = np.log([max(start, LEAST_SIGMA)])
        low, high = (np.log([bound]) if free else logs for bound in (LEAST_SIGMA, MOST_SIGMA))
        found = model.maximised(logs, low, high)
        return float(np.exp(found.logs[0])), found.value

    def information(self, sigma: float) -> FloatArray:
        """Fisher information (p, p) of the unknowns at a noise level [m]."""
        weighted = np.linalg.solve(self.covariance(sigma), self.jacobian)
        return gram(self.jacobian, weighted)

    @property
    def freedom(self) -> int:
        """Degrees of freedom: residuals observed less directions determined."""
        values = spectrum(gram(self.jacobian, self.jacobian)).values
        return int(self.observed.sum() - np.sum(values > _NULL_RATIO * values[-1]))


class GroupProblem(Protocol[State]):
    """A problem to fit: the unknowns are a state, and steps of (p,) numbers move it."""

    def guesses(self) -> Iterable[State]:
        """Yields starts: the first from all groups, more from small sets (see `robust.small_sets`).

        Each must lie near the solution if its set has no outliers; others may be anywhere.
        """
        ...

    def linearise(self, state: State) -> Groups:
        """Residuals of all m groups at a state, and their Jacobian."""
        ...

    def move(self, state: State, step: FloatArray) -> State:
        """Takes a (p,) step from a state."""
        ...


@dataclass(frozen=True, eq=False)
class GroupFit(Generic[State]):
    """Fit to some of the groups."""

    state: State  # The maximum-likelihood unknowns.
    # (p, p) of their steps; undetermined directions have a large but finite variance.
    covariance: FloatArray
    # Maximum-likelihood noise of one residual [m], beyond the stated one; the expected one where
    # there are no degrees of freedom.
    sigma: float
    freedom: int  # Degrees of freedom: residuals used less directions determined.
    groups: Groups  # All groups at the solution, used or not.
    used: Mask  # (m,) mask of the groups of the fit.
    settled: bool  # Whether the state converged.

    @property
    def gains(self) -> FloatArray:
        """(m, p, d) gain: derivative of the unknowns by each group's residuals; zero if unused.

        It propagates an error that several groups share, and that their weights do not model.
        """
        weights = np.linalg.inv(self.groups.covariance(self.sigma))
        weighted = np.where(self.used[:, None, None], weights @ self.groups.jacobian, 0.0)
        return np.asarray(-self.covariance @ np.swapaxes(weighted, 1, 2))

    @cached_property
    def sigma_95(self) -> tuple[float, float]:
        """95 % interval of sigma [m] by the profile likelihood; (0, inf) without any freedom."""
        if self.freedom < 1:
            return 0.0, float("inf")
        inside = self.groups.subset(self.used)

        def profile(logarithm: float) -> float:
            return inside.level(float(np.exp(logarithm)), free=False)[1]

        return profile_interval(
            profile, self.sigma, profile(float(np.log(max(self.sigma, LEAST_SIGMA))))
        )


def fit_groups(
    problem: GroupProblem[State],
    used: Mask | None = None,
    start: State | None = None,
    expected_sigma: float = 0.0,
) -> GroupFit[State]:
    """Fits the unknowns and the noise level to some groups.

    Args:
        problem: The problem to fit.
        used: (m,) mask of the groups to use; all where None.
        start: Start; the problem's first guess where None.
        expected_sigma: Noise level where there are no degrees of freedom [m].
    """
    state = next(iter(problem.guesses())) if start is None else start
    groups = problem.linearise(state)
    chosen = np.ones(len(groups), dtype=bool) if used is None else used
    inside, settled = groups.subset(chosen), False
    square = float(np.sum(inside.residuals**2)) / max(int(inside.observed.sum()), 1)
    sigma = max(float(np.sqrt(square)), _START_SIGMA)
    for _ in range(_ROUNDS):
        # Weights are held during the descent: weights that follow the state would favour states
        # with large noise.
        weights = np.asarray(np.linalg.inv(groups.covariance(sigma)), dtype=float)
        state, settled = descended(problem, state, chosen, weights)
        groups = problem.linearise(state)
        inside = groups.subset(chosen)
        before, sigma = sigma, inside.level(max(sigma, LEAST_SIGMA))[0]
        if np.isclose(before, sigma, rtol=1e-4):
            break
    freedom = inside.freedom
    if freedom < 1:
        sigma = max(expected_sigma, LEAST_SIGMA)
    covariance = covariance_from(inside.information(sigma))
    return GroupFit(state, covariance, sigma, freedom, groups, chosen, settled)


def descended(
    problem: GroupProblem[State], start: State, chosen: Mask, weights: FloatArray
) -> tuple[State, bool]:
    """Minimises the residuals of some groups at (m, d, d) weights."""
    weights = np.where(chosen[:, None, None], weights, 0.0)

    def linearise(at: State) -> Linearised[State]:
        groups = problem.linearise(at)
        weighted = weights @ groups.jacobian
        information = gram(groups.jacobian, weighted)
        gradient = gram(weighted, groups.residuals)
        cost = np.einsum("mi,mij,mj->", groups.residuals, weights, groups.residuals)
        return Linearised(
            at,
            float(cost),
            lambda damping: problem.move(at, damped_step(information, gradient, damping)),
        )

    return levenberg_marquardt(start, linearise, _CONVERGED)
