"""Posture-dependent errors of the arm, as random effects.

Real arms repeat to some hundredths of a millimetre and are off by several tenths, depending on the
posture. Small twists of all links with one common variance are random effects beside the edges.
Restricted likelihood determines their size from the residuals, and separates them from white noise.
The part that is the same in all views is absorbed by the edges: its share of the covariance is the
price of an uncalibrated arm.
"""

import numpy as np
from scipy.special import expit

from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.linalg import LEAST_SIGMA
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.robot_likelihood import RobotLikelihood
from visioncal.robot.errors import SIGNIFICANT, ArmErrors

# Smaller sizes count as zero [rad].
_NOTHING = 1e-6
# Sizes of the errors of links [rad], and their prior: with a probability of a half log-normal about
# 0.2 mrad and 0.1 mm a link within a factor of e, by which an arm of a metre is off by some tenths
# of a millimetre.
_SIZES: FloatArray = np.geomspace(2.5e-5, 1.6e-3, 7)
_SIZE_PRIOR: FloatArray = np.exp(-0.5 * np.log(_SIZES / 2e-4) ** 2)
_SIZE_PRIOR *= 0.5 / _SIZE_PRIOR.sum()


def find_arm_errors(likelihood: RobotLikelihood, robot: int, basis: FloatArray) -> ArmErrors | None:
    """Estimates the size of the errors of one robot's links; None for too few stops.

    Significant errors have the size of maximum likelihood. Every arm has link errors, and stops
    whose postures are alike show none: others have the root mean square of their posterior, by the
    likelihood on a grid of sizes and by what arms are off (half of them by nothing, as simulated
    and calibrated ones).

    Args:
        likelihood: Of the robots' noise levels without these errors, at the solution.
        robot: Index of the robot.
        basis: (s, 6, p) of `link_basis`, by stop.
    """
    # The basis is empty for an arm whose link errors all equal errors of its frames (parallel
    # axes).
    stops, size = likelihood.stops[(likelihood.members == robot).any(axis=1)], basis.shape[2]
    if len(np.unique(stops)) < FEWEST_STOPS or not size:
        return None
    start = likelihood.start_beside([likelihood.moved(robot, basis)], np.array([_NOTHING]))
    extended, seen = (
        likelihood.with_moves(robot, basis, np.ones((size, 1))),
        np.repeat(likelihood.seen, 2),
    )
    sigmas, value = extended.most_likely(
        start, np.append(seen, True), np.append(np.full(len(start) - 1, LEAST_SIGMA), _NOTHING)
    )
    gain = 2.0 * (likelihood.white[1] - value)
    # Beyond the reach of their linear columns, the gain is that of a matrix without a determinant.
    # Larger sizes are none of links [rad].
    if gain > SIGNIFICANT and sigmas[-1] < 1.0:
        # Each parameter costs one in log-likelihood (Akaike 1974).
        sigma = np.sqrt(expit(0.5 * gain - 1.0)) * sigmas[-1]
    else:
        levels, gains = likelihood.white[0].ravel(), list[float]()
        for size_rad in _SIZES:
            # Beside larger errors of links there is less noise.
            found, value = extended.most_likely(np.append(levels, size_rad), np.append(seen, False))
            levels = found[:-1]
            gains.append(likelihood.white[1] - value)
        shares = _SIZE_PRIOR * np.exp(np.minimum(gains, 0.5 * SIGNIFICANT))
        sigma = np.sqrt(shares @ _SIZES**2 / (1.0 - _SIZE_PRIOR.sum() + shares.sum()))
        gain = min(gain, SIGNIFICANT)
    return ArmErrors(basis, float(sigma), max(gain, 0.0), of_links=True)


def arm_effect(
    errors: ArmErrors, robot: str, name: str = "arm", values: FloatArray | None = None
) -> Effect:
    """Errors of an arm as unknowns of a robot's flange, at their (p,) current values."""
    size = errors.basis.shape[2]
    start = np.zeros(size) if values is None else values
    information = np.eye(size) / errors.sigma**2
    prior = PriorInformation(information, information @ start)
    held = np.zeros(size, dtype=bool)
    return Effect(f"{name} of {robot}", start, prior, held, flange_jacobian={robot: errors.basis})


def rows_of(problem: Problem, robot: str) -> Mask:
    """(n,) mask of the observations whose unit contains the error of a robot's flange."""
    (unit_of, members), index = problem.units, problem.robots.index(robot)
    mask = unit_of >= 0
    mask[mask] = (members[unit_of[mask]] == index).any(axis=1)
    return mask


def stops_of(problem: Problem, robot: str) -> IntArray:
    """The stops at which a robot was observed, ascending."""
    return np.unique(problem.observations.stops[rows_of(problem, robot)])


def covariance_of_size(arm: slice, covariance: FloatArray, errors: ArmErrors) -> FloatArray:
    """Covariance (p, p) added because the size of an arm's errors was itself estimated.

    Undetermined errors are drawn from a distribution whose variance was estimated from the k
    determined ones. They follow Student's t, whose variance is k / (k - 2) times that. To first
    order in the variance of the errors, for all unknowns with a (p, p) covariance, of which `arm`
    are the errors.
    """
    variance, with_arm = errors.sigma**2, covariance[arm]
    determined = len(with_arm) - float(np.trace(with_arm[:, arm])) / variance
    # The variance is unbounded for two or fewer.
    return np.asarray(2.0 / (max(determined - 2.0, 1.0) * variance) * with_arm.T @ with_arm)
