"""Standard parameters that are those of bodies, near known ones, and explain the measured torques.

A motion determines base parameters only. What is free or badly determined follows what is
known of the links before: the fit goes over log-Cholesky coordinates, in which every link is a body
whatever the torques say, with a weak prior at the known one (Wensing, Kim and Slotine 2018; Lee,
Wensing and Park 2019; Rucker and Wensing 2022).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from visioncal.core.types import FloatArray, Mask
from visioncal.dynamics.base import BaseModel
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_from, damped_step
from visioncal.robot import Inertias, LogCholesky

# Links differ from what is known of them by about so much in each coordinate: a third of their
# extent, and twice that of their mass.
PRIOR_SIGMA = 0.3
_SETTLED = 1e-9
# Parameters of joints that cannot be below zero.
_POSITIVE = ("Fc", "Fv", "Ia")


@dataclass(frozen=True, eq=False)
class Consistent:
    """Standard parameters of bodies.

    Attributes:
        values: (p,) as `DynamicModel.names` has them.
        covariance: (p, p) of these: what the torques and the prior leave together.
        misfit: By how much the torques' squared residuals, in units of their noise, are larger than
            with the base parameters that fit best.
    """

    values: FloatArray
    covariance: FloatArray
    misfit: float

    def inertias(self, joints: int) -> Inertias:
        """Of the links."""
        return Inertias(self.values[: 10 * joints].reshape(joints, 10))


def fit_consistent(
    base: BaseModel, values: FloatArray, covariance: FloatArray, known: Inertias
) -> Consistent:
    """Finds the bodies, near known ones, whose base parameters are nearest to measured ones.

    Args:
        base: The model.
        values: (b,) measured base parameters.
        covariance: (b, b) their covariance.
        known: The links as they are known before.

    Raises:
        DataError: What is known is that of no body.
    """
    joints = len(known.values)
    names = base.model.names[10 * joints :]
    held = np.zeros(len(names), dtype=bool)
    positive = np.array([name.startswith(_POSITIVE) for name in names], dtype=bool)
    problem = _ConsistentFit(
        base, values, _Whitened.of(covariance), LogCholesky.around(known), held
    )
    for _ in range(len(names) + 1):
        state, _ = levenberg_marquardt(problem.start(), problem.linearised, _SETTLED)
        wrong = positive & (state.own < 0.0) & ~problem.held
        if not wrong.any():
            break
        # A negative one is held at zero: it is noise, or the torques are of another model.
        problem = replace(problem, held=problem.held | wrong)
    information, _, _ = problem.normal(state)
    jacobian = problem.jacobian(state)
    posterior = jacobian @ covariance_from(information) @ jacobian.T
    away = problem.whitened.of_vector(values - base.of(problem.standard(state)))
    return Consistent(problem.standard(state), posterior, float(away @ away))


@dataclass(frozen=True, eq=False)
class _Whitened:
    """Turns deviations of a covariance into ones of unit covariance."""

    root: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, covariance: FloatArray) -> "_Whitened":
        scale = np.sqrt(np.diag(covariance))
        return cls(cholesky(covariance / np.outer(scale, scale), lower=True), scale)

    def of_vector(self, away: FloatArray) -> FloatArray:
        scaled = away / self.scale.reshape(-1, *[1] * (away.ndim - 1))
        return np.asarray(solve_triangular(self.root, scaled, lower=True))


@dataclass(frozen=True, eq=False)
class _LinkState:
    """Coordinates (n, 10) of the links, and the parameters that joints have of their own."""

    links: FloatArray
    own: FloatArray


@dataclass(frozen=True, eq=False)
class _ConsistentFit:
    """The fit, with its unknowns in units of the prior where they have one."""

    base: BaseModel
    values: FloatArray
    whitened: _Whitened
    coordinates: LogCholesky
    held: Mask

    def start(self) -> _LinkState:
        """The known links, with the joints' own parameters that go best with them."""
        joints = len(self.coordinates.maps)
        links = np.zeros((joints, 10))
        known = self.coordinates.values(links).ravel()
        own = self.whitened.of_vector(self.base.dependence[:, len(known) :] * ~self.held)
        rest = self.values - self.base.dependence[:, : len(known)] @ known
        found = np.linalg.lstsq(own, self.whitened.of_vector(rest), rcond=None)[0]
        return _LinkState(links, np.where(self.held, 0.0, found))

    def standard(self, state: _LinkState) -> FloatArray:
        return np.concatenate([self.coordinates.values(state.links).ravel(), state.own])

    def jacobian(self, state: _LinkState) -> FloatArray:
        """(p, p) derivatives of the standard parameters by the unknowns."""
        count, own = state.links.size, state.own.size
        jacobian = np.zeros((count + own, count + own))
        for joint, block in enumerate(self.coordinates.jacobians(state.links)):
            rows = slice(10 * joint, 10 * joint + 10)
            jacobian[rows, rows] = PRIOR_SIGMA * block
        jacobian[range(count, count + own), range(count, count + own)] = ~self.held
        return jacobian

    def normal(self, state: _LinkState) -> tuple[FloatArray, FloatArray, float]:
        """Information, gradient and cost by the unknowns."""
        prior = np.zeros(state.links.size + state.own.size)
        prior[: state.links.size] = state.links.ravel() / PRIOR_SIGMA
        residual = self.whitened.of_vector(self.base.of(self.standard(state)) - self.values)
        jacobian = self.whitened.of_vector(self.base.dependence @ self.jacobian(state))
        known = np.zeros(prior.size)
        known[: state.links.size] = 1.0
        known[state.links.size :][self.held] = 1.0
        information = jacobian.T @ jacobian + np.diag(known)
        gradient = jacobian.T @ residual + prior
        return information, gradient, float(residual @ residual + prior @ prior)

    def linearised(self, state: _LinkState) -> Linearised[_LinkState]:
        information, gradient, cost = self.normal(state)

        def step(damping: float) -> _LinkState:
            by = damped_step(information, gradient, damping)
            links = PRIOR_SIGMA * by[: state.links.size].reshape(state.links.shape)
            own = by[state.links.size :]
            return _LinkState(state.links + links, state.own + np.where(self.held, 0.0, own))

        return Linearised(state, cost, step)
