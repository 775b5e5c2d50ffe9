"""Limits of all verdicts; pairs are the limits of `check` and `bad`."""

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
    """Limits on a task's need.

    Attributes:
        probability: Probability of picks within the need: `good` from the first on, `bad` below the
            second.
        chance: Share of sessions of sound cells with left-out errors beyond the need.
    """

    probability: Pair = (0.95, 0.5)
    chance: float = 0.01


@dataclass(frozen=True)
class CalibrationLimits:
    """Limits on a calibration without a need: one camera and robot, or a whole cell.

    Attributes:
        scatter_mm: Left-out scatter of the target's position [mm].
        scatter_deg: Left-out scatter of its orientation [deg].
        sigma_mm: Predicted sigma of the worst direction of an edge [mm].
        sigma_deg: The same in rotation [deg]: 0.1 deg moves a point 0.5 m away by 1 mm.
        pixel_px: Noise of a corner's coordinate [px]; sharp images give 0.05 to 0.3.
        level: Scatter of a camera's poses over that expected from its corners.
        robot_mm: Error of the flange from stop to stop [mm]; arms repeat to 0.1 mm or better, and
            larger errors are seldom independent between stops, as the covariance assumes.
        robot_deg: The same in rotation [deg].
        stops: Stops of the robot in the fit; fewer do not suffice to check the result.
        lost_share: Share of views that could not be used.
        optimism: Left-out over in-sample scatter; large where each view has high leverage.
        outlier: Residual of a view over the median of all views.
        holdout: Residuals of held-out views over those of views left out in turn.
    """

    scatter_mm: Pair = (2.0, 10.0)
    scatter_deg: Pair = (0.3, 2.0)
    sigma_mm: Pair = _PLACE_MM
    sigma_deg: Pair = (0.1, 0.3)
    pixel_px: Pair = (0.7, 3.0)
    level: float = 2.0
    robot_mm: float = 0.2
    robot_deg: float = 0.02
    stops: tuple[int, int] = (10, 5)
    lost_share: Pair = (0.25, 0.6)
    optimism: Pair = (1.6, 4.0)
    outlier: float = 6.0
    holdout: float = 4.0


@dataclass(frozen=True)
class ToolLimits:
    """Limits on a tool by touches.

    Attributes:
        sigma_mm: Predicted sigma of the tip's worst direction [mm].
        sigma_deg: The same of the rotation [deg].
        noise_mm: Noise of a touch per axis [mm].
        touches: Touches in the fit; fewer do not suffice to check it.
    """

    sigma_mm: Pair = _TOUCHED_MM
    sigma_deg: Pair = _SMALL_TURN_DEG
    noise_mm: Pair = _TOUCH_NOISE_MM
    touches: int = 5


@dataclass(frozen=True)
class FixtureLimits:
    """Limits on a fixture by touches or markers.

    Attributes:
        sigma_mm: Predicted sigma of the fixture's worst offset, at the centre of its points [mm].
        sigma_deg: The same of its rotation [deg]: 0.1 deg are half a millimetre over 300.
        noise_mm: Noise of a touch per axis [mm].
        points: Points of a drawing in the fit; with fewer a wrong one cannot be detected.
    """

    sigma_mm: Pair = _TOUCHED_MM
    sigma_deg: Pair = (0.1, 0.4)
    noise_mm: Pair = _TOUCH_NOISE_MM
    points: int = 4


@dataclass(frozen=True)
class ImageFrameLimits:
    """Limits on a tool or a fixture by a target in images.

    Attributes:
        sigma_mm: Predicted sigma of the offset's worst direction [mm].
        sigma_deg: The same of the rotation [deg].
    """

    sigma_mm: Pair = _PLACE_MM
    sigma_deg: Pair = _SMALL_TURN_DEG


@dataclass(frozen=True)
class CheckLimits:
    """Limits on a check of a calibration by a few stops.

    Attributes:
        likelihood_ratio: Likelihood ratio of a change to none at which it is reported. Its mean is
            one without a change, so that by Markov's inequality chance exceeds the limit in at most
            one of as many checks.
        ruled_out: Likelihood ratio of the best cause to another at which that is ruled out.
        unexplained: Significance level of residuals that no cause explains.
        stops: Number of stops; fewer hardly separate causes.
    """

    likelihood_ratio: float = 100.0
    ruled_out: float = 20.0
    unexplained: float = 1e-3
    stops: int = 5


@dataclass(frozen=True)
class DynamicsLimits:
    """Limits on identified dynamics.

    Attributes:
        worse: Prediction error of other motions over the fit's residual.
        bodies_worse: Prediction error of consistent parameters over that of base parameters.
        slight_share: Share of a torque's range below which an error is no reason for doubt.
        range_share: Prediction error over the torque's range.
        known_share: Prediction error of known inertias over the range, beyond which the robot is
            another one.
        lag_share: Change of torques by their lag over the range, below which it is only a note.
        undetermined_share: Share of undetermined base parameters; those of the wrist matter little.
    """

    worse: float = 1.5
    bodies_worse: float = 1.3
    slight_share: float = 0.02
    range_share: Pair = (0.2, 0.6)
    known_share: float = 0.5
    lag_share: float = 0.1
    undetermined_share: float = 0.5


# Greatest blur of an image in which a board is detected, as a Gaussian's sigma [px].
MAX_BLUR_PX = 4.0
