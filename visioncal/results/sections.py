"""Sections of a result beside those of arms: clock, boards, uncertainty, and what a check needs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np

from visioncal.core.codec import REST, Array, Matrix, Section, Vector
from visioncal.core.types import FloatArray, Mask, Target
from visioncal.estimation.appearance import BOARD_NAMES, board_basis
from visioncal.estimation.effects.rolling_shutter import Shutter
from visioncal.results.arm import ArmSections
from visioncal.results.edge import Covariance
from visioncal.vision.targets import corner_positions

_BEND = "bow_"
# Files of earlier versions are without it.
_LATER = "shear"
# Names of levels with their 95 % intervals.
Intervals = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class ClockResult(Section):
    """How far the camera's clock is ahead of the robot's: `clock` in calibration.json.

    Attributes:
        camera_minus_robot_s: The offset [s].
        method: Estimated from the motion, or from its turning alone; stated by the session; of no
            consequence, for views at rest.
        sigma_s: The standard deviation [s]; None for views at rest.
        stated_s: What the session states [s]; None where it states nothing.
        frames: How many frames in motion it was estimated from; None where from none.
        correlation: Of the angles by which camera and robot turned; None where none was found.
        shutter: When the rows of an image are taken; None where that was not looked for.
    """

    camera_minus_robot_s: float
    method: Literal["motion", "turning", "stated", "rest"]
    sigma_s: float | None = None
    stated_s: float | None = None
    frames: int | None = None
    correlation: float | None = None
    shutter: Shutter | None = None


@dataclass(frozen=True, kw_only=True)
class InstrumentResult(Section):
    """The instrument as it was taken: `instrument` in calibration.json.

    Attributes:
        words: What it is.
        reads: Whether it reads `poses` or `places`.
        sigma_m: Standard deviation of a place at zero distance [m].
        sigma_per_m: Its growth with the distance.
        sigma_rad: Standard deviation of a rotation [rad]; None where places were read.
    """

    words: str
    reads: Literal["poses", "places"]
    sigma_m: float
    sigma_per_m: float
    sigma_rad: float | None = None


@dataclass(frozen=True, kw_only=True)
class PointResult(Section):
    """A point that an instrument read, in the flange's frame [m], with its sigma [mm]."""

    point: str
    x_m: float
    y_m: float
    z_m: float
    sigma_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardResult(Section):
    """A board as it was found to be: `board`, or an entry of `boards`, in calibration.json.

    Attributes:
        shape: Its departure from the stated one, by the names of `estimation.BOARD_NAMES`: `scale`
            and `aspect` are relative, `shear` is by how much its rows and columns meet at less than
            a right angle [rad], bows are of the board's edge [m].
        sigma: Standard deviations of those that were free.
        estimated: Those that the fit moved.
        bend_mm: The depth within which its corners lie [mm].
    """

    shape: Mapping[str, float]
    sigma: Mapping[str, float]
    estimated: tuple[str, ...]
    bend_mm: float

    def __post_init__(self) -> None:
        """Checks that the shape is whole.

        Raises:
            ValueError: It is not.
        """
        for name in BOARD_NAMES:
            if name not in self.shape and name != _LATER:
                raise ValueError(f"shape.{name} is missing")

    @property
    def values(self) -> FloatArray:
        """(10,) the shape in the order of `BOARD_NAMES`."""
        return np.array([self.shape.get(name, 0.0) for name in BOARD_NAMES])

    @property
    def is_bent(self) -> bool:
        """Whether its bend was estimated; else it was taken as flat."""
        return any(name.startswith(_BEND) for name in self.estimated)

    def squares_m(self, target: Target) -> tuple[float, float]:
        """Sides of its squares along the target's x and y [m]."""
        scale, half = 1.0 + self.shape["scale"], 0.5 * self.shape["aspect"]
        return target.square_m * (scale - half), target.square_m * (scale + half)

    def corners(self, target: Target) -> FloatArray:
        """(c, 3) where the corners lie in the target's frame, whose z points into the board [m]."""
        flat = corner_positions(target)
        return np.asarray(flat + board_basis(flat) @ self.values)


@dataclass(frozen=True, eq=False, kw_only=True)
class RigResult(Section):
    """A rig of points as it was found to be: `rig`, or an entry of `rigs`, in calibration.json.

    Attributes:
        shape: (n, 3) departures of its points from where they are stated [m].
        sigma: (n, 3) their standard deviations [m].
    """

    shape: Annotated[FloatArray, Array((-1, 3))]
    sigma: Annotated[FloatArray, Array((-1, 3))]

    @property
    def values(self) -> FloatArray:
        """(3 n,) the shape, point by point."""
        return self.shape.ravel()


@dataclass(frozen=True, eq=False, kw_only=True)
class UncertaintyResult(Section):
    """How well a point is placed where the views look: `uncertainty` in calibration.json.

    Attributes:
        point_cam_m: (3,) that point in the camera's frame [m].
        budget_mm: Standard deviation by source, and of all as `total` [mm].
        radius95_mm: The point is right to within this in 95 % of cases [mm].
        noise_95: 95 % intervals of the noise's levels, by their names in `Calibration.noise`.
        spectrum: (12,) standard deviations along the principal directions of both transforms,
            ascending, in units of the largest that are accepted.
        inflation: By how much the covariance grew because neighbouring stops err alike.
    """

    point_cam_m: Annotated[FloatArray, Array((3,))]
    budget_mm: Mapping[str, float]
    radius95_mm: float
    noise_95: Intervals
    spectrum: Vector
    inflation: float = 1.0

    def __post_init__(self) -> None:
        """Checks that the budget has a source and their total.

        Raises:
            ValueError: It has not.
        """
        if "total" not in self.budget_mm or len(self.budget_mm) < 2:
            raise ValueError("budget_mm has no total, or no source")

    @property
    def distance_m(self) -> float:
        """Of the point from the camera [m]."""
        return float(np.linalg.norm(self.point_cam_m))

    @property
    def parts_mm(self) -> dict[str, float]:
        """Standard deviation by source, the largest first [mm]; their squares add up."""
        parts = [(name, value) for name, value in self.budget_mm.items() if name != "total"]
        return dict(sorted(parts, key=lambda pair: -pair[1]))

    @property
    def total_mm(self) -> float:
        """Standard deviation by all sources together [mm]."""
        return self.budget_mm["total"]

    def percent(self, source: str) -> str:
        """Writes a source's share of the variance."""
        part_mm = self.budget_mm[source]
        share = (part_mm / self.total_mm) ** 2 if self.total_mm > 0.0 else 0.0
        return "<1 %" if part_mm > 0.0 and share < 0.005 else f"{100 * share:.0f} %"


@dataclass(frozen=True, kw_only=True)
class NoiseIntervals(Section):
    """What `uncertainty` is of a part of a whole cell.

    Attributes:
        noise_95: See `UncertaintyResult`.
    """

    noise_95: Intervals


@dataclass(frozen=True, kw_only=True)
class CellUncertainty(Section):
    """How well a whole cell is known: its `uncertainty` in calibration.json.

    Attributes:
        budget_mm: By transform, the standard deviation of its frame's place by source, and of all
            as `total` [mm].
        noise_95: 95 % intervals of the noise's levels by robot, and by name.
    """

    budget_mm: Mapping[str, Mapping[str, float]]
    noise_95: Mapping[str, Intervals] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedArm:
    """What the errors of an arm are among the unknowns of a fit.

    Attributes:
        of: What they are of: the reported `poses`, all `links`, or the calibrated `model`.
        values: (k,) what they were found to be beside the arm that is stated.
        weights: Of a model: by its blocks, the standard deviations of their errors.
        flange_from_reported: (4, 4) of a model: what was reported, in its flange's frame.
        by_stop: (k,) of a model: errors that go by the loads of a stop.
        torque_nm: The torque that these are for [N m].
        yielding: (n,) the joints that bend.
        weight_functions: (4 n, r) a joint: what the weight of its links can be (see
            `robot.WeightFunctions`).
    """

    of: Literal["poses", "links", "model"]
    values: Vector
    weights: Mapping[str, float] | None = None
    flange_from_reported: Annotated[FloatArray, Array((4, 4))] | None = None
    by_stop: Vector | None = None
    torque_nm: float | None = None
    yielding: Annotated[Mask, Array((-1,))] | None = None
    weight_functions: tuple[Matrix, ...] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class JointFit(Section):
    """The unknowns of the fit and their covariance, for a later check: `joint_fit`.

    Attributes:
        targets: What was printed, by name and as it is described.
        boards: The names of the targets that the fit places; none of a camera and robot alone.
        looks: Which values of lens and targets are among the unknowns.
        arm: The errors of the arm; None where none were found.
        covariance: (k, k) of both transforms, of lens and targets, of where further targets lie
            from the first, and of the arm's errors.
    """

    targets: Mapping[str, Any]
    boards: tuple[str, ...]
    looks: tuple[int, ...]
    arm: FittedArm | None = None
    covariance: Covariance


@dataclass(frozen=True, eq=False, kw_only=True)
class CellJointFit(Section):
    """The unknowns of the fit of a whole cell and their covariance: its `joint_fit`.

    Attributes:
        cameras: By name, which values of a camera's lens are among the unknowns.
        targets: By name, which values of a target's shape are.
        arms: By name, the errors of each robot's arm that was calibrated along.
        covariance: (k, k) of the transforms, then of these.
    """

    cameras: Mapping[str, tuple[int, ...]]
    targets: Mapping[str, tuple[int, ...]]
    arms: Mapping[str, FittedArm] = field(default_factory=dict)
    covariance: Covariance


@dataclass(frozen=True, kw_only=True)
class CornerResiduals:
    """Residuals of views that were left out [mm, px]; None where they have none."""

    mm: float
    px: float | None = None


@dataclass(frozen=True, kw_only=True)
class ImageBlur:
    """How an image is blurred.

    Attributes:
        view: The view's number.
        sigma_px: Standard deviation of the lens' blur [px].
        disc_px: Radius of the disc of what is out of focus [px].
        motion_px: How far the camera moved while it was taken [px].
        motion_deg: In which direction, from the image's x [deg].
        tone: How far its tones are from linear (see `vision.dense.fit`).
        pixel_noise: Standard deviation of a pixel [grey levels].
    """

    view: int
    sigma_px: float
    disc_px: float
    motion_px: float
    motion_deg: float
    tone: float
    pixel_noise: float


@dataclass(frozen=True, kw_only=True)
class DenseResult(Section):
    """What corners of dense image fits brought: `dense` in calibration.json.

    Attributes:
        kept: Whether they were kept.
        held_out: Residuals of views that were left out, of corners by `template` and `dense`.
        images: How each image is blurred.
    """

    kept: bool
    held_out: Mapping[str, CornerResiduals]
    images: tuple[ImageBlur, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchedPoint(Section):
    """A point that the camera located and the tool touched.

    Attributes:
        name: Which point of the board.
        base_m: (3,) where it was located, in the base [m].
        radius95_mm: How near the tip comes with 95 %, as predicted [mm].
        gap_mm: How far the tip was from it [mm].
    """

    name: str
    base_m: Vector
    radius95_mm: float
    gap_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchTest(Section):
    """The touch test that joined the result: `touch_test` in calibration.json.

    Attributes:
        created: When, in ISO 8601.
        tool: With which tool.
        passed: Whether the gaps are as small as predicted.
        points: What was touched.
    """

    created: str
    tool: str
    passed: bool
    points: tuple[TouchedPoint, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationSections(ArmSections):
    """What was found beside transforms, cameras and views; None or empty where not computed.

    Attributes:
        clock: How far the camera's clock is ahead of the robot's.
        instrument: The instrument that read the flange.
        points: The points on the flange that it read.
        board: The board as it was found to be, where there is one without a name.
        boards: The boards by name.
        rig: The rig of points, likewise.
        rigs: The rigs by name.
        uncertainty: How well a point is placed where the views look.
        conditions: Mean values over the used views, by the columns `ambient_c` and `payload_kg`.
        joint_fit: The unknowns of the fit and their covariance, for a later check.
        dense: What corners of dense image fits brought.
        touch_test: What was touched to prove it.
        further: Sections that this version does not know, as the file has them.
    """

    clock: ClockResult | None = None
    instrument: InstrumentResult | None = None
    points: tuple[PointResult, ...] = ()
    board: BoardResult | None = None
    boards: Mapping[str, BoardResult] = field(default_factory=dict)
    rig: RigResult | None = None
    rigs: Mapping[str, RigResult] = field(default_factory=dict)
    uncertainty: UncertaintyResult | NoiseIntervals | None = None
    conditions: Mapping[str, float] = field(default_factory=dict)
    joint_fit: JointFit | None = None
    dense: DenseResult | None = None
    touch_test: TouchTest | None = None
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict)

    @property
    def budget(self) -> UncertaintyResult | None:
        """`uncertainty`, where it is of the fit itself; None of a part of a whole cell."""
        return self.uncertainty if isinstance(self.uncertainty, UncertaintyResult) else None

    @property
    def named_boards(self) -> dict[str, BoardResult]:
        """The boards by name, which is empty where there is one without."""
        return dict(self.boards) if self.board is None else {"": self.board}


@dataclass(frozen=True)
class CellDetails(Section):
    """Further figures of a whole cell: its `details` in calibration.json.

    Attributes:
        clocks: The clocks, by the camera and the robot whose they are, in words.
    """

    clocks: Mapping[str, ClockResult] = field(default_factory=dict)
