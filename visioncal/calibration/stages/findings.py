"""What a verdict is made of: cameras, robots and targets as the fit has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from visioncal.calibration.stages.need import Picks
from visioncal.core.types import Mount, Need, Rejection
from visioncal.core.verdict import Finding
from visioncal.estimation.observability import Direction
from visioncal.results import Rms, ViewResult
from visioncal.results.views import holdout_rms, left_out_rms, rms_of
from visioncal.session.frames import thing_name


@dataclass(frozen=True)
class JudgedPair:
    """What one camera or instrument saw of one target.

    Attributes:
        views: What became of each view.
        disagreeing: Those whose robot pose and image do not belong together.
        name: Both, by name; empty where there are no others.
        noise: What the sensor's own noise makes of its views.
        away: `held_out` with the same weights as `noise`; None where all views weigh alike.
    """

    views: Sequence[ViewResult]
    disagreeing: Sequence[Rejection] = ()
    name: str = ""
    noise: Rms = field(default_factory=lambda: Rms(0.0, 0.0))
    away: Rms | None = None

    @property
    def held_out(self) -> Rms:
        """Residuals of the used ones, left out in turn."""
        return left_out_rms(self.views)

    @property
    def holdout(self) -> Rms | None:
        """Residuals of those held back by the session; None where there are none."""
        return holdout_rms(self.views)


@dataclass(frozen=True)
class Sensor:
    """A camera or an instrument.

    Attributes:
        used: How many of its views are used.
        lost: Those that could not be; those held back on purpose are not among them.
        disagreeing: How many of these have a robot pose and an image that do not belong together.
        pixel_px: Noise of a corner's coordinate; None without images [px].
        level: By how much more its poses scatter than their noise says.
        spared: How many were not needed, as others stand for them.
        name: Its frame; empty where there is no other.
    """

    used: int
    lost: Sequence[Rejection] = ()
    disagreeing: Sequence[int] = ()
    pixel_px: float | None = None
    level: float = 1.0
    spared: int = 0
    name: str = ""


@dataclass(frozen=True)
class JudgedArm:
    """A robot.

    Attributes:
        stops: At how many stops it has a part in the fit.
        away_mm: Noise of its flange; None where that cannot be separated from the cameras' [mm].
        away_deg: The same in rotation [deg].
        surely: Ends of their 95 % intervals below [mm, deg]; as found where None.
        errs: Whether its errors follow its posture, which is said elsewhere.
        workspace_mm: Predicted sigma of a tool's place all over a calibrated arm's workspace, in
            the median; None for a nominal arm [mm].
        modelled: Whether its model is known.
        by_functions: Whether functions of its joints follow the very stops of the fit.
        can_tilt: Whether its flange turns about more than one direction.
        name: Its name; empty where there is no other.
    """

    stops: int
    away_mm: float | None = None
    away_deg: float | None = None
    surely: tuple[float, float] | None = None
    errs: bool = False
    workspace_mm: float | None = None
    modelled: bool = False
    by_functions: bool = False
    can_tilt: bool = True
    name: str = ""


@dataclass(frozen=True)
class PointAccuracy:
    """How well a place is known where it counts.

    Attributes:
        words: What it is, in words.
        budget_mm: Its standard deviation by source, and as a `total` [mm].
        radius95_mm: It is right to within this in 95 % of cases [mm].
    """

    words: str
    budget_mm: Mapping[str, float]
    radius95_mm: float


@dataclass(frozen=True)
class StandingTie:
    """That one view of what stands still ties a part of a cell to the rest.

    Attributes:
        words: Which view that is, as a part of a sentence.
        advice: What to do about it, in a sentence.
    """

    words: str
    advice: str


@dataclass(frozen=True)
class Findings:
    """What the verdict is made of.

    Attributes:
        pairs: What each camera saw of each target.
        sensors: The cameras and instruments.
        arms: The robots.
        worst: The worst directions of the unknown edges; the first is named in a good verdict. None
            of those of a cell that take up what is open of a calibrated arm.
        places: How well places are known; likewise.
        warnings: What earlier stages had to say.
        notes: What of it is no reason for doubt.
        mount: What observed whom.
        need: What the task needs; None where that is not said.
        picks: What picks err by, by each camera and robot; empty where that is not predicted.
        tie: What alone ties the frame that is known worst; None where more does.
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

    @property
    def plannable(self) -> bool:
        """Whether views can be proposed: of cameras, by arms whose models are known."""
        has_images = any(sensor.pixel_px is not None for sensor in self.sensors)
        return has_images and all(arm.modelled for arm in self.arms)

    @property
    def of_camera(self) -> str:
        """The option that names, of several cameras that a robot looks with, the least known."""
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
        return f" --camera {thing_name(max(cameras, key=weak_m.__getitem__), 'camera')}"

    @property
    def views(self) -> tuple[ViewResult, ...]:
        """What became of each view."""
        return tuple(view for pair in self.pairs for view in pair.views)

    @property
    def rms(self) -> Rms:
        """Residuals of all used views."""
        return rms_of(self.views)

    @property
    def held_out(self) -> Rms:
        """Residuals of all of them, left out in turn."""
        return left_out_rms(self.views)


def _is_offset_of(direction: Direction, frame: str) -> bool:
    return not direction.is_rotation and direction.words.startswith(f"{frame}'s ")
