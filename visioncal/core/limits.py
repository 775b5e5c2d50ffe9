"""Limits of every verdict, in one table; pairs are where doubt begins and where trust ends."""

from dataclasses import dataclass
from typing import TypeAlias

# A result is `check` beyond the first and `bad` beyond the second.
Pair: TypeAlias = tuple[float, float]

# Predicted sigma of a place that a camera gives [mm]: pick cells live with 1 mm.
_PLACE_MM = (1.0, 3.0)
# Predicted sigma of a place that is touched [mm]: a careful hand repeats to 0.1 mm or better.
_TOUCHED_MM = (0.5, 2.0)
# Noise of a touch per axis [mm], for the same reason.
_TOUCH_NOISE_MM = (0.5, 3.0)
# Predicted sigma of the rotation of what is small: a tool, or one board [deg].
_SMALL_TURN_DEG = (0.3, 1.0)


@dataclass(frozen=True)
class NeedLimits:
    """Of a task's need.

    Attributes:
        probability: Picks within the need: `good` from the first on, `bad` below the second.
        chance: Left-out views of a sound cell err by more than the need in so many sessions.
    """

    probability: Pair = (0.95, 0.5)
    chance: float = 0.01


@dataclass(frozen=True)
class CalibrationLimits:
    """Of a calibration without a need: one camera and robot, or a whole cell.

    Attributes:
        scatter_mm: Left-out scatter of the target's position [mm].
        scatter_deg: Left-out scatter of its orientation [deg].
        sigma_mm: Predicted sigma of the worst direction of an edge [mm].
        sigma_deg: The same in rotation [deg]: 0.1 deg moves a point 0.5 m away by 1 mm.
        pixel_px: Noise of a corner's coordinate [px]; sharp images give 0.05 to 0.3.
        level: How much more a camera's poses scatter than its corners say.
        robot_mm: Error of the flange from stop to stop [mm]; arms repeat to 0.1 mm or better, and
            what is beyond is seldom independent from stop to stop, as the covariance takes it.
        robot_deg: The same in rotation [deg].
        stops: Stops of the robot in the fit; fewer leave too little to check the result with.
        lost_share: Share of views that could not be used.
        optimism: Left-out over in-sample scatter; large where each view carries the fit.
        outlier: Residual of a view over the median of all.
        holdout: Residuals of views held back over those of views left out in turn.
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
    """Of a tool by touches.

    Attributes:
        sigma_mm: Predicted sigma of the tip's worst direction [mm].
        sigma_deg: The same of the rotation [deg].
        noise_mm: Noise of a touch per axis [mm].
        touches: Touches in the fit; fewer leave too little to check it with.
    """

    sigma_mm: Pair = _TOUCHED_MM
    sigma_deg: Pair = _SMALL_TURN_DEG
    noise_mm: Pair = _TOUCH_NOISE_MM
    touches: int = 5


@dataclass(frozen=True)
class FixtureLimits:
    """Of a fixture by touches or by markers.

    Attributes:
        sigma_mm: Predicted sigma of the fixture's worst offset, amid its points [mm].
        sigma_deg: The same of its rotation [deg]: 0.1 deg are half a millimetre over 300.
        noise_mm: Noise of a touch per axis [mm].
        points: Points of a drawing in the fit; with fewer none could be shown wrong.
    """

    sigma_mm: Pair = _TOUCHED_MM
    sigma_deg: Pair = (0.1, 0.4)
    noise_mm: Pair = _TOUCH_NOISE_MM
    points: int = 4


@dataclass(frozen=True)
class ImageFrameLimits:
    """Of a tool or a fixture by a target in images.

    Attributes:
        sigma_mm: Predicted sigma of the offset's worst direction [mm].
        sigma_deg: The same of the rotation [deg].
    """

    sigma_mm: Pair = _PLACE_MM
    sigma_deg: Pair = _SMALL_TURN_DEG


@dataclass(frozen=True)
class CheckLimits:
    """Of a check of a calibration by a few stops.

    Attributes:
        likelihood_ratio: A change is reported where it makes the stops so many times as likely as
            none. Chance does that in one check of as many at most, by Markov's inequality: the
            ratio is one on average.
        ruled_out: A cause that makes the stops so many times less likely than the best is ruled
            out.
        unexplained: Noise leaves more than the right cause explains in so many checks.
        stops: Fewer hardly separate one cause from another.
    """

    likelihood_ratio: float = 100.0
    ruled_out: float = 20.0
    unexplained: float = 1e-3
    stops: int = 5


@dataclass(frozen=True)
class DynamicsLimits:
    """Of identified dynamics.

    Attributes:
        worse: Torques of other motions may be predicted so many times worse than those fitted.
        bodies_worse: Consistent bodies may predict so many times worse than base parameters.
        slight_share: An error under this share of a torque's range is no reason for doubt.
        range_share: Error of a prediction as a share of the torque's range.
        known_share: Known inertias that leave more of the range are another robot's.
        lag_share: A lag of the torques that changes them by less of their range is a note.
        undetermined_share: So many of the base parameters may be noise: those of the wrist weigh
            little.
    """

    worse: float = 1.5
    bodies_worse: float = 1.3
    slight_share: float = 0.02
    range_share: Pair = (0.2, 0.6)
    known_share: float = 0.5
    lag_share: float = 0.1
    undetermined_share: float = 0.5


# Widest edges of an image that a board is read in, as a Gaussian's sigma [px].
MAX_BLUR_PX = 4.0
