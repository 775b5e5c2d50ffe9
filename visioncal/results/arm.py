"""Sections of a result on an arm: kinematics, errors, joint compliance and thermal drift."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np

from visioncal.core.choices import Convention
from visioncal.core.codec import Array, Key, Matrix, Section, WrittenForm
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.results.edge import Covariance
from visioncal.robot import Robot
from visioncal.robot.thermal import Heating, Kind, ThermalModel

NOMINAL, FUNCTIONS = "nominal", "functions"
# Levels of an arm's model by the parameters that are estimated, those with more after the others.
LEVEL_WORDS = {
    NOMINAL: "the arm as stated",
    "backlash": "play of the joints",
    "offsets": "offsets of the joints",
    "geometry": "geometry of the links",
    "eccentricity": "geometry and eccentric gears",
    "elastic": "geometry, gears, and joints that bend",
    FUNCTIONS: "geometry, gears, gravity, and functions of the joints",
}
# Number of standard deviations beyond which a change is significant.
_SURE = 3.0

StoredRobot = Annotated[
    Robot, WrittenForm(lambda item: dict(item.document), lambda item, _: Robot.from_document(item))
]


@dataclass(frozen=True, kw_only=True)
class ArmLevel:
    """Fit of one level of the arm's model."""

    level: str  # Its name; `nominal` is the nominal arm.
    unknowns: int  # Number of free parameters.
    rms_mm: float  # Residual of the target's position in the fit [mm].
    # Residual of its orientation [deg]; None where only positions were read.
    rms_deg: float | None = None
    held_out_mm: float  # Residual of the position at stops that were left out of the fit [mm].
    # Residual of the orientation there [deg]; None where only positions were read.
    held_out_deg: float | None = None
    likelihood_ratio: float  # Twice the gain in log-likelihood over the nominal arm.


@dataclass(frozen=True)
class JointBacklash:
    """Backlash of a joint."""

    joint: str  # The joint's name.
    # Difference of the joint's angle between approaches from its two sides at the same encoder
    # reading [rad]; negative where the joint overshoots.
    deadband_rad: float
    sigma_rad: float  # Standard deviation of the deadband [rad].

    @property
    def is_sure(self) -> bool:
        """Whether the estimate is significant."""
        return abs(self.deadband_rad) > _SURE * self.sigma_rad


@dataclass(frozen=True, kw_only=True)
class ArmParameter:
    """Identified parameter of the arm's kinematic table."""

    joint: str  # The joint that it belongs to.
    name: str  # The parameter with its unit: `theta_rad`, `a_m`; `ratio` has none.
    nominal: float  # Nominal value [rad or m].
    identified: float  # Identified value [rad or m].
    change: float  # Identified minus nominal value [rad or m].
    sigma: float | None = None  # Standard deviation of the change [rad or m]; None where unknown.

    @property
    def is_sure(self) -> bool:
        """Whether the change is significant."""
        return self.sigma is not None and abs(self.change) > _SURE * self.sigma > 0.0


@dataclass(frozen=True)
class WorkspaceSigma:
    """Predicted sigma of the tool's position over the workspace: median, 95 % quantile [mm]."""

    median: float
    p95: float


@dataclass(frozen=True)
class WorkspacePlace:
    """Position of the flange in the base [m], and predicted sigma of the tool there [mm]."""

    x_m: float
    y_m: float
    z_m: float
    sigma_mm: float


@dataclass(frozen=True)
class JointRange:
    """Range of a joint's positions at the stops of the fit."""

    joint: str  # The joint's name.
    lower: float  # Smallest position [rad or m].
    upper: float  # Largest position [rad or m].


@dataclass(frozen=True, kw_only=True)
class Observability:
    """Observability of the arm's parameters at the stops."""

    columns: int  # Number of the fit's parameters, redundant ones included.
    identifiable: int  # Number of identifiable directions, with any stops.
    determined: int  # Number of directions that these stops determine.
    # Condition number of the scaled Jacobian; None where no direction is determined.
    condition: float | None = None
    # Geometric mean of the singular values over the root of the number of stops.
    o1: float | None = None
    o2: float | None = None  # Smallest over largest singular value.
    o3: float | None = None  # Smallest singular value.
    o4: float | None = None  # Square of the smallest over the largest singular value.
    o5: float | None = None  # Inverse of the sum of the inverse singular values.


@dataclass(frozen=True, kw_only=True)
class UnseenView:
    """Residual of a view that the fit left out, by nominal and calibrated arm."""

    view: int  # The view's number.
    nominal_mm: float  # By the nominal arm [mm].
    mm: float  # By the calibrated arm [mm].
    # Rotation by the nominal arm [deg]; None where only positions were read.
    nominal_deg: float | None = None
    # Rotation by the calibrated arm [deg]; None where only positions were read.
    deg: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmResult(Section):
    """The calibrated arm: `kinematics` in calibration.json.

    The fields after the levels are present where one other than `nominal` was chosen, `parameters`
    where that frees some.
    """

    level: str  # The chosen level; `nominal` where no level improves the fit significantly.
    levels: tuple[ArmLevel, ...]  # All fitted levels, the nominal arm first.
    robot: StoredRobot | None = None  # The calibrated arm; None at level `nominal`.
    # Backlash of each joint, where stops were approached from both sides.
    backlash: tuple[JointBacklash, ...] = ()
    convention: Convention | None = None  # Convention of the kinematic table.
    parameters: tuple[ArmParameter, ...] = ()  # The identified parameters of the table.
    # Predicted sigma of a tool's position over the workspace.
    workspace_sigma_mm: WorkspaceSigma | None = None
    workspace_map: tuple[WorkspacePlace, ...] = ()  # The same at each position.
    # The same at postures within the ranges of the joints at the stops, where the stops determine
    # more than at other postures with the same flange position.
    measured_map: tuple[WorkspacePlace, ...] = ()
    measured: tuple[JointRange, ...] = ()  # Ranges of the joints at the stops.
    observability: Observability | None = None  # Observability of the parameters at the stops.
    not_determined: tuple[str, ...] | None = None  # Undetermined directions, in words.
    # Residuals of views that were left out of the fit in turn.
    left_out: tuple[UnseenView, ...] = ()

    def __post_init__(self) -> None:
        if self.is_calibrated and self.level not in [level.level for level in self.levels]:
            raise ValueError(f"level {self.level!r} is not among the levels")

    @property
    def is_calibrated(self) -> bool:
        """Whether a level other than `nominal` was chosen."""
        return self.level != NOMINAL

    @property
    def nominal(self) -> ArmLevel:
        """The nominal arm's level."""
        return self.levels[0]

    @property
    def chosen(self) -> ArmLevel:
        """The chosen level."""
        return next(level for level in self.levels if level.level == self.level)

    @cached_property
    def map_sigmas_mm(self) -> FloatArray:
        """(k,) predicted standard deviations there [mm]."""
        return np.array([place.sigma_mm for place in self.workspace_map])


@dataclass(frozen=True, kw_only=True)
class ArmErrorsResult(Section):
    """Posture-dependent arm errors: `arm_errors` in calibration.json."""

    # Standard deviation of a link's lengths, or of the flange's position per axis [mm].
    sigma_mm: float
    sigma_deg: float  # The same of a link's angles, or of the flange's rotation per axis [deg].
    likelihood_ratio: float  # Twice the gain in log-likelihood over white noise.
    estimated: bool  # Whether they were estimated together with the transforms.
    # `flange` where joints are unknown and the sizes are those of the flange's errors, beside its
    # noise; None where they are those of links.
    of: Literal["flange"] | None = None


@dataclass(frozen=True)
class TwoSlopes:
    """Compliance of a gear that yields otherwise beyond some torque."""

    knee_nm: float  # The torque [N m].
    compliance_rad_per_nm: float  # Up to it [rad/(N m)].
    beyond_rad_per_nm: float  # Of what goes beyond it [rad/(N m)].
    sigma_rad_per_nm: float
    sigma_beyond_rad_per_nm: float


@dataclass(frozen=True, kw_only=True)
class JointSpring:
    """Compliance of a joint."""

    joint: str  # The joint's name.
    compliance_rad_per_nm: float  # Compliance, zero or more [rad/(N m)].
    # Its standard deviation; the prior's where the stops do not determine it.
    sigma_rad_per_nm: float
    determined: bool  # Whether the stops determine it; else the joint stays rigid.
    torque_nm: tuple[float, float]  # Smallest and largest torque on it at the stops [N m].
    stiffness_nm_per_rad: float | None = None  # Stiffness [N m/rad]; None where practically rigid.
    # Its standard deviation, to first order [N m/rad].
    stiffness_sigma_nm_per_rad: float | None = None
    slopes: TwoSlopes | None = None  # Where loads of several sizes show two.


@dataclass(frozen=True)
class Factor:
    """Factor with its standard deviation; it is 1 where the model is right."""

    value: float
    sigma: float

    @property
    def is_off(self) -> bool:
        """Whether it differs from 1 by more than three standard deviations."""
        return abs(self.value - 1.0) > _SURE * self.sigma


@dataclass(frozen=True)
class Sag:
    """Flange deflection under the loads of the stops: median and maximum [mm]."""

    median: float
    most: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticResult(Section):
    """Joint compliance: `elastic` in calibration.json."""

    joints: tuple[JointSpring, ...]  # One entry for each joint.
    not_determined: tuple[str, ...]  # Joints whose compliance the loads do not determine.
    # Whether the links' weight is from the model's masses, unknown, or compensated.
    weight: str
    payload_kg: tuple[float, float]  # Smallest and largest payload [kg].
    sag_mm: Sag  # Flange deflection under the loads of the stops.
    force_n: tuple[float, float] | None = None  # Smallest and largest force [N]; None for none.
    # (n, 4 n) compliance times unknown masses and first moments of links (see
    # `robot.deflected_joints`); None where the masses are known, or have little effect.
    weight_moments: Matrix | None = None
    # Ratio of the effective payload and force to the stated ones; None where there was no payload.
    payload_factor: Factor | None = None

    @property
    def most_nm(self) -> float:
        """Largest torque on any joint [N m]."""
        return max(abs(end) for joint in self.joints for end in joint.torque_nm)

    @property
    def loads_words(self) -> str:
        """The loads of the stops: `0 to 5 kg`, `10 to 50 N`, or both."""
        loads = ((self.payload_kg, "kg"), (self.force_n or (0.0, 0.0), "N"))
        words = [f"{figure(low)} to {figure(most)} {unit}" for (low, most), unit in loads if most]
        return " and ".join(words)

    @property
    def under_words(self) -> str:
        """The loads that bend the joints at the stops."""
        return (
            f"the {self.loads_words} of the stops" if self.loads_words else "the arm's own weight"
        )

    @cached_property
    def compliance(self) -> FloatArray:
        """(n,) compliance of the joints [rad/(N m)]."""
        return np.array([joint.compliance_rad_per_nm for joint in self.joints])

    @cached_property
    def sigmas(self) -> FloatArray:
        """(n,) standard deviations of these; joints not shown may be as soft as wrists are."""
        shown = [at.compliance_rad_per_nm for at in self.joints if at.stiffness_nm_per_rad]
        # Times by which a joint of an arm yields more than its stiffest: wrists have gears of a
        # third to a tenth of the size of a shoulder's.
        softest = 5.0 * min(shown, default=0.0)
        return np.array(
            [
                joint.sigma_rad_per_nm if joint.determined else max(joint.sigma_rad_per_nm, softest)
                for joint in self.joints
            ]
        )


@dataclass(frozen=True, kw_only=True)
class JointDrift:
    """Thermal drift of a joint and the link behind it."""

    joint: str  # The joint's name.
    reference_c: float  # Temperature of the calibrated arm [deg C].
    growth_per_k: float  # Relative growth of the link [1/K].
    drift_rad_per_k: float  # Drift of the joint's zero [rad/K].
    tau_s: float  # Time constant of the link's temperature [s].
    # Temperature rise over the air per squared motor current [K/A^2]; None where temperatures were
    # measured.
    gain_k_per_a2: float | None = None
    growth_sigma_per_k: float  # Standard deviation of the growth [1/K].
    drift_sigma_rad_per_k: float  # Standard deviation of the drift [rad/K].
    tau_sigma: float  # Relative standard deviation of the time constant.
    # Relative standard deviation of the gain; None where there is none.
    gain_sigma: float | None = None


@dataclass(frozen=True, kw_only=True)
class DriftResidual:
    """Residuals of the views without and with the drift model [mm]."""

    without: float
    with_drift: Annotated[float, Key("with")]


@dataclass(frozen=True)
class DriftPoint:
    """Predicted drift of the flange at a time, in one posture of the session."""

    stamp_s: float  # Time on the session's clock [s].
    drift_mm: float  # Drift of the flange [mm].
    sigma_mm: float  # Its standard deviation [mm].
    rise_k: float  # Largest rise of a link's temperature [K].


@dataclass(frozen=True)
class ViewDrift:
    """Drift of the flange at a view [mm], and the largest temperature rise of a link [K]."""

    view: int
    drift_mm: float
    rise_k: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ThermalResult(Section):
    """Thermal drift of the arm: `thermal` in calibration.json."""

    heated_by: Kind  # Whether joint temperatures or motor currents were recorded.
    joints: tuple[JointDrift, ...]  # One entry for each joint.
    # (p, p) of growth and drift of all joints, then tau, and gain where there is one.
    covariance: Covariance
    # (n + 1, 3) from each joint's frame to the next, in the earlier one [m].
    lengths_m: Annotated[FloatArray, Array((-1, 3))]
    # Coefficients that the views do not determine: they are the prior's.
    not_determined: tuple[str, ...]
    residual_mm: DriftResidual  # Residuals without and with drift.
    likelihood_ratio: float  # Twice the gain in log-likelihood over an arm without drift.
    course: tuple[DriftPoint, ...]  # Predicted drift over time.
    views: tuple[ViewDrift, ...]  # Drift at each view.

    @property
    def seen_c(self) -> tuple[float, float]:
        """Lowest and highest temperature of a link in the session [deg C]."""
        references = [joint.reference_c for joint in self.joints]
        rises = [0.0, *(point.rise_k for point in self.course)]
        return min(references) + min(rises), max(references) + max(rises)

    def model(self, robot: Robot) -> ThermalModel:
        """Thermal model of the arm; `robot` is the arm at its reference temperatures."""
        rows = self.joints
        gains = [1.0 if row.gain_k_per_a2 is None else row.gain_k_per_a2 for row in rows]
        return ThermalModel(
            robot,
            Heating(self.heated_by, np.array([row.tau_s for row in rows]), np.array(gains)),
            np.array([row.reference_c for row in rows]),
            np.array([row.growth_per_k for row in rows]),
            np.array([row.drift_rad_per_k for row in rows]),
            self.covariance,
            self.lengths_m,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmSections:
    """Sections on an arm; None where not computed."""

    arm_errors: ArmErrorsResult | None = None  # Posture-dependent errors.
    thermal: ThermalResult | None = None  # Thermal drift.
    # Kinematics, and the choice of the model's level.
    arm: Annotated[ArmResult | None, Key("kinematics")] = None
    elastic: ElasticResult | None = None  # Joint compliance.
