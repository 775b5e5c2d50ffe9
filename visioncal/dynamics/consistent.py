"""Physically consistent standard parameters from identified base parameters.

A motion determines base parameters only; the rest follows a prior at the robot's own inertias. The
fit is over log-Cholesky coordinates, in which every link is physically consistent, with a weak
prior (Wensing, Kim and Slotine 2018; Lee, Wensing and Park 2019; Rucker and Wensing 2022).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from visioncal.core.types import FloatArray, Mask
from visioncal.dynamics.base import BaseModel
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_from, damped_step
from visioncal.robot import Inertias, LogCholesky

# Standard deviation of the prior in each log-Cholesky coordinate: 30 % of a link's extent, twice
# that of its mass.
PRIOR_SIGMA = 0.3
_SETTLED = 1e-9
# Prefixes of the joint parameters that cannot be negative.
_POSITIVE = ("Fc", "Fv", "Ia")


@dataclass(frozen=True, eq=False)
class Consistent:
    """Physically consistent standard parameters."""

    values: FloatArray  # (p,) in the order of `DynamicModel.names`.
    covariance: FloatArray  # (p, p) posterior covariance, given torques and prior.
    misfit: float  # Chi-square by which the torques fit worse than with the best base parameters.

    def inertias(self, joints: int) -> Inertias:
        """Inertial parameters of the links."""
        return Inertias(self.values[: 10 * joints].reshape(joints, 10))


def fit_consistent(
    base: BaseModel, values: FloatArray, covariance: FloatArray, known: Inertias
) -> Consistent:
    """Fits consistent standard parameters, near known inertias, to measured base parameters.

    Args:
        base: The model.
        values: (b,) measured base parameters.
        covariance: (b, b) their covariance.
        known: Prior inertias of the links.

    Raises:
        DataError: The prior inertias are physically inconsistent.
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
        negative = positive & (state.own < 0.0) & ~problem.held
        if not negative.any():
            break
        # Negative ones are held at zero: they are noise, or the model does not fit.
        problem = replace(problem, held=problem.held | negative)
    information, _, _ = problem.normal(state)
    jacobian = problem.jacobian(state)
    posterior = jacobian @ covariance_from(information) @ jacobian.T
    residual = problem.whitened.apply(values - base.of(problem.standard(state)))
    return Consistent(problem.standard(state), posterior, float(residual @ residual))


@dataclass(frozen=True, eq=False)
class _Whitened:
    """Whitening transform of a covariance."""

    root: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, covariance: FloatArray) -> "_Whitened":
        scale = np.sqrt(np.diag(covariance))
        return cls(cholesky(covariance / np.outer(scale, scale), lower=True), scale)

    def apply(self, residual: FloatArray) -> FloatArray:
        scaled = residual / self.scale.reshape(-1, *[1] * (residual.ndim - 1))
        return np.asarray(solve_triangular(self.root, scaled, lower=True))


@dataclass(frozen=True, eq=False)
class _LinkState:
    """Log-Cholesky coordinates (n, 10) of the links, and the joints' own parameters."""

    links: FloatArray
    own: FloatArray


@dataclass(frozen=True, eq=False)
class _ConsistentFit:
    """The least-squares problem; link coordinates in units of their prior sigma."""

    base: BaseModel
    values: FloatArray
    whitened: _Whitened
    coordinates: LogCholesky
    held: Mask

    def start(self) -> _LinkState:
        """The prior links, with the joints' own parameters fitted to the rest."""
        joints = len(self.coordinates.maps)
        links = np.zeros((joints, 10))
        known = self.coordinates.values(links).ravel()
        own = self.whitened.apply(self.base.dependence[:, len(known) :] * ~self.held)
        rest = self.values - self.base.dependence[:, : len(known)] @ known
        fitted = np.linalg.lstsq(own, self.whitened.apply(rest), rcond=None)[0]
        return _LinkState(links, np.where(self.held, 0.0, fitted))

    def standard(self, state: _LinkState) -> FloatArray:
        return np.concatenate([self.coordinates.values(state.links).ravel(), state.own])

    def jacobian(self, state: _LinkState) -> FloatArray:
        """(p, p) Jacobian of the standard parameters."""
        count, own = state.links.size, state.own.size
        jacobian = np.zeros((count + own, count + own))
        for joint, block in enumerate(self.coordinates.jacobians(state.links)):
            rows = slice(10 * joint, 10 * joint + 10)
            jacobian[rows, rows] = PRIOR_SIGMA * block
        jacobian[range(count, count + own), range(count, count + own)] = ~self.held
        return jacobian

    def normal(self, state: _LinkState) -> tuple[FloatArray, FloatArray, float]:
        """Information, gradient and cost."""
        prior = np.zeros(state.links.size + state.own.size)
        prior[: state.links.size] = state.links.ravel() / PRIOR_SIGMA
        residual = self.whitened.apply(self.base.of(self.standard(state)) - self.values)
        jacobian = self.whitened.apply(self.base.dependence @ self.jacobian(state))
        prior_information = np.zeros(prior.size)
        prior_information[: state.links.size] = 1.0
        prior_information[state.links.size :][self.held] = 1.0
        information = jacobian.T @ jacobian + np.diag(prior_information)
        gradient = jacobian.T @ residual + prior
        return information, gradient, float(residual @ residual + prior @ prior)

    def linearised(self, state: _LinkState) -> Linearised[_LinkState]:
        information, gradient, cost = self.normal(state)

        def step(damping: float) -> _LinkState:
            update = damped_step(information, gradient, damping)
            links = PRIOR_SIGMA * update[: state.links.size].reshape(state.links.shape)
            own = update[state.links.size :]
            return _LinkState(state.links + links, state.own + np.where(self.held, 0.0, own))

        return Linearised(state, cost, step)
