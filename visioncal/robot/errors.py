"""Errors of an arm by its pose: small twists of its links, generic ones of its flange's pose.

Real arms repeat to some hundredths of a millimetre and are off by several tenths, depending on the
posture.
"""

from dataclasses import dataclass

import numpy as np

from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.transforms import LEVER_M, adjoint, invert
from visioncal.core.types import FloatArray, Mask
from visioncal.robot.model import Robot

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
