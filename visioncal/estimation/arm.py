"""Posture-dependent errors of the arm, as random effects.

Real arms repeat to some hundredths of a millimetre and are off by several tenths, depending on the
posture. Small twists of all links with one common variance are random effects beside the edges.
Restricted likelihood determines their size from the residuals, and separates them from white noise.
The part that is the same in all views is absorbed by the edges: its share of the covariance is the
price of an uncalibrated arm.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.mixed import LEAST_SIGMA, PriorInformation
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.robot_likelihood import RobotLikelihood
from visioncal.robot import Robot

# Arms are off by some 0.5 mm for each mrad.
LEVER_M = 0.5
# Units of a twist: a rotation by 1 rad, or a translation by the lever.
TWIST_UNITS: FloatArray = np.repeat([1.0, LEVER_M], 3)
# Sizes of changes: from a tenth of a millimetre to a tenth of a metre, by half decades.
SIZES_M = tuple(float(value) for value in 10.0 ** np.arange(-4.0, -0.9, 0.5))
# A change of a millimetre rotates by 4 mrad.
TURN_PER_M = 4.0
# Limits of twice the gain in log-likelihood that noise exceeds in one session of ten thousand, and
# of twenty.
SIGNIFICANT, _LIKELY = map(float, chi2_limit([FALSE_ALARM, 0.05], 1))
# The shortest range of errors by posture [rad].
POSTURE_RANGE_RAD = 0.15
# Smaller sizes count as zero [rad].
_NOTHING = 1e-6
# Sizes of the errors of links [rad], and their prior: with a probability of a half log-normal about
# 0.2 mrad and 0.1 mm a link within a factor of e, by which an arm of a metre is off by some tenths
# of a millimetre.
_SIZES: FloatArray = np.geomspace(2.5e-5, 1.6e-3, 7)
_SIZE_PRIOR: FloatArray = np.exp(-0.5 * np.log(_SIZES / 2e-4) ** 2)
_SIZE_PRIOR *= 0.5 / _SIZE_PRIOR.sum()


@dataclass(frozen=True, eq=False)
class ArmErrors:
    """Errors of the arm as random effects."""

    basis: FloatArray  # (s, 6, p) Jacobian of the flange at each stop; all errors are in radians.
    # Their standard deviation [rad], shrunk by the Akaike weight against none; lengths are off by
    # 0.5 m times as much.
    sigma: float
    gain: float  # Twice the gain in log-likelihood over white noise alone.
    # Whether they are errors of this arm's links, which can be estimated; else the basis is generic
    # for any arm, and only their size is meaningful.
    of_links: bool
    # (2,) white noise left beside them, of rotation [rad] and position [m]; None where that is the
    # noise of the fit.
    white: FloatArray | None = None
    # (2,) noise of the fit: white noise and errors together as single stops show them, without what
    # is the same at all stops. None of links.
    fit_sigmas: FloatArray | None = None
    # (2,) what the fit knows of this session and a pick does not: errors that grow with time, reach
    # or gravity, or follow motions; zero for none.
    of_session: FloatArray | float = 0.0
    # Number of errors, the last ones, that are correlated in time; the others are correlated over
    # the posture. At another time they have other values.
    time_correlated_count: int = 0

    @property
    def is_time_correlated(self) -> Mask:
        """(p,) mask of the errors that are correlated in time."""
        count = self.basis.shape[2]
        return np.asarray(np.arange(count) >= count - self.time_correlated_count)

    @property
    def is_significant(self) -> bool:
        """Whether they exceed chance; less significant ones may still count in the covariance."""
        return self.gain > SIGNIFICANT

    @property
    def is_likely(self) -> bool:
        """Whether they are likelier than noise alone."""
        return self.gain > _LIKELY

    @property
    def is_estimated(self) -> bool:
        """Whether they are unknowns of the fit; else they only count in the covariance."""
        return self.of_links and self.is_significant

    def effect(self, robot: str, name: str = "arm", values: FloatArray | None = None) -> Effect:
        """Returns the errors as unknowns of a robot's flange, at their (p,) current values."""
        size = self.basis.shape[2]
        start = np.zeros(size) if values is None else values
        information = np.eye(size) / self.sigma**2
        prior = PriorInformation(information, information @ start)
        held = np.zeros(size, dtype=bool)
        return Effect(f"{name} of {robot}", start, prior, held, flange_jacobian={robot: self.basis})


def link_basis(robot: Robot, joints_rad: FloatArray) -> FloatArray:
    """Jacobian (m, 6, 6 n) of the flange by small twists of all links, at (m, n) joint angles.

    Right perturbations of `base_from_flange`, for a link's rotation by 1 rad and its translation by
    0.5 m.
    """
    frames = robot.link_frames(joints_rad)
    twists = adjoint(invert(frames[:, -1:]) @ frames[:, :-1]) * TWIST_UNITS
    return np.concatenate(list(np.moveaxis(twists, 1, 0)), axis=2)


def pose_basis(base_from_flange: FloatArray) -> FloatArray:
    """Jacobian (m, 6, 48) of the flange by generic errors that are functions of its pose.

    Constant twists of base and flange, and twists of the base in proportion to the flange's
    position and to the direction of its axis; in the units of `link_basis`, for (m, 4, 4)
    `base_from_flange`.
    """
    of_base = adjoint(invert(base_from_flange)) * TWIST_UNITS
    of_flange = np.broadcast_to(np.eye(6) * TWIST_UNITS, of_base.shape)
    # Over the typical reach of an arm [m].
    position, axis = base_from_flange[:, :3, 3] / 0.6, base_from_flange[:, :3, 2]
    varying = [
        of_base * factor[:, None, None] for factor in np.concatenate([position, axis], axis=1).T
    ]
    return np.concatenate([of_flange, of_base, *varying], axis=2)


def posture_features(poses: FloatArray) -> FloatArray:
    """(s, 12) features of (s, 4, 4) postures, whose distance is that of the postures [rad]."""
    turns = poses[:, :3, :3].reshape(-1, 9) / np.sqrt(2.0)
    return np.concatenate([poses[:, :3, 3] / LEVER_M, turns], axis=1)


def posture_correlation(poses: FloatArray) -> FloatArray:
    """(s, s) correlation of the errors at (s, 4, 4) postures, of the shortest range considered."""
    features = posture_features(poses)
    squared = np.sum((features[:, None] - features) ** 2, axis=2)
    return np.asarray(np.exp(-squared / (2.0 * POSTURE_RANGE_RAD**2)))


def find_arm_errors(likelihood: RobotLikelihood, robot: int, basis: FloatArray) -> ArmErrors | None:
    """Estimates the size of the errors of one robot's links; None for too few stops.

    Significant errors have the size of maximum likelihood. Every arm has link errors, and stops
    whose postures are alike show none: others have the root mean square of their posterior, by the
    likelihood on a grid of sizes and by what arms are off (half of them by nothing, as simulated
    and calibrated ones).

    Args:
        likelihood: That of the robots' noise levels without these errors, at the solution.
        robot: Index of the robot.
        basis: (s, 6, p) of `link_basis`, by stop.
    """
    # The basis is empty for an arm whose link errors all equal errors of its frames (parallel
    # axes).
    stops, size = likelihood.stops[(likelihood.members == robot).any(axis=1)], basis.shape[2]
    if len(np.unique(stops)) < FEWEST_STOPS or not size:
        return None
    start = likelihood.start_beside([likelihood.moved(robot, basis)], np.array([_NOTHING]))
    beside, seen = (
        likelihood.beside(robot, basis, np.ones((size, 1))),
        np.repeat(likelihood.seen, 2),
    )
    sigmas, value = beside.most_likely(
        start,
        np.append(seen, True),
        np.append(np.full(len(start) - 1, LEAST_SIGMA), _NOTHING),
    )
    gain = 2.0 * (likelihood.white[1] - value)
    if gain > SIGNIFICANT:
        # Each parameter costs one in log-likelihood (Akaike 1974).
        sigma = np.sqrt(expit(0.5 * gain - 1.0)) * sigmas[-1]
    else:
        levels = [np.append(likelihood.white[0], at) for at in _SIZES]
        gains = [
            likelihood.white[1] - beside.most_likely(at, np.append(seen, False))[1] for at in levels
        ]
        shares = _SIZE_PRIOR * np.exp(np.minimum(gains, 0.5 * SIGNIFICANT))
        sigma = np.sqrt(shares @ _SIZES**2 / (1.0 - _SIZE_PRIOR.sum() + shares.sum()))
    return ArmErrors(basis, float(sigma), max(gain, 0.0), of_links=True)


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
