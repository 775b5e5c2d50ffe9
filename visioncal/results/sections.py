"""Sections of a result beside those on arms: clock, boards, uncertainty, fit for verification."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Self

import numpy as np

from visioncal.core.codec import REST, Array, Matrix, Section, Vector
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray, Mask, Target
from visioncal.estimation.effects.rolling_shutter import Shutter
from visioncal.results.arm import ArmSections
from visioncal.results.edge import Covariance
from visioncal.robot import Robot
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.elasticity import WeightFunctions
from visioncal.vision.board_shape import BOARD_NAMES, shaped_corners

_BEND = "bow_"
# 95 % intervals by name of the noise level.
Intervals = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class ClockResult(Section):
    """Clock offset between camera and robot: `clock` in calibration.json."""

    camera_minus_robot_s: float  # The offset [s].
    # `motion`: estimated; `stated` by the session; `rest`: without effect, since the robot stood
    # still.
    method: Literal["motion", "stated", "rest"]
    sigma_s: float | None = None  # Its standard deviation [s]; None for views at rest.
    stated_s: float | None = None  # The stated offset [s]; None where there is none.
    # Number of frames in motion that it was estimated from; None for none.
    frames: int | None = None
    # Correlation of the rotation angles of camera and robot; None where unknown.
    correlation: float | None = None
    shutter: Shutter | None = None  # Readout times of an image's rows; None where not estimated.


@dataclass(frozen=True, kw_only=True)
class InstrumentResult(Section):
    """Instrument of the session: `instrument` in calibration.json."""

    words: str  # Description of the instrument.
    reads: Literal["poses", "places"]  # `poses`, or `places` for positions.
    sigma_m: float  # Standard deviation of a coordinate at zero distance [m].
    sigma_per_m: float  # Its growth with the distance [m/m].
    # Standard deviation of a rotation [rad]; None where positions were read.
    sigma_rad: float | None = None


@dataclass(frozen=True, kw_only=True)
class PointResult(Section):
    """Point that an instrument measured, in the flange's frame [m], with its sigma [mm]."""

    point: str
    x_m: float
    y_m: float
    z_m: float
    sigma_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardResult(Section):
    """Estimated shape of a board: `board`, or an entry of `boards`, in calibration.json."""

    # Deviation from the stated shape by the names of `estimation.BOARD_NAMES`: `scale` and `aspect`
    # are relative, `shear` is the deficit of the angle between rows and columns from a right angle
    # [rad], bows are at the board's edge [m].
    shape: Mapping[str, float]
    sigma: Mapping[str, float]  # Standard deviations of the free parameters.
    estimated: tuple[str, ...]  # Names of the parameters that were estimated.
    bend_mm: float  # Range of its corners' depths [mm].

    def __post_init__(self) -> None:
        for name in BOARD_NAMES:
            if name not in self.shape:
                raise ValueError(f"shape.{name} is missing")

    @property
    def values(self) -> FloatArray:
        """(10,) shape parameters in the order of `BOARD_NAMES`."""
        return np.array([self.shape[name] for name in BOARD_NAMES])

    @property
    def is_bent(self) -> bool:
        """Whether its bend was estimated; else it is taken as flat."""
        return any(name.startswith(_BEND) for name in self.estimated)

    def corners(self, target: Target) -> FloatArray:
        """(c, 3) corner positions in the target's frame, whose z points into the board [m]."""
        return shaped_corners(target, self.values)


@dataclass(frozen=True, eq=False, kw_only=True)
class RigResult(Section):
    """Estimated shape of a rig of points: `rig`, or an entry of `rigs`, in calibration.json."""

    # (n, 3) deviations of its points from the stated positions [m].
    shape: Annotated[FloatArray, Array((-1, 3))]
    sigma: Annotated[FloatArray, Array((-1, 3))]  # (n, 3) their standard deviations [m].

    @property
    def values(self) -> FloatArray:
        """(3 n,) the flattened shape."""
        return self.shape.ravel()


@dataclass(frozen=True, eq=False, kw_only=True)
class UncertaintyResult(Section):
    """Uncertainty of a point located where the views look: `uncertainty` in calibration.json."""

    point_cam_m: Annotated[FloatArray, Array((3,))]  # (3,) the point in the camera's frame [m].
    budget_mm: Mapping[str, float]  # Standard deviation by source, and their `total` [mm].
    radius95_mm: float  # Radius that 95 % of errors do not exceed [mm].
    # 95 % intervals of the noise levels, by their names in `Calibration.noise`.
    noise_95: Intervals
    # (12,) standard deviations along the principal directions of both transforms, ascending, in
    # units of the largest accepted ones.
    spectrum: Vector
    # (2,) least and greatest distance from the camera at which views looked [m]; absent where
    # unknown.
    distances_m: Annotated[FloatArray, Array((2,))] | None = None

    def __post_init__(self) -> None:
        if "total" not in self.budget_mm or len(self.budget_mm) < 2:
            raise ValueError("budget_mm has no total, or no source")

    @property
    def distance_m(self) -> float:
        """Distance of the point from the camera [m]."""
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
        """A source's share of the variance, in words."""
        part_mm = self.budget_mm[source]
        share = (part_mm / self.total_mm) ** 2 if self.total_mm > 0.0 else 0.0
        return "<1 %" if part_mm > 0.0 and share < 0.005 else f"{100 * share:.0f} %"


@dataclass(frozen=True, kw_only=True)
class NoiseIntervals(Section):
    """`uncertainty` of a part of a whole cell."""

    noise_95: Intervals  # See `UncertaintyResult`.


@dataclass(frozen=True, kw_only=True)
class CellUncertainty(Section):
    """Uncertainty of a whole cell: its `uncertainty` in calibration.json."""

    # By transform, the standard deviation of its frame's position by source, and their `total`
    # [mm].
    budget_mm: Mapping[str, Mapping[str, float]]
    # 95 % intervals of the noise levels, by robot and by name.
    noise_95: Mapping[str, Intervals] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, budget in self.budget_mm.items():
            if "total" not in budget:
                raise ValueError(f"budget_mm.{name} has no total")


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedArm:
    """Arm error parameters of a fit."""

    # Kind of the parameters: errors of all `links`, or parameters of the calibrated `model`.
    of: Literal["links", "model"]
    values: Vector  # (k,) estimates, zero for the nominal arm.
    # True where no stop shows them: they only count in the covariance. Absent otherwise.
    hidden: bool | None = None
    # For a model, prior standard deviations by parameter block.
    weights: Mapping[str, float] | None = None
    # (4, 4) for a model, the reported frame in its flange's frame.
    flange_from_reported: Annotated[FloatArray, Array((4, 4))] | None = None
    by_stop: Vector | None = None  # (k,) for a model, parameters of errors by the loads of a stop.
    torque_nm: float | None = None  # Torque that `by_stop` is for [N m].
    yielding: Annotated[Mask, Array((-1,))] | None = None  # (n,) mask of joints with compliance.
    # (4 n, r) for each joint, a basis of the effect of its links' weight (see
    # `robot.WeightFunctions`).
    weight_functions: tuple[Matrix, ...] | None = None

    def model(self, arm: Robot | None) -> ArmModel | None:
        """An arm's model linearised at its estimate; None for errors of another kind."""
        # The geometry is part of the arm; errors that depend on a stop's loads are in the values.
        if self.of != "model" or arm is None:
            return None
        flange_from_reported, weights = self.flange_from_reported, self.weights
        if flange_from_reported is None or weights is None:
            raise ValueError("arm.flange_from_reported or arm.weights is missing")
        mounted = np.zeros((arm.joint_count + 1, 6))
        mounted[-1] = log(invert(flange_from_reported))
        functions, shape = None, (4 * arm.joint_count, -1)
        if self.weight_functions is not None:
            parts = tuple(part.reshape(shape) for part in self.weight_functions)
            functions = WeightFunctions(parts)
        return ArmModel(
            arm.corrected(mounted),
            flange_from_reported,
            weights,
            np.zeros(len(self.values)) if self.by_stop is None else self.by_stop,
            1.0 if self.torque_nm is None else self.torque_nm,
            self.yielding,
            functions,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedStops:
    """Stops of a fit, which later stops of a verification may repeat."""

    views: tuple[int, ...]  # (m,) the first view of each board at each stop.
    boards: tuple[int, ...]  # (m,) index of the board in `JointFit.boards`.
    poses: Matrix  # (m, 6) exponential coordinates of `base_from_flange` [rad, m].
    residuals: Matrix  # (m, 6) residual of the board's pose, in its frame [rad, m].
    # (k, k) covariance of `JointFit` by noise alone: errors of other sources repeat themselves.
    by_noise: Covariance


@dataclass(frozen=True, eq=False, kw_only=True)
class JointFit(Section):
    """Parameters of the fit and their covariance, for verification: `joint_fit`."""

    targets: Mapping[str, Any]  # Documents of the targets, by name.
    boards: tuple[str, ...]  # Names of the targets that the fit places; empty without a target.
    looks: tuple[int, ...]  # Indices of the free parameters of lens and targets.
    arm: FittedArm | None = None  # The arm's errors; None where none were estimated.
    # (k, k) of the transforms, of lens and targets, and of the arm's errors.
    covariance: Covariance
    stops: FittedStops | None = None  # Its stops; None of a part of a whole cell.

    @property
    def shown(self) -> Self:
        """The fit without arm errors that no stop shows: the arm repeats them, at other stops, too.

        The covariance is that of the other unknowns where they are zero.
        """
        if self.arm is None or not self.arm.hidden:
            return self
        count = len(self.covariance) - len(self.arm.values)
        cross, arm_block = self.covariance[:count, count:], self.covariance[count:, count:]
        left = (
            self.covariance[:count, :count]
            - cross @ np.linalg.pinv(arm_block, hermitian=True) @ cross.T
        )
        stops = self.stops
        if stops is not None:
            stops = replace(stops, by_noise=stops.by_noise[:count, :count])
        return replace(self, arm=None, covariance=left, stops=stops)


@dataclass(frozen=True, eq=False, kw_only=True)
class CellJointFit(Section):
    """Parameters of a whole cell's fit and their covariance: its `joint_fit`."""

    # Indices of each camera's free lens parameters, by name.
    cameras: Mapping[str, tuple[int, ...]]
    # Indices of each target's free shape parameters, by name.
    targets: Mapping[str, tuple[int, ...]]
    # Errors of each calibrated arm, by robot.
    arms: Mapping[str, FittedArm] = field(default_factory=dict)
    covariance: Covariance  # (k, k) of the transforms, then of cameras, targets and arms.


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchedPoint(Section):
    """Point that the camera located and the tool touched."""

    name: str  # Name of the point on the board.
    base_m: Vector  # (3,) its located position in the base [m].
    radius95_mm: float  # Predicted gap that 95 % do not exceed [mm].
    gap_mm: float  # Measured gap between tip and point [mm].


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchTest(Section):
    """Result of a touch test: `touch_test` in calibration.json."""

    created: str  # Time of creation, ISO 8601.
    tool: str  # Name of the touching tool.
    passed: bool  # Whether the gaps are as small as predicted.
    points: tuple[TouchedPoint, ...]  # The touched points.

    @property
    def named_tool(self) -> str:
        """The tool in a sentence."""
        return "the flange" if self.tool == "flange" else self.tool


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationSections(ArmSections):
    """Optional sections of a result; None or empty where not computed."""

    clock: ClockResult | None = None  # Clock offset between camera and robot.
    instrument: InstrumentResult | None = None  # The instrument that measured the flange.
    points: tuple[PointResult, ...] = ()  # The points on the flange that it measured.
    board: BoardResult | None = None  # Estimated shape of the only board, which has no name.
    # Estimated shapes of the boards by name.
    boards: Mapping[str, BoardResult] = field(default_factory=dict)
    rig: RigResult | None = None  # Estimated shape of the only rig of points, which has no name.
    # Estimated shapes of the rigs by name.
    rigs: Mapping[str, RigResult] = field(default_factory=dict)
    # Uncertainty of a point located where the views look.
    uncertainty: UncertaintyResult | NoiseIntervals | None = None
    # Mean values over the used views, by the columns `ambient_c` and `payload_kg`.
    means: Mapping[str, float] = field(default_factory=dict)
    # Parameters of the fit and their covariance, for verification.
    joint_fit: JointFit | None = None
    touch_test: TouchTest | None = None  # Result of a touch test.
    # Unknown sections, kept as they are.
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict)

    @property
    def budget(self) -> UncertaintyResult | None:
        """`uncertainty` of the fit itself; None for a part of a whole cell."""
        return self.uncertainty if isinstance(self.uncertainty, UncertaintyResult) else None


@dataclass(frozen=True)
class CellDetails(Section):
    """Further figures of a whole cell: its `details` in calibration.json."""

    # Clock offsets by camera and robot, as `CAMERA and robot ROBOT`.
    clocks: Mapping[str, ClockResult] = field(default_factory=dict)
