"""Limits of all verdicts; pairs are the limits of `check` and `bad`."""

import math
from dataclasses import dataclass
from typing import TypeAlias

# A result is `check` beyond the first and `bad` beyond the second.
Pair: TypeAlias = tuple[float, float]

# Predicted sigma of a position by a camera [mm]: pick cells tolerate 1 mm.
_PLACE_MM = (1.0, 3.0)
# Predicted sigma of a touched position [mm]: careful touches repeat to 0.1 mm or better.
_TOUCHED_MM = (0.5, 2.0)
# Noise of a touch per axis [mm], for the same reason.
_TOUCH_NOISE_MM = (0.5, 3.0)
# Predicted sigma of the rotation of small objects: a tool, or one board [deg].
_SMALL_TURN_DEG = (0.3, 1.0)


@dataclass(frozen=True)
class NeedLimits:
    """Limits on a task's need."""

    # Probability of picks within the need: `good` from the first on, `bad` below the second.
    probability: Pair = (0.95, 0.5)
    chance: float = 0.01  # Share of sessions of sound cells with left-out errors beyond the need.


@dataclass(frozen=True)
class CalibrationLimits:
    """Limits on a calibration without a need: one camera and robot, or a whole cell."""

    scatter_mm: Pair = (2.0, 10.0)  # Left-out scatter of the target's position [mm].
    scatter_deg: Pair = (0.3, 2.0)  # Left-out scatter of its orientation [deg].
    sigma_mm: Pair = _PLACE_MM  # Predicted sigma of the worst direction of an edge [mm].
    # The same in rotation [deg]: 0.1 deg moves a point 0.5 m away by 1 mm.
    sigma_deg: Pair = (0.1, 0.3)
    # Noise of a corner's coordinate [px]; sharp images give 0.05 to 0.3.
    pixel_px: Pair = (0.7, 3.0)
    # Error of the flange over what an arm of its kind has (larger ones are seldom independent
    # between stops, as the covariance assumes), and how many times as much a task needs at least,
    # for which it is no doubt.
    repeatability: float = 2.0
    good_enough: float = 10.0
    # Errors by posture that an industrial arm has at most [mm], [deg]: beyond, another thing that
    # follows the posture is likelier, as a lens, marks of few pixels, or poses that are misread.
    arm_errors: Pair = (3.0, 0.3)
    # Left-out scatter over that by the sensor's noise, as of a small board far away.
    of_noise: float = 1.5
    # Stops of the robot in the fit; fewer do not suffice to check the result.
    stops: tuple[int, int] = (10, 5)
    lost_share: Pair = (0.25, 0.6)  # Share of views that could not be used.
    outlier: float = 6.0  # Residual of a view over the median of all views.
    holdout: float = 4.0  # Residuals of held-out views over those of views left out in turn.


@dataclass(frozen=True)
class ToolLimits:
    """Limits on a tool by touches."""

    sigma_mm: Pair = _TOUCHED_MM  # Predicted sigma of the tip's worst direction [mm].
    sigma_deg: Pair = _SMALL_TURN_DEG  # The same of the rotation [deg].
    noise_mm: Pair = _TOUCH_NOISE_MM  # Noise of a touch per axis [mm].
    touches: int = 5  # Touches in the fit; fewer do not suffice to check it.


@dataclass(frozen=True)
class FixtureLimits:
    """Limits on a fixture by touches or markers."""

    # Predicted sigma of the fixture's worst offset, at the centre of its points [mm].
    sigma_mm: Pair = _TOUCHED_MM
    # The same of its rotation [deg]: 0.1 deg are half a millimetre over 300.
    sigma_deg: Pair = (0.1, 0.4)
    noise_mm: Pair = _TOUCH_NOISE_MM  # Noise of a touch per axis [mm].
    points: int = 4  # Points of a drawing in the fit; with fewer a wrong one cannot be detected.


@dataclass(frozen=True)
class ImageFrameLimits:
    """Limits on a tool or a fixture by a target in images."""

    sigma_mm: Pair = _PLACE_MM  # Predicted sigma of the offset's worst direction [mm].
    sigma_deg: Pair = _SMALL_TURN_DEG  # The same of the rotation [deg].


@dataclass(frozen=True)
class CheckLimits:
    """Limits on a check of a calibration by a few stops."""

    # Likelihood ratio of a change to none at which it is reported. Its mean is one without a
    # change, so that by Markov's inequality chance exceeds the limit in at most one of as many
    # checks.
    likelihood_ratio: float = 100.0
    # Likelihood ratio of the best cause to another at which that is ruled out.
    ruled_out: float = 20.0
    unexplained: float = 1e-3  # Significance level of residuals that no cause explains.
    stops: int = 5  # Number of stops; fewer hardly separate causes.


@dataclass(frozen=True)
class RecoveryLimits:
    """Numbers of stops of a recovery."""

    # One stop in so many is held back for the proof, in turn: three of the fewest, as camera and
    # board together explain any two.
    held_back_each: int = 3
    fewest: int = 9  # The others then are no fewer than a check needs.
    stops: int = 15  # As asked for.


@dataclass(frozen=True)
class DynamicsLimits:
    """Limits on identified dynamics."""

    # Prediction error of consistent parameters over that of base parameters.
    bodies_worse: float = 1.3
    # Share of a torque's range below which an error is no reason for doubt.
    slight_share: float = 0.02
    # Prediction error over the torque's range: a reason for doubt, and more error than prediction.
    range_share: Pair = (0.2, 0.5)
    # The same, from which on differences between streams are searched for.
    differs_share: float = 0.1
    own_torques: float = 0.2  # Change of an arm's own torques under load, as wrong units make it.
    # Change of torques by their lag over the range, below which it is only a note.
    lag_share: float = 0.1


# No arm reaches this far [m], and no joint turns this far [rad]: the numbers are in other units.
FAR_M, WIDE_RAD = 20.0, 4 * math.pi
# Tolerance of rotations: with three written digits a quaternion is within 9e-4 of unit length, and
# a matrix within 8e-4 of a rotation; larger errors mean a wrong form or order.
NORM_TOLERANCE = 1e-3
# Fewest views, or stops, that determine a frame: turns about two axes take three of them.
FEWEST_VIEWS = 3
# Fewest stops, or rows, in which a majority identifies outliers.
FEWEST_COMPARED = 5
# Fewest stops whose residuals separate an error from noise: fewer leave hardly more of them than
# edges and noise have parameters.
FEWEST_STOPS = 6
# Ratio of residuals from which on the smaller is clearly better.
CLEAR_RATIO = 3.0
# A parameter is determined where its sigma is at most this share of its prior's.
DETERMINED = 0.7
# Sigmas from which on a stated value counts as contradicted.
CONTRADICTION = 3.0
# Greatest blur of an image in which a board is detected, as a Gaussian's sigma [px].
MAX_BLUR_PX = 4.0
