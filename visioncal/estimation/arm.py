"""Errors of the arm that follow its posture: what white noise from stop to stop is not.

Real arms repeat to some hundredths of a millimetre and are off by several tenths, and by how much
depends on the posture. Small twists of all links, drawn from one distribution, are random effects
beside the edges; restricted likelihood tells their size from the residuals, and tells them from
white noise. What of them looks the same in all views hides in the edges: its share of the
covariance is the price of an uncalibrated arm.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from visioncal.estimation.closure import (
    Closure,
    Edges,
    Noise,
    flange_to_residual,
    noise_likelihood,
    normal_equations,
    residual_blocks,
)
from visioncal.estimation.linalg import covariance, gram
from visioncal.estimation.shared import Shared
from visioncal.robot import Robot
from visioncal.transforms import adjoint, invert
from visioncal.types import FloatArray

# Arms are off by some 0.5 mm for each mrad.
LEVER_M = 0.5
# One unit of a twist turns by a radian, or shifts by as much as that is at the lever.
TWIST_UNITS: FloatArray = np.repeat([1.0, LEVER_M], 3)
# Twice the gain in log-likelihood that noise gives in one session of ten thousand, and in one of
# twenty: chi-square of one degree of freedom.
SIGNIFICANT, _LIKELY = 15.1, 3.84
# Typical errors of links that are tried first [rad], and how finely the best is sought.
_TRIED, _FINEST = (3e-5, 1e-4, 3e-4, 1e-3, 3e-3), 1.05
# Fewer stops have hardly more residuals than the edges and the noise take.
_FEWEST_STOPS = 6
# Positions and directions change over about so much when an arm's posture does [m].
_REACH_M = 0.6


@dataclass(frozen=True, eq=False)
class ArmErrors:
    """Errors of the arm as random effects.

    Attributes:
        basis: (m, 6, p) how each view's flange moves with them, all of them in radians.
        sigma: Their standard deviation [rad]; lengths are off by 0.5 m times as much.
        gain: Twice the gain in log-likelihood over white noise alone.
        of_links: Whether they are errors of this arm's links, which can be estimated along; else
            they have the shape of any arm's, and only their size is worth something.
    """

    basis: FloatArray
    sigma: float
    gain: float
    of_links: bool

    @property
    def is_significant(self) -> bool:
        """Whether they are beyond chance; others are likely enough to be counted with."""
        return self.gain > SIGNIFICANT

    @property
    def is_estimated(self) -> bool:
        """Whether they are unknowns of the fit; others only count in the covariance."""
        return self.of_links and self.is_significant

    def shared(self, values: FloatArray | None = None) -> Shared:
        """Puts the effects as unknowns of the chain, at their (p,) present values."""
        size = self.basis.shape[2]
        nothing = np.zeros(size)
        at = nothing if values is None else values
        known = np.eye(size) / self.sigma**2
        return Shared(known, known @ at, nothing, np.zeros_like(self.basis), self.basis)


def link_basis(robot: Robot, joints_rad: FloatArray) -> FloatArray:
    """How the flange moves with small twists of all links.

    Args:
        robot: The nominal model.
        joints_rad: (m, n) joint angles.

    Returns:
        (m, 6, 6 n) right perturbations of `base_from_flange`, for a link's rotation by 1 rad and
        its translation by 0.5 m.
    """
    links = np.array([robot.link_frames(row)[:-1] for row in joints_rad])
    flange_from_base = invert(robot.base_from_flange(joints_rad))
    twists = adjoint(flange_from_base[:, None] @ links) * TWIST_UNITS
    return np.concatenate(list(np.moveaxis(twists, 1, 0)), axis=2)


def pose_basis(base_from_flange: FloatArray) -> FloatArray:
    """How arms err as a function of where the flange is, without their joints.

    Twists of base and flange that stay, and twists of the base that change in proportion to the
    flange's position and to the direction of its axis.

    Args:
        base_from_flange: (m, 4, 4).

    Returns:
        (m, 6, 48) in the units of `link_basis`.
    """
    of_base = adjoint(invert(base_from_flange)) * TWIST_UNITS
    of_flange = np.broadcast_to(np.eye(6) * TWIST_UNITS, of_base.shape)
    position, axis = base_from_flange[:, :3, 3] / _REACH_M, base_from_flange[:, :3, 2]
    changing = [
        of_base * factor[:, None, None] for factor in np.concatenate([position, axis], axis=1).T
    ]
    return np.concatenate([of_flange, of_base, *changing], axis=2)


def find_arm_errors(
    data: Closure, edges: Edges, basis: FloatArray, *, of_links: bool
) -> ArmErrors | None:
    """Estimates the size of the arm's errors, where they are significant.

    Args:
        data: The views, one a stop.
        edges: The answer under white noise.
        basis: (m, 6, p) of `link_basis` or `pose_basis`.
        of_links: Whether it is of this arm's links.

    Returns:
        The errors; None where white noise explains the residuals about as well.
    """
    if len(data) < _FEWEST_STOPS:
        return None
    white = noise_likelihood(data, edges)[1]

    def gain(sigma: float) -> float:
        errors = ArmErrors(basis, sigma, 0.0, of_links).shared()
        widened = data.with_more(errors)
        still = Edges(edges.x, edges.z, np.concatenate([edges.shared, np.zeros(basis.shape[2])]))
        # The effects' own density, which the likelihood of given knowledge leaves out.
        value = noise_likelihood(widened, still)[1]
        return float(2.0 * (white - value - basis.shape[2] * math.log(sigma)))

    found = {sigma: gain(sigma) for sigma in _TRIED}
    best = max(found, key=lambda it: found[it])
    if found[best] < _LIKELY:
        return None
    best, highest = _climb(gain, best, found[best])
    return ArmErrors(basis, best, highest, of_links)


def _climb(gain: Callable[[float], float], at: float, value: float) -> tuple[float, float]:
    """Follows a gain with one maximum by factors that shrink, from near it."""
    factor = math.sqrt(_TRIED[1] / _TRIED[0])
    while factor > _FINEST:
        for candidate in (at * factor, at / factor):
            there = gain(candidate)
            if there > value:
                at, value = candidate, there
                break
        factor = math.sqrt(factor)
    return at, value


def misfit_covariance(data: Closure, edges: Edges, noise: Noise, errors: ArmErrors) -> FloatArray:
    """What errors of the arm add to the covariance of a fit that takes them for white noise.

    Args:
        data: The views, one a stop.
        edges: The answer.
        noise: The white noise that it was weighted with.
        errors: The arm's errors, at the same views.

    Returns:
        (12 + k, 12 + k).
    """
    answer = errors.sigma * misfit_slopes(data, edges, noise, errors)
    return np.asarray(answer @ answer.T)


def misfit_slopes(data: Closure, edges: Edges, noise: Noise, errors: ArmErrors) -> FloatArray:
    """How a fit that takes errors of the arm for white noise moves with them.

    Args:
        data: The views, one a stop.
        edges: The answer.
        noise: The white noise that it was weighted with.
        errors: The arm's errors, at the same views.

    Returns:
        (12 + k, p) by how much the fit is off from the truth, for each error of one.
    """
    _, jacobian, spread = residual_blocks(data, edges, noise)
    seen = data.under(edges.shared)
    moved = flange_to_residual(seen, edges) @ errors.basis
    weighted = np.linalg.solve(spread, moved)
    fitted = covariance(normal_equations(data, edges, noise)[0])
    return np.asarray(fitted @ gram(jacobian, weighted))
