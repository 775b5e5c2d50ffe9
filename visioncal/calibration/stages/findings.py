"""Inputs of the verdict: the quality of sensors, robots and pairs in the fit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from visioncal.calibration.stages.need import Picks
from visioncal.core.types import Mount, Need, Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.observability import Direction
from visioncal.results import Rms, ViewResult
from visioncal.results.views import holdout_rms, left_out_rms, rms_of
from visioncal.session.frames import object_name


@dataclass(frozen=True)
class JudgedPair:
    """Views of one target by one camera or instrument.

    Attributes:
        views: Result of each view.
        outliers: Outliers: views whose robot pose and image do not belong together.
        name: Names of both; empty for a single pair.
        noise: Expected residuals by the sensor's own noise.
        weighted_held_out: `held_out` with the weights of `noise`; None where all views have equal
            weights.
    """

    views: Sequence[ViewResult]
    outliers: Sequence[Rejection] = ()
    name: str = ""
    noise: Rms = field(default_factory=lambda: Rms(0.0, 0.0))
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
    """A camera or an instrument.

    Attributes:
        used: Number of its used views.
        lost: Rejected views, without those held back on purpose.
        outliers: The outliers among these.
        pixel_px: Noise of a corner's coordinate; None without images [px].
        level: Ratio of the scatter of its poses to their predicted noise.
        spared: Number of redundant views that were not needed.
        name: Its frame; empty for a single sensor.
        holds_lens: Whether its lens is held and counts in the covariance.
        has_lens_sigma: Whether the session states how well its matrix is known.
    """

    used: int
    lost: Sequence[Rejection] = ()
    outliers: Sequence[int] = ()
    pixel_px: float | None = None
    level: float = 1.0
    spared: int = 0
    name: str = ""
    holds_lens: bool = False
    has_lens_sigma: bool = False


@dataclass(frozen=True)
class JudgedArm:
    """A robot.

    Attributes:
        stops: Number of its stops in the fit.
        noise_mm: Noise of its flange; None where that cannot be separated from the cameras' [mm].
        noise_deg: The same in rotation [deg].
        lower_bounds: Lower ends of their 95 % intervals [mm, deg]; None for the estimates
            themselves.
        has_posture_errors: Whether it has posture-dependent errors, which have a finding of their
            own.
        workspace_mm: Median predicted position sigma of a calibrated arm's tool over the workspace;
            None for a nominal arm [mm].
        modelled: Whether its model is known.
        by_functions: Whether joint error functions were fitted to the stops.
        can_tilt: Whether its flange turns about more than one direction.
        name: Its name; empty for a single robot.
    """

    stops: int
    noise_mm: float | None = None
    noise_deg: float | None = None
    lower_bounds: tuple[float, float] | None = None
    has_posture_errors: bool = False
    workspace_mm: float | None = None
    modelled: bool = False
    by_functions: bool = False
    can_tilt: bool = True
    name: str = ""


@dataclass(frozen=True)
class PointAccuracy:
    """Accuracy of a point of interest.

    Attributes:
        words: The point in words.
        budget_mm: Its standard deviation by source, and as a `total` [mm].
        radius95_mm: Radius of 95 % probability [mm].
    """

    words: str
    budget_mm: Mapping[str, float]
    radius95_mm: float


@dataclass(frozen=True)
class StandingTie:
    """Single view of static frames that alone connects a part of a cell; in words, with advice."""

    words: str
    advice: str


@dataclass(frozen=True)
class Findings:
    """Inputs of the verdict.

    Attributes:
        worst: Directions of the unknown edges with the largest sigmas; the first is named in a good
            verdict. Edges that absorb undetermined errors of a calibrated arm are left out.
        places: Accuracy of points of interest, without the same edges.
        warnings: Findings of earlier stages.
        notes: Their remarks that are no reason for doubt.
        mount: Mount of the sensor.
        need: Required accuracy; None where it is not stated.
        picks: Error budgets of picks by camera and robot, with targets that are corrected where the
            arm was calibrated; empty where they are not predicted.
        tie: The only connection of the worst frame; None where there are more.
        corrects_targets: Whether targets are corrected for a calibrated arm.
        use: How a good result is used.
    """

    pairs: Sequence[JudgedPair]
    sensors: Sequence[Sensor]
    arms: Sequence[JudgedArm]
    worst: Sequence[Direction]
    places: Sequence[PointAccuracy]
    warnings: Sequence[Finding] = ()
    notes: Sequence[str] = ()
    mount: Mount = "eye-in-hand"
    need: Need | None = None
    picks: Sequence[Picks] = ()
    tie: StandingTie | None = None
    corrects_targets: bool = False
    use: Remedy | None = None

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
    def of_camera(self) -> str:
        """Command option for the least accurate of several cameras; empty for one."""
        cameras = dict.fromkeys(pick.camera for pick in self.picks)
        if len({sensor.name for sensor in self.sensors}) < 2 or not cameras:
            return ""
        weak_m = {
            camera: max(
                (direction.sigma for direction in self.worst if _is_offset_of(direction, camera)),
                default=0.0,
            )
            for camera in cameras
        }
        return f" --camera {object_name(max(cameras, key=weak_m.__getitem__), 'camera')}"

    @property
    def views(self) -> tuple[ViewResult, ...]:
        """Result of each view."""
        return tuple(view for pair in self.pairs for view in pair.views)

    @property
    def rms(self) -> Rms:
        """Residuals of all used views."""
        return rms_of(self.views)

    @property
    def held_out(self) -> Rms:
        """Residuals of all used views, left out in turn."""
        return left_out_rms(self.views)


def _is_offset_of(direction: Direction, frame: str) -> bool:
    return not direction.is_rotation and direction.words.startswith(f"{frame}'s ")
