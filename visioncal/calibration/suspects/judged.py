"""Inputs of the verdict: the quality of sensors, robots and pairs in the fit."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from visioncal.calibration.stages.need import Picks
from visioncal.core.directions import Direction
from visioncal.core.types import Need, Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.results import Rms, ViewResult
from visioncal.results.views import holdout_rms, left_out_rms
from visioncal.robot.model import REPEATABILITY


@dataclass(frozen=True)
class JudgedPair:
    """Views of one target by one camera or instrument."""

    views: Sequence[ViewResult]  # Result of each view.
    # Outliers: views whose robot pose and image do not belong together.
    outliers: Sequence[Rejection] = ()
    name: str = ""  # Names of both; empty for a single pair.
    # Expected residuals by the sensor's own noise.
    noise: Rms = field(default_factory=lambda: Rms(0.0, 0.0))
    # `held_out` with the weights of `noise`; None where all views have equal weights.
    weighted_held_out: Rms | None = None

    @property
    def held_out(self) -> Rms:
        """Residuals of the used views, left out in turn."""
        return left_out_rms(self.views)

    @property
    def holdout(self) -> Rms | None:
        """Residuals of the views held back by the session; None without any."""
        return holdout_rms(self.views)


@dataclass(frozen=True)
class Sensor:
    """A camera or an instrument."""

    used: int  # Number of its used views.
    lost: Sequence[Rejection] = ()  # Rejected views, without those held back on purpose.
    outliers: Sequence[int] = ()  # The outliers among these.
    pixel_px: float | None = None  # Noise of a corner's coordinate; None without images [px].
    spared: int = 0  # Number of redundant views that were not needed.
    name: str = ""  # Its frame; empty for a single sensor.


@dataclass(frozen=True)
class JudgedArm:
    """A robot."""

    stops: int  # Number of its stops in the fit.
    # Noise of its flange; None where that cannot be separated from the cameras' [mm].
    noise_mm: float | None = None
    noise_deg: float | None = None  # The same in rotation [deg].
    # Lower ends of their 95 % intervals [mm, deg]; None for the estimates themselves.
    lower_bounds: tuple[float, float] | None = None
    # Whether it has posture-dependent errors, which have a finding of their own.
    has_posture_errors: bool = False
    # Whether most of what is uncertain comes from errors that last from stop to stop.
    are_lasting: bool = False
    # Median predicted position sigma of a calibrated arm's tool over the workspace; None for a
    # nominal arm [mm].
    workspace_mm: float | None = None
    modelled: bool = False  # Whether its model is known.
    # Standard deviation of its flange from stop to stop, as an arm of its kind has it [mm, deg].
    repeatability: tuple[float, float] = REPEATABILITY
    can_tilt: bool = True  # Whether its flange turns about more than one direction.
    name: str = ""  # `Robot` and its name, for messages; empty for a single robot.


@dataclass(frozen=True)
class Findings:
    """Inputs of the verdict."""

    pairs: Sequence[JudgedPair]
    sensors: Sequence[Sensor]
    arms: Sequence[JudgedArm]
    # Directions of the unknown edges with the largest sigmas; the first is named in a good verdict.
    # Edges that absorb undetermined errors of a calibrated arm are left out.
    worst: Sequence[Direction]
    warnings: Sequence[Finding] = ()  # Findings of earlier stages.
    notes: Sequence[str] = ()  # Their remarks that are no reason for doubt.
    need: Need | None = None  # Required accuracy; None where it is not stated.
    # Error budgets of picks by camera and robot, with targets that are corrected where the arm was
    # calibrated; empty where they are not predicted.
    picks: Sequence[Picks] = ()
    corrects_targets: bool = False  # Whether targets are corrected for a calibrated arm.
    use: Remedy | None = None  # How a good result is used.
    # Whether most of the variance of the least certain direction would go with a known lens.
    by_lens: bool = False

    @property
    def judged_picks(self) -> tuple[Picks, ...]:
        """Picks as the task makes them: by the controller's own poses, unless it corrects them."""
        if self.corrects_targets:
            return tuple(self.picks)
        return tuple(pick.uncorrected or pick for pick in self.picks)

    @property
    def plannable(self) -> bool:
        """Whether views can be planned: for cameras, by arms with known models."""
        has_images = any(sensor.pixel_px is not None for sensor in self.sensors)
        return has_images and all(arm.modelled for arm in self.arms)

    @property
    def views(self) -> tuple[ViewResult, ...]:
        """Result of each view."""
        return tuple(view for pair in self.pairs for view in pair.views)

    @property
    def held_out(self) -> Rms:
        """Residuals of all used views, left out in turn."""
        return left_out_rms(self.views)
