"""Robot arms: reported and calibrated poses, identified errors, and their effects in the fit."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from visioncal.calibration.stages.joints import MatchedJoints
from visioncal.core.limits import DETERMINED
from visioncal.core.transforms import distances, exp, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows
from visioncal.estimation.arm import arm_effect, find_arm_errors, stops_of
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.fit import Fit
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.robot_likelihood import RobotLikelihood
from visioncal.estimation.unknowns import ARM
from visioncal.model import Moments
from visioncal.model.arm import even_progress, sides_of_motion
from visioncal.model.effects.heat import Heat
from visioncal.model.heating import recorded_inputs
from visioncal.results.arm import ArmResult
from visioncal.robot import Loads, Robot
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import SIGNIFICANT, ArmErrors, link_basis
from visioncal.robot.thermal import Inputs, ThermalModel
from visioncal.session import Session, View
from visioncal.session.table import loads_of


@dataclass(frozen=True, eq=False)
class Drift:
    """An arm's drift with its temperature."""

    heat: Heat  # The effect on the robot's flange.
    values: FloatArray  # (p,) its values.
    covariance: FloatArray  # (p, p) of these; that of their prior is the identity.
    gain: float = 0.0  # Twice the gain in log-likelihood over an arm without drift.
    before_m: float = 0.0  # Residual of the views without drift, as a root mean square [m].
    after_m: float = 0.0  # The same with drift [m].
    rise_k: float = 0.0  # Largest range of a link's temperature over the views [K].

    @classmethod
    def expected(cls, heat: Heat) -> Self:
        """The prior of an effect."""
        return cls(heat, np.zeros(heat.count), np.eye(heat.count))

    @property
    def is_found(self) -> bool:
        """Whether drift explains the views significantly."""
        return self.gain > SIGNIFICANT

    @cached_property
    def model(self) -> ThermalModel:
        """The arm with its coefficients and their covariance."""
        scale = self.heat.sigmas
        covariance = self.covariance * np.outer(scale, scale)
        return replace(self.heat.arm(self.values), covariance=covariance)

    @property
    def not_determined(self) -> tuple[str, ...]:
        """The parameters that stay at their prior, by joint."""
        kinds = ("growth", "drift", "tau", "gain")
        names = [f"{kind} of {joint}" for kind in kinds for joint in self.model.robot.joint_names]
        pairs = zip(names, np.sqrt(np.diag(self.covariance)).tolist(), strict=False)
        return tuple(name for name, share in pairs if share > DETERMINED)

    def motion(self, moments: Moments) -> FloatArray:
        """(k, 4, 4) drift of the flange at some moments, in its own frame."""
        return exp(self.heat.twists(moments, self.values))

    def effect(self, moments: Moments, *, is_held: bool = True) -> Effect:
        """The parameters as an effect on the stops of a problem, which are the moments.

        Held values are at zero and count in the covariance with their prior: the information of the
        stops is in the problem itself.
        """
        robot, size = self.heat.frame, self.heat.count
        values, prior = np.zeros(size), PriorInformation(np.eye(size), self.values)
        jacobian = {robot: self.heat.slopes(moments, self.values)}
        values = values if is_held else self.values
        held = np.full(size, is_held)
        return Effect(f"temperature of {robot}", values, prior, held, flange_jacobian=jacobian)


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot's arm at the s stops of a cell."""

    robot: str  # Name of the robot in the problem.
    reported: FloatArray  # (s, 4, 4) reported `base_from_flange`; NaN where unknown.
    views: IntArray  # (s,) a view of each stop; -1 where it has no pose.
    stamps_s: FloatArray  # (s,) when that was taken [s]; NaN where unknown.
    loads: Loads  # Loads at the stops.
    # (s, n) joints there; None where they are missing at a pose or belong to no model.
    joints_rad: FloatArray | None
    # Model, its base in the frame of the poses; None where none is known.
    nominal: Robot | None = None
    inputs: Inputs | None = None  # Its heat sources; None where none are known, or no joints.
    # Thermal drift fit; None where it was not requested or is impossible.
    thermal: Drift | None = None
    errors: ArmErrors | None = None  # Posture-dependent errors, where they are likely.
    # Compared levels; None where none were requested or possible.
    kinematics: ArmResult | None = None
    # Arm with the errors of the chosen level; None for a nominal arm.
    model: ArmModel | None = None

    @classmethod
    def of(
        cls,
        robot: str,
        reported: FloatArray,
        views: Sequence[View | None],
        matched: MatchedJoints | None,
        recorded: tuple[Session, str],
    ) -> Self:
        """Builds a nominal arm.

        `views` are the rows at the stops, None where it has no pose; `recorded` is the session and
        the robot's name there.
        """
        known = {} if matched is None else matched.joints_rad
        posed = [view for view in views if view is not None]
        nominal, joints, inputs = None if matched is None else matched.robot, None, None
        if nominal is not None and posed and all(view.number in known for view in posed):
            none, (session, name) = np.zeros(nominal.joint_count), recorded
            joints = np.array([none if view is None else known[view.number] for view in views])
            inputs = recorded_inputs(session, nominal.joint_count, name)
        sides = ["" if view is None else view.text.get("approach", "") for view in views]
        return cls(
            robot,
            reported,
            np.array([-1 if view is None else view.number for view in views]),
            np.array([None if view is None else view.stamp_s for view in views], dtype=float),
            loads_of([{} if view is None else view.numbers for view in views], sides),
            joints,
            nominal,
            inputs,
        )

    @property
    def has_pose(self) -> Mask:
        """(s,) mask of the stops with a pose of this robot."""
        return np.isfinite(self.reported[:, 0, 0])

    @property
    def with_sides(self) -> Self:
        """The arm with the side of each joint's last motion, where none of approach is stated."""
        if self.joints_rad is None or self.loads.side.any():
            return self
        sides = np.zeros_like(self.joints_rad)
        sides[self.has_pose] = sides_of_motion(self.joints_rad[self.has_pose])
        return replace(self, loads=replace(self.loads, side=sides))

    @property
    def is_modelled(self) -> bool:
        """Whether its joints at all stops belong to a known model."""
        return self.joints_rad is not None

    @property
    def moments(self) -> Moments:
        """The stops as moments; those without a time are as at the start of its heat sources."""
        poses = np.where(self.has_pose[:, None, None], self.reported, np.eye(4))
        joints = {} if self.joints_rad is None else {self.robot: self.joints_rad}
        count, stamps_s = len(poses), self.stamps_s
        if self.inputs is not None:
            stamps_s = np.nan_to_num(stamps_s, nan=self.inputs.stamps_s[0])
        progress, stops = even_progress(count), np.arange(count)
        return Moments({self.robot: poses}, joints, progress, stops, stamps_s=stamps_s)

    def at(self, stops: IntArray) -> Self:
        """The arm at a subset (k,) of its stops."""
        errors = self.errors
        return replace(
            chosen_rows(self, stops),
            loads=self.loads.chosen(stops),
            errors=None if errors is None else replace(errors, basis=errors.basis[stops]),
        )

    @property
    def drift(self) -> Drift | None:
        """Significant drift with temperature; None without one."""
        return self.thermal if self.thermal is not None and self.thermal.is_found else None

    @property
    def as_reported(self) -> Self:
        """The arm as it reports itself, apart from its drift."""
        return replace(self, errors=None, kinematics=None, model=None)

    @property
    def poses(self) -> FloatArray:
        """(s, 4, 4) poses of the flange, by the calibrated arm where there is one."""
        poses = self.reported
        if self.model is not None and self.joints_rad is not None:
            poses = self.model.base_from_flange(self.joints_rad, self.loads)
        if self.drift is not None:
            poses = poses @ self.drift.motion(self.moments)
        return np.where(self.has_pose[:, None, None], poses, self.reported)

    @property
    def has_free_errors(self) -> bool:
        """Whether its errors are unknowns of the fit."""
        return self.errors is not None and self.errors.is_estimated

    def effects(self) -> Iterator[Effect]:
        """Effects that move its flange at the stops: drift uncertainty and errors."""
        if self.drift is not None:
            yield self.drift.effect(self.moments)
        if self.errors is not None and self.errors.is_estimated:
            values = None if self.model is None else self.model.values
            yield arm_effect(self.errors, self.robot, values=values)

    def applied_to(self, problem: Problem) -> Problem:
        """A problem with this arm's poses and effects in place of its former ones."""
        effect_names = {f"{name} of {self.robot}" for name in ("arm", "temperature")}
        rest = [effect for effect in problem.effects if effect.name not in effect_names]
        return problem.with_poses(self.robot, self.poses).with_effects([*rest, *self.effects()])

    def without_errors(self, problem: Problem) -> Problem:
        """A problem with this arm as it reports itself."""
        return self.as_reported.applied_to(problem)

    def with_errors(self, likelihood: RobotLikelihood, robot: int) -> Self:
        """Looks for errors of its links, by the likelihood at the fit with the nominal arm."""
        errors = find_arm_errors(likelihood, robot, self.basis) if self.is_modelled else None
        return replace(self, errors=errors)

    def reports_matching_joints(self, agrees: Mask) -> Mask:
        """Mask (s,) of stops whose reported pose matches the joints as at the inlier stops (s,).

        A wrong report says nothing against joints and cameras, but would mislead the fit.
        """
        if self.nominal is None or self.joints_rad is None:
            return agrees
        poses = self.nominal.base_from_flange(self.joints_rad[self.has_pose])
        tools, inliers = invert(poses) @ self.reported[self.has_pose], agrees[self.has_pose]
        residuals = distances(tools, mean_transform(tools[inliers]))
        matches = agrees.copy()
        # Rounding of written poses and joints [m, rad].
        matches[self.has_pose] = np.all(
            [array <= 2.0 * array[inliers].max() + 1e-5 for array in residuals], axis=0
        )
        return matches

    def data(self, fit: Fit, middles: Mapping[str, FloatArray]) -> ArmData | None:
        """The observations of its errors; None for a nominal arm. See `arm_report.report_of`."""
        used = self.at(stops_of(fit.problem, self.robot))
        is_fitted = self.robot in fit.unknowns.of(ARM)
        if self.model is None or used.joints_rad is None or not is_fitted:
            return None
        return ArmData(fit, self.robot, self.model, used.joints_rad, used.loads, middles)

    @property
    def basis(self) -> FloatArray:
        """Jacobian (s, 6, p) of the flange by errors of the calibrated model, else of any link."""
        if self.nominal is None or self.joints_rad is None:
            raise RuntimeError(f"the joints of {self.robot} are not known")
        if self.model is None:
            return link_basis(self.nominal, self.joints_rad)
        return self.model.basis(self.joints_rad, self.loads)

    @property
    def joint_offsets(self) -> FloatArray | None:
        """Jacobian (s, 6, n) of the flange by joint offsets; None without a model."""
        if self.nominal is None or self.joints_rad is None:
            return None
        posed = self.has_pose
        nominal = ArmModel.of(self.nominal, self.joints_rad[posed], self.reported[posed])
        model = self.model or nominal
        return model.columns("offsets", self.joints_rad, self.loads)

    def relinearised(self, fit: Fit) -> tuple[Self, float]:
        """Relinearises the calibrated arm at a fit.

        Returns:
            The arm, and the largest step of its errors [rad].
        """
        step = fit.values((ARM, self.robot))
        if self.model is None or not len(step):
            return self, 0.0
        return self.with_model(self.model.moved(step)), float(np.abs(step).max())

    def with_model(self, model: ArmModel) -> Self:
        """The arm with a calibrated model, and its errors linearised there."""
        if self.kinematics is None:
            return self
        arm, gain = replace(self, model=model), self.kinematics.chosen.likelihood_ratio
        errors = ArmErrors(arm.basis, model.error_rad, gain, of_links=True)
        return replace(arm, errors=errors)
