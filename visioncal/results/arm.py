"""Sections of a result that are of an arm: its kinematics, errors, springs and drift."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np

from visioncal.core.choices import Convention
from visioncal.core.codec import Array, Key, Matrix, Section, WrittenForm
from visioncal.core.number_format import figure, listed, percent
from visioncal.core.types import FloatArray
from visioncal.estimation.bending import Factor
from visioncal.results.edge import Covariance
from visioncal.robot import Robot
from visioncal.robot.thermal import Heating, Kind, ThermalModel

NOMINAL = "nominal"
# Departures of fewer standard deviations may be chance.
_SURE = 3.0

StoredRobot = Annotated[
    Robot, WrittenForm(lambda item: dict(item.document), lambda item, _: Robot.from_document(item))
]


@dataclass(frozen=True, kw_only=True)
class ArmLevel:
    """A level of the arm's model that was tried.

    Attributes:
        level: Its name; `nominal` is the arm as stated.
        unknowns: How many values it frees.
        rms_mm: Residual of the target's place in the fit [mm].
        rms_deg: Residual of its orientation [deg]; None where places alone were read.
        held_out_mm: Residual of the place at stops that were left out of the fit [mm].
        held_out_deg: Residual of the orientation there [deg]; None where places alone were read.
        likelihood_ratio: Twice the gain in log-likelihood over the arm as stated.
    """

    level: str
    unknowns: int
    rms_mm: float
    rms_deg: float | None = None
    held_out_mm: float
    held_out_deg: float | None = None
    likelihood_ratio: float


@dataclass(frozen=True)
class JointBacklash:
    """The play of a joint.

    Attributes:
        joint: Its name.
        deadband_rad: How far apart the joint stands when it is approached from its two sides at the
            same reading of its encoder [rad]. Negative where it alone overshoots.
        sigma_rad: Its standard deviation [rad].
    """

    joint: str
    deadband_rad: float
    sigma_rad: float

    @property
    def is_sure(self) -> bool:
        """Whether it is beyond chance."""
        return abs(self.deadband_rad) > _SURE * self.sigma_rad


@dataclass(frozen=True, kw_only=True)
class ArmParameter:
    """A number of the arm's table.

    Attributes:
        joint: The joint that it belongs to.
        name: What it is, with its unit: `theta_rad`, `a_m`; `ratio` has none.
        nominal: As stated [rad or m].
        identified: As found.
        change: The latter less the former.
        sigma: Standard deviation of the change; None where that is not known.
    """

    joint: str
    name: str
    nominal: float
    identified: float
    change: float
    sigma: float | None = None

    @property
    def is_sure(self) -> bool:
        """Whether its change is beyond chance."""
        return self.sigma is not None and abs(self.change) > _SURE * self.sigma > 0.0


@dataclass(frozen=True)
class WorkspaceSigma:
    """The predicted sigma of a tool's place over the workspace: median and 95 % quantile [mm]."""

    median: float
    p95: float


@dataclass(frozen=True)
class WorkspacePlace:
    """A place of the flange in the base [m], and the predicted sigma of what it carries [mm]."""

    x_m: float
    y_m: float
    z_m: float
    sigma_mm: float


@dataclass(frozen=True)
class JointFunction:
    """How far a joint turns beyond its offset and ratio, by its angle.

    Attributes:
        joint: Its name.
        error_mrad: At equal steps from -180 degrees on, all around [mrad].
        sigma_mrad: The standard deviation of that [mrad].
    """

    joint: str
    error_mrad: tuple[float, ...]
    sigma_mrad: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class JointFunctions:
    """Repeatable errors of the joints by their angles.

    Attributes:
        size_mrad: Their typical size [mrad].
        length_deg: Over which change of its angle a joint's error changes [deg].
        joints: Joint by joint.
    """

    size_mrad: float
    length_deg: float
    joints: tuple[JointFunction, ...]


Region = Literal["box", "ahead", "beside", "behind"]
_WHERE = {
    "box": "in the box of the stops",
    "ahead": "before the base",
    "beside": "beside the base",
    "behind": "behind the base",
}


@dataclass(frozen=True)
class CarriedRegion:
    """A part of the workspace, as the calibrated arm and the arm as stated are predicted there.

    Attributes:
        region: The box of the stops' flanges; beside it what is before, beside or behind the base,
            the stops being before it.
        sigma_mm: What the calibrated arm errs by there in another session (rms) [mm].
        nominal_mm: The same of the arm as stated [mm].
        better: Whether the former is clearly less.
    """

    region: Region
    sigma_mm: float
    nominal_mm: float
    better: bool


@dataclass(frozen=True, kw_only=True)
class CarriesOver:
    """Where a calibrated arm is better than the arm as stated.

    Attributes:
        measured_mm: What it errs by at stops that were left out of the fit (rms) [mm].
        measured_nominal_mm: The same of the arm as stated [mm].
        sigma_mm: What it is predicted to err by outside the box of the stops in another session,
            noise among it (rms over the workspace) [mm].
        nominal_mm: The same of the arm as stated [mm].
        session_mm: The share of another session in that, as it is taken of arms of this size [mm].
        better_share: In which share of the workspace it is clearly better.
        regions: Part by part.
    """

    measured_mm: float
    measured_nominal_mm: float
    sigma_mm: float
    nominal_mm: float
    session_mm: float
    better_share: float
    regions: tuple[CarriedRegion, ...]

    @property
    def words(self) -> str:
        """All this in a sentence or two."""
        worse = [_WHERE[region.region] for region in self.regions if not region.better]
        where = f"; {listed(worse)} it is not clearly better than as stated" if worse else ""
        return (
            f"Where it was measured, the calibrated arm errs by {figure(self.measured_mm)} mm (the "
            f"stated arm by {figure(self.measured_nominal_mm)} mm). Elsewhere "
            f"{figure(self.sigma_mm)} mm are predicted (the stated arm: {figure(self.nominal_mm)} "
            f"mm), {figure(self.session_mm)} mm of this for another session. The calibrated arm is "
            f"clearly better in {percent(self.better_share)} of the workspace{where}."
        )


@dataclass(frozen=True)
class JointRange:
    """Between which positions a joint stood at the stops of the fit.

    Attributes:
        joint: Its name.
        lower: The least [rad or m].
        upper: The greatest [rad or m].
    """

    joint: str
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True)
class Observability:
    """How well the stops determine the arm.

    Attributes:
        columns: How many values the fit carries, redundant ones among them.
        identifiable: How many directions any stops could determine.
        determined: How many these stops do.
        condition: The best determined over the worst, scaled; None where none is.
        o1: Geometric mean of the singular values over the root of the stops' number.
        o2: The smallest over the largest.
        o3: The smallest.
        o4: The square of the smallest over the largest.
        o5: The inverse of the sum of their inverses.
    """

    columns: int
    identifiable: int
    determined: Annotated[int, Key("told")]
    condition: float | None = None
    o1: float | None = None
    o2: float | None = None
    o3: float | None = None
    o4: float | None = None
    o5: float | None = None


@dataclass(frozen=True)
class StopInfluence:
    """A stop by its view, and by which share the mean variance would grow without it."""

    view: int
    influence: Annotated[float, Key("worth")]


@dataclass(frozen=True, kw_only=True)
class UnseenView:
    """How far a view that the fit left out is off, by the arm as stated and as calibrated.

    Attributes:
        view: Its number.
        nominal_mm: By the arm as stated [mm].
        mm: By the calibrated one [mm].
        nominal_deg: The former in rotation [deg]; None where places alone were read.
        deg: The latter in rotation [deg]; likewise.
    """

    view: int
    nominal_mm: float
    mm: float
    nominal_deg: float | None = None
    deg: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmResult(Section):
    """The calibrated arm: `kinematics` in calibration.json.

    What follows the levels is there where one was taken, and its parameters where it frees some.

    Attributes:
        level: The level that was taken; `nominal` where none explains more than chance.
        levels: All that were tried, the arm as stated first.
        robot: The calibrated arm; None where it stays as stated.
        backlash: The play of each joint, where stops were approached from both sides.
        convention: Of the table that the parameters are in.
        parameters: The table's numbers that were free.
        workspace_sigma_mm: The predicted sigma of a tool's place over the workspace.
        workspace_map: The same, place by place.
        measured_map: The same at postures within the ranges of the joints at the stops, where the
            stops determine more than at other postures of the same places.
        carries_over: Where it is better than the arm as stated.
        functions: Repeatable errors of its joints by their angles, at level `functions`.
        measured: Over which ranges of its joints it was measured.
        observability: How well the stops determine the arm.
        not_determined: What they do not determine, in words.
        stops: The stops by their influence, most first.
        left_out: Views that were left out of the fit in turn.
        holdout: Views that the session keeps from every fit.
    """

    level: str
    levels: tuple[ArmLevel, ...]
    robot: StoredRobot | None = None
    backlash: tuple[JointBacklash, ...] = ()
    convention: Convention | None = None
    parameters: tuple[ArmParameter, ...] = ()
    workspace_sigma_mm: WorkspaceSigma | None = None
    workspace_map: tuple[WorkspacePlace, ...] = ()
    measured_map: tuple[WorkspacePlace, ...] = ()
    carries_over: CarriesOver | None = None
    functions: JointFunctions | None = None
    measured: tuple[JointRange, ...] = ()
    observability: Observability | None = None
    not_determined: Annotated[tuple[str, ...] | None, Key("not_told")] = None
    stops: tuple[StopInfluence, ...] = ()
    left_out: tuple[UnseenView, ...] = ()
    holdout: tuple[UnseenView, ...] = ()

    def __post_init__(self) -> None:
        """Checks that the level that was taken is among those that were tried.

        Raises:
            ValueError: It is not.
        """
        if self.is_calibrated and self.level not in [level.level for level in self.levels]:
            raise ValueError(f"level {self.level!r} is not among the levels")

    @property
    def is_calibrated(self) -> bool:
        """Whether a level was taken."""
        return self.level != NOMINAL

    @property
    def nominal(self) -> ArmLevel:
        """The arm as stated, as a level."""
        return self.levels[0]

    @property
    def chosen(self) -> ArmLevel:
        """The level that was taken."""
        return next(level for level in self.levels if level.level == self.level)

    @cached_property
    def map_places_m(self) -> FloatArray:
        """(k, 3) places of `workspace_map` in the base [m]."""
        return np.array(
            [(place.x_m, place.y_m, place.z_m) for place in self.workspace_map]
        ).reshape(-1, 3)

    @cached_property
    def map_sigmas_mm(self) -> FloatArray:
        """(k,) predicted standard deviations there [mm]."""
        return np.array([place.sigma_mm for place in self.workspace_map])


@dataclass(frozen=True, kw_only=True)
class ArmErrorsResult(Section):
    """Errors that follow the arm's posture: `arm_errors` in calibration.json.

    Attributes:
        sigma_mm: Typical error of a link's lengths, or of the flange's place an axis [mm].
        sigma_deg: Typical error of the link's angles, or of the flange's rotation an axis [deg].
        likelihood_ratio: By how much they explain the residuals better than white noise.
        estimated: Whether they were estimated along with the transforms.
        of: The `flange` where joints are not known: by so much, beside its noise, it errs from
            posture to posture. None where the sizes are those of links.
        away_mm: What looks at postures away from the views err by, in place (rms), as parts of the
            postures that were left out in turn show it; None where that is not known [mm].
        away_deg: The same in rotation [deg].
        away_predicted_mm: What was predicted of that [mm].
        away_predicted_deg: The same in rotation [deg].
    """

    sigma_mm: float
    sigma_deg: float
    likelihood_ratio: float
    estimated: bool
    of: Literal["flange"] | None = None
    away_mm: float | None = None
    away_deg: float | None = None
    away_predicted_mm: float | None = None
    away_predicted_deg: float | None = None


@dataclass(frozen=True, kw_only=True)
class JointSpring:
    """A joint as a spring.

    Attributes:
        joint: Its name.
        compliance_rad_per_nm: Its compliance, zero or more [rad/(N m)].
        sigma_rad_per_nm: The standard deviation of that; where the stops do not determine it, that
            of springs at large.
        determined: Whether the stops determine it; others stay rigid.
        torque_nm: Least and greatest torque on it at the stops [N m].
        stiffness_nm_per_rad: Its stiffness [N m/rad]; None where it is as good as rigid.
        stiffness_sigma_nm_per_rad: The standard deviation of that, to first order [N m/rad].
    """

    joint: str
    compliance_rad_per_nm: float
    sigma_rad_per_nm: float
    determined: Annotated[bool, Key("told")]
    torque_nm: tuple[float, float]
    stiffness_nm_per_rad: float | None = None
    stiffness_sigma_nm_per_rad: float | None = None


@dataclass(frozen=True)
class Sag:
    """How far the loads of the stops move the flange: in the median and at most [mm]."""

    median: float
    most: float


@dataclass(frozen=True, kw_only=True)
class LoadedStop:
    """A stop as its load bends the arm.

    Attributes:
        view: The view that it goes by.
        payload_kg: What the flange carried [kg].
        sag_mm: How far the load moves the flange [mm].
        torque_nm: Torques on the joints [N m].
        bend_mrad: How far this stop alone shows each joint to bend [mrad], where it does.
    """

    view: int
    payload_kg: float
    sag_mm: float
    torque_nm: tuple[float, ...]
    bend_mrad: Mapping[str, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticResult(Section):
    """The joints as springs: `elastic` in calibration.json.

    Attributes:
        joints: Joint by joint.
        not_determined: The joints whose compliance the loads do not determine.
        weight: Whether the weight of the links is of the model's masses, or unknown.
        payload_kg: Least and greatest payload [kg].
        sag_mm: How far the loads of the stops move the flange.
        stops: The stops with torques and bends.
        weight_moments: (n, 4 n) compliance times unknown masses and first moments of links (see
            `robot.bent_joints`); None where the masses are known, or hardly bend the arm.
        payload_factor: By which factor payload and force bend the arm beyond what is stated; None
            where nothing hung on the flange.
    """

    joints: tuple[JointSpring, ...]
    not_determined: Annotated[tuple[str, ...], Key("not_told")]
    weight: str
    payload_kg: tuple[float, float]
    sag_mm: Sag
    stops: tuple[LoadedStop, ...]
    weight_moments: Matrix | None = None
    payload_factor: Factor | None = None

    @cached_property
    def compliance(self) -> FloatArray:
        """(n,) compliance of the joints [rad/(N m)]."""
        return np.array([joint.compliance_rad_per_nm for joint in self.joints])

    def bends(self, joint: int) -> list[tuple[float, float]]:
        """The torque [N m] on a joint and its bend [mrad], at the stops that show it."""
        name = self.joints[joint].joint
        return [
            (stop.torque_nm[joint], stop.bend_mrad[name])
            for stop in self.stops
            if name in stop.bend_mrad
        ]


@dataclass(frozen=True, kw_only=True)
class JointDrift:
    """How a joint and the link behind it follow their temperature.

    Attributes:
        joint: The joint's name.
        reference_c: Temperature at which the arm is as calibrated [deg C].
        growth_per_k: Relative growth of the link [1/K].
        drift_rad_per_k: Drift of the joint's zero [rad/K].
        tau_s: Time constant of the link's temperature [s].
        gain_k_per_a2: Rise over the air for a squared motor current [K/A^2]; None where
            temperatures were measured.
        growth_sigma_per_k: Standard deviation of the growth [1/K].
        drift_sigma_rad_per_k: Standard deviation of the drift [rad/K].
        tau_sigma: Relative standard deviation of the time constant.
        gain_sigma: Relative standard deviation of the gain; None where there is none.
    """

    joint: str
    reference_c: float
    growth_per_k: float
    drift_rad_per_k: float
    tau_s: float
    gain_k_per_a2: float | None = None
    growth_sigma_per_k: float
    drift_sigma_rad_per_k: float
    tau_sigma: float
    gain_sigma: float | None = None


@dataclass(frozen=True, kw_only=True)
class DriftResidual:
    """Residuals of the views without drift, and with it [mm]."""

    without: float
    with_drift: Annotated[float, Key("with")]


@dataclass(frozen=True)
class DriftPoint:
    """How far the flange had moved at a time, in one posture of the session.

    Attributes:
        stamp_s: The time, on the session's clock [s].
        drift_mm: How far it had moved [mm].
        sigma_mm: The standard deviation of that [mm].
        rise_k: The largest rise of a link's temperature [K].
    """

    stamp_s: float
    drift_mm: float
    sigma_mm: float
    rise_k: float


@dataclass(frozen=True)
class ObservedDrift:
    """How far a stop in that posture shows the flange to have moved [mm], and when [s]."""

    view: int
    stamp_s: float
    drift_mm: float


@dataclass(frozen=True)
class ViewDrift:
    """How far the flange had drifted at a view [mm], and the largest rise of a link [K]."""

    view: int
    drift_mm: float
    rise_k: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ThermalResult(Section):
    """The arm's drift with its temperature: `thermal` in calibration.json.

    Attributes:
        heated_by: Whether joints' temperatures or motors' currents were recorded.
        joints: Joint by joint.
        covariance: (p, p) of growth and drift of all joints, then tau, and gain where there is one.
        lengths_m: (n + 1, 3) from each joint's frame to the next, in the earlier one [m].
        not_determined: Coefficients that the views do not determine: what was known before counts.
        residual_mm: Residuals without and with drift.
        likelihood_ratio: Twice the gain in log-likelihood over an arm that does not drift.
        rises_k: (n,) range of each link's temperature over the views [K].
        trained_s: How long the views took [s].
        course: The predicted drift over time.
        seen: The drift that stops in the same posture show; None in files of earlier versions.
        views: The drift at each view.
    """

    heated_by: Kind
    joints: tuple[JointDrift, ...]
    covariance: Covariance
    lengths_m: Annotated[FloatArray, Array((-1, 3))]
    not_determined: Annotated[tuple[str, ...], Key("not_told")]
    residual_mm: DriftResidual
    likelihood_ratio: float
    rises_k: tuple[float, ...]
    trained_s: float
    course: tuple[DriftPoint, ...]
    seen: tuple[ObservedDrift, ...] | None = None
    views: tuple[ViewDrift, ...]

    def model(self, robot: Robot) -> ThermalModel:
        """The drifting arm.

        Args:
            robot: The arm at its reference temperatures.
        """
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
    """What was found of an arm; None where it was not computed.

    Attributes:
        arm_errors: Errors that follow its posture.
        thermal: Its drift with temperature.
        arm: Its kinematics, and how the level of its model was chosen.
        elastic: Its joints as springs.
    """

    arm_errors: ArmErrorsResult | None = None
    thermal: ThermalResult | None = None
    arm: Annotated[ArmResult | None, Key("kinematics")] = None
    elastic: ElasticResult | None = None
