"""Robot arms: reported and calibrated poses, identified errors, and their effects in the fit."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages import elastic, thermal
from visioncal.calibration.stages.arm_identifiability import ArmIdentifiability, identify_arm
from visioncal.calibration.stages.arm_transfer import carries_over, functions_of
from visioncal.calibration.stages.elastic import Elastic, plays_of, springs_of
from visioncal.calibration.stages.joints import MatchedJoints
from visioncal.calibration.stages.kinematics import (
    SelectedArmLevel,
    allows_functions,
    select_errors,
)
from visioncal.calibration.stages.loads import check_elastic, check_poses
from visioncal.calibration.stages.reported_poses import move_to_arm
from visioncal.calibration.stages.thermal import Heat, drift_result, find_drift, heating
from visioncal.calibration.stages.thermal_fit import ThermalFit, ThermalStops
from visioncal.core.choices import Convention
from visioncal.core.transforms import distances, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.core.verdict import Finding
from visioncal.estimation.arm import (
    LEVER_M,
    ArmErrors,
    find_arm_errors,
    link_basis,
    pose_basis,
    rows_of,
    stops_of,
)
from visioncal.estimation.arm_sizes import most_orders
from visioncal.estimation.armmodel import RIGID, ArmModel, blocks_of
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.robot_likelihood import (
    RobotLikelihood,
    robot_likelihood,
)
from visioncal.estimation.solve import Solution
from visioncal.results.arm import (
    ArmErrorsResult,
    ArmSections,
    CarriesOver,
    JointBacklash,
    JointFunctions,
    JointRange,
    ThermalResult,
)
from visioncal.robot import Loads
from visioncal.session import Session, View
from visioncal.session.table import loads_of

# Rounding of written poses and joints [m, rad].
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class IdentifiedArm:
    """Identified properties of an arm."""

    # Identifiability of its parameters; None for a nominal arm.
    identifiability: ArmIdentifiability | None = None
    springs: Elastic | None = None  # Joint compliances; None for a rigid arm.
    # Backlash of the joints; empty where stops were not approached from both sides.
    backlash: tuple[JointBacklash, ...] = ()
    drift: ThermalResult | None = None  # Drift with temperature; None without one.
    # Where the calibrated arm beats the nominal one; None for a nominal arm.
    carries_over: CarriesOver | None = None
    functions: JointFunctions | None = None  # Joint error functions; None without any.
    measured: tuple[JointRange, ...] = ()  # Joint ranges of the stops.

    def notes(self) -> Iterator[str]:
        """Remarks that are no reason for doubt."""
        if self.carries_over is not None:
            yield self.carries_over.words
        if self.identifiability is not None and self.identifiability.advice:
            yield self.identifiability.advice
        yield from elastic.play_remarks(self.backlash)
        if self.springs is not None:
            yield from elastic.remarks(self.springs)

    def doubts(self) -> Iterator[Finding]:
        """Findings against the arm."""
        if self.springs is not None:
            yield from elastic.doubts(self.springs)


@dataclass(frozen=True, eq=False)
class RobotArm:
    """A robot's arm at the s stops of a cell."""

    robot: str  # Name of the robot in the problem.
    reported: FloatArray  # (s, 4, 4) reported `base_from_flange`; NaN where unknown.
    has_pose: Mask  # (s,) mask of the m stops with a pose of this robot.
    # (m, n) joints at these; None where they are missing or belong to no model.
    joints_rad: FloatArray | None
    loads: Loads  # Loads at these.
    # Model, matched with poses and joints; None where none is known.
    matched: MatchedJoints | None = None
    heat: Heat | None = None  # Heat inputs; None where joints are not known.
    # Thermal drift fit; None where it was not requested or is impossible.
    thermal: ThermalFit | None = None
    errors: ArmErrors | None = None  # Posture-dependent errors, where they are likely.
    # Compared levels; None where none were requested or possible.
    kinematics: SelectedArmLevel | None = None
    # Arm with the errors of the chosen level; None for a nominal arm.
    model: ArmModel | None = None

    @classmethod
    def of(
        cls,
        robot: str,
        reported: FloatArray,
        views: Sequence[View],
        matched: MatchedJoints | None,
        recorded: tuple[Session, str],
    ) -> Self:
        """Builds a nominal arm.

        Args:
            robot: Name of the robot in the problem.
            reported: (s, 4, 4) reported `base_from_flange`; NaN where unknown.
            views: The rows with its pose at the m stops where it is known.
            matched: Model, matched with poses and joints; None where none is known.
            recorded: The session, and the robot's name there.
        """
        joints = [] if matched is None else [matched.joints_rad.get(view.number) for view in views]
        q = [joint for joint in joints if joint is not None]
        has_joints, heat = 0 < len(q) == len(views), None
        if has_joints:
            stamps_s = np.array([view.stamp_s for view in views], dtype=float)
            numbers = np.array([view.number for view in views])
            heat = Heat(*recorded, len(q[0]), numbers, stamps_s)
        return cls(
            robot,
            reported,
            np.isfinite(reported[:, 0, 0]),
            np.array(q) if has_joints else None,
            loads_of(
                [view.numbers for view in views], [view.text.get("approach", "") for view in views]
            ),
            matched,
            heat,
        )

    @property
    def is_modelled(self) -> bool:
        """Whether its joints at all stops belong to a known model."""
        return self.matched is not None and self.joints_rad is not None

    @property
    def can_tilt(self) -> bool:
        """Whether the flange turns about more than one direction; True without a model."""
        return self.matched is None or self.matched.robot.can_tilt

    @property
    def function_gain(self) -> float:
        """Twice the gain in log-likelihood by joint error functions; zero without any."""
        functions = None if self.kinematics is None else self.kinematics.functions
        return 0.0 if functions is None else functions.gain

    def at(self, stops: IntArray) -> Self:
        """The arm at a subset (k,) of its stops."""
        stood = self.has_pose[stops]
        kept = (np.cumsum(self.has_pose) - 1)[stops][stood]
        joints, errors = self.joints_rad, self.errors
        return replace(
            self,
            reported=self.reported[stops],
            has_pose=stood,
            joints_rad=None if joints is None else joints[kept],
            loads=self.loads.chosen(kept),
            heat=None if self.heat is None else self.heat.at(kept),
            errors=None if errors is None else replace(errors, basis=errors.basis[stops]),
        )

    @property
    def drift(self) -> ThermalFit | None:
        """Significant drift with temperature; None without one."""
        return None if self.thermal is None or not thermal.is_found(self.thermal) else self.thermal

    @property
    def warming(self) -> ThermalStops:
        """Joints and times of the stops; a stop without a time counts as at the start."""
        if self.joints_rad is None or self.heat is None or self.thermal is None:
            raise RuntimeError("an arm drifts by its joints and what heats them")
        start_s = self.thermal.inputs.stamps_s[0]
        stamps_s = np.nan_to_num(self.heat.stamps_s, nan=start_s)
        return ThermalStops(self.robot, np.flatnonzero(self.has_pose), self.joints_rad, stamps_s)

    def with_found_errors(self, errors: ArmErrors | None) -> Self:
        """The arm with errors found at some of its stops, none of them estimated yet."""
        arm = replace(self, errors=errors, kinematics=None, model=None)
        return arm if errors is None else replace(arm, errors=replace(errors, basis=arm.basis))

    @property
    def poses(self) -> FloatArray:
        """(s, 4, 4) poses of the flange, by the calibrated arm where there is one."""
        poses = self.reported.copy()
        if self.model is not None and self.joints_rad is not None:
            poses[self.has_pose] = self.model.base_from_flange(self.joints_rad, self.loads)
        if self.drift is not None:
            poses[self.has_pose] = poses[self.has_pose] @ self.drift.motion(self.warming)
        return poses

    def has_free_errors(self, *, freely: bool = False) -> bool:
        """Whether its errors are unknowns: estimated ones, or with `freely` any that were found."""
        return self.errors is not None and (freely or self.errors.is_estimated)

    def effects(self, *, freely: bool = False) -> tuple[Effect, ...]:
        """Effects that move its flange at the stops: drift uncertainty and errors."""
        drift, found = self.drift, []
        if drift is not None:
            found.append(drift.effect(self.warming, len(self.has_pose)))
        if self.errors is not None and self.has_free_errors(freely=freely):
            values = None if self.model is None else self.model.values
            found.append(self.errors.effect(self.robot, values=values))
        return tuple(found)

    def applied_to(self, problem: Problem) -> Problem:
        """A problem with this arm's poses and effects in place of its former ones."""
        mine = {f"{name} of {self.robot}" for name in ("arm", "temperature")}
        rest = [effect for effect in problem.effects if effect.name not in mine]
        return problem.with_poses(self.robot, self.poses).with_effects([*rest, *self.effects()])

    def without_errors(self, problem: Problem) -> Problem:
        """A problem with this arm as reported, apart from its drift."""
        return self.with_found_errors(None).applied_to(problem)

    def with_drift(self, problem: Problem, start: State, asked: str) -> Self:
        """Estimates the drift with temperature, where the session determines it.

        Args:
            problem: The observations, with this arm as reported.
            start: Starting values.
            asked: A key of `stages.kinematics.ASKED`.

        Raises:
            DataError: The level requires the drift, and the session lacks its inputs.
            DegenerateError: The level requires the drift, and the temperature hardly changed.
        """
        places = stops_of(problem, self.robot)
        arm = self.at(places)
        inputs = heating(arm.heat if self.is_modelled else None, asked)
        if inputs is None or arm.heat is None or arm.joints_rad is None or self.matched is None:
            return self
        stops = ThermalStops(self.robot, places, arm.joints_rad, arm.heat.stamps_s)
        return replace(self, thermal=find_drift(problem, start, stops, inputs, self.matched.arm))

    def with_errors(self, likelihood: RobotLikelihood, robot: int) -> Self:
        """Looks for posture-dependent errors, by the likelihood at the fit with the nominal arm."""
        errors = find_arm_errors(likelihood, robot, self.basis, of_links=self.is_modelled)
        return replace(self, errors=errors)

    def with_nominal_zero(self, problem: Problem) -> Problem | None:
        """A problem with a lost joint zero set to its nominal value; None where none is lost."""
        matched, q = self.matched, self.joints_rad
        if matched is None or matched.zero is None or q is None:
            return None
        poses = problem.poses[self.robot].copy()
        poses[self.has_pose] = move_to_arm(poses[self.has_pose], q, matched.arm, matched.robot)
        return replace(problem, poses={**problem.poses, self.robot: poses})

    def reports_matching_joints(self, agrees: Mask) -> Mask:
        """Mask (s,) of stops whose reported pose matches the joints as at the inlier stops (s,).

        A wrong report says nothing against joints and cameras, but would mislead the fit.
        """
        if self.matched is None or self.joints_rad is None:
            return agrees
        nominal = self.matched.arm.base_from_flange(self.joints_rad)
        tools, inliers = invert(nominal) @ self.reported[self.has_pose], agrees[self.has_pose]
        residuals = distances(tools, mean_transform(tools[inliers]))
        matches = agrees.copy()
        matches[self.has_pose] = np.all(
            [array <= 2.0 * array[inliers].max() + _ROUNDING for array in residuals], axis=0
        )
        return matches

    def data(
        self,
        problem: Problem,
        fit: Solution,
        covariance: FloatArray,
        middles: Mapping[str, FloatArray],
    ) -> ArmData | None:
        """The observations of its errors; None for a nominal arm."""
        columns = problem.effect_columns.get(f"arm of {self.robot}")
        if self.model is None or self.errors is None or self.joints_rad is None or columns is None:
            return None
        stops, every = stops_of(problem, self.robot), np.arange(problem.size)
        rows = np.searchsorted(np.flatnonzero(self.has_pose), stops)
        pair = ArmPair.of(problem, fit.state, self.robot)
        # A single point shows no rotation; several points make a frame.
        shows_pose = bool((problem.observations.directions[pair.rows] > 3).any())
        # A point has no rotation to be determined.
        edges = problem.counted.copy()
        edges[problem.edge_columns(pair.observed)] = True
        edges[6 * len(problem.unknown) :] = False
        return ArmData(
            problem,
            fit.state,
            fit.noise,
            covariance,
            self.robot,
            self.model,
            every[columns],
            self.errors.sigma,
            stops,
            self.joints_rad[rows],
            self.loads.chosen(rows),
            middles.get(pair.observed, np.zeros(3)),
            every[edges],
            measured=np.repeat([shows_pose, True], 3),
        )

    def identified(
        self,
        problem: Problem,
        fit: Solution,
        covariance: FloatArray,
        middles: Mapping[str, FloatArray],
        convention: Convention | None = None,
    ) -> IdentifiedArm:
        """Identified properties of the arm.

        Args:
            problem: The inlier observations, with the arm's errors among the unknowns.
            fit: Their fit.
            covariance: (p, p) its covariance.
            middles: (3,) centre of each printed target by its frame, in that frame [m].
            convention: Convention of the arm's table; see `stages.arm_identifiability`.
        """
        drift = None
        if self.drift is not None and self.heat is not None:
            places = stops_of(problem, self.robot)
            arm = self.at(places)
            views = [] if arm.heat is None else arm.heat.views.tolist()
            stops = replace(arm.warming, places=places)
            drift = drift_result(self.drift, stops, views, problem, fit)
        data = self.data(problem, fit, covariance, middles)
        if data is None or self.kinematics is None:
            return IdentifiedArm(drift=drift)
        # With backlash and compliance alone the table stays nominal.
        has_rigid_errors = data.model.weights.keys() & set(RIGID)
        return IdentifiedArm(
            identify_arm(data, convention) if has_rigid_errors else None,
            springs_of(data, self.kinematics.errors),
            plays_of(data.model, data.arm_covariance),
            drift,
            carries_over(data, self.kinematics) if has_rigid_errors else None,
            functions_of(data, self.kinematics),
            tuple(
                JointRange(name, float(column.min()), float(column.max()))
                for name, column in zip(data.model.nominal.joint_names, data.q.T, strict=True)
            ),
        )

    def result(self, found: IdentifiedArm, views: Sequence[int]) -> ArmSections:
        """The arm's sections of a calibration; `views` are those of the stops."""
        sections = ArmSections(
            arm_errors=_size_of(self.errors) if self.errors and self.errors.is_likely else None,
            thermal=found.drift,
            arm=None if self.kinematics is None else self.kinematics.result,
        )
        if sections.arm is None or self.kinematics is None or self.model is None:
            return sections
        arm = replace(
            sections.arm,
            robot=self.model.robot,
            backlash=found.backlash,
            functions=found.functions,
            measured=found.measured,
        )
        if found.identifiability is not None:
            zero = None if self.matched is None else self.matched.zero
            arm = found.identifiability.add_to(arm, self.model.nominal, views, zero)
            arm = replace(arm, left_out=self.kinematics.left_out(), carries_over=found.carries_over)
        springs = None if found.springs is None else found.springs.result(views)
        return replace(sections, arm=arm, elastic=springs)

    @property
    def basis(self) -> FloatArray:
        """Jacobian (s, 6, p) of the flange by arm errors.

        The errors are those of the calibrated model, else of any link, else of the pose.
        """
        if self.matched is None or self.joints_rad is None:
            return self._by_stop(pose_basis(self.reported[self.has_pose]))
        if self.model is None:
            return self._by_stop(link_basis(self.matched.arm, self.joints_rad))
        return self._by_stop(self.model.basis(self.joints_rad, self.loads))

    @property
    def joint_offsets(self) -> FloatArray | None:
        """Jacobian (s, 6, n) of the flange by joint offsets; None without a model."""
        if self.matched is None or self.joints_rad is None:
            return None
        nominal = ArmModel.of(self.matched.arm, self.joints_rad, self.reported[self.has_pose])
        return self._block_jacobian(self.model or nominal, "offsets")

    def with_level(
        self,
        problem: Problem,
        start: State,
        asked: str,
        views: Sequence[int],
        noise: Noise,
        *,
        functions: bool = False,
    ) -> Self:
        """Selects the errors of the arm's model by the data.

        Args:
            problem: The observations, with this arm as reported.
            start: Starting values.
            asked: A key of `stages.kinematics.ASKED`.
            views: (n,) view of each observation.
            noise: Noise levels to start from.
            functions: Whether functions of the joints are among them, where stops suffice; where
                none are significant, the arm stays as it is.
        """
        used = self.at(stops_of(problem, self.robot))
        q, loads = used.joints_rad, used.loads
        if self.matched is None or self.joints_rad is None or q is None or not len(q):
            return self
        if functions and not allows_functions(asked, len(q)):
            return self
        model = ArmModel.of(self.matched.arm, q, used.reported).loaded(q, loads)
        blocks = blocks_of(model.nominal, self.loads)
        bases = {name: self._block_jacobian(model, name) for name in blocks}
        harmonics = None
        if functions:
            jacobian = model.robot.harmonic_jacobian(self.joints_rad, most_orders())
            columns = self._by_stop(jacobian.reshape(len(jacobian), 6, -1))
            harmonics = columns.reshape(len(columns), 6, model.nominal.joint_count, -1, 2)
        kinematics = select_errors(
            problem,
            start,
            self.robot,
            bases,
            model.torque_nm,
            asked,
            noise,
            harmonics,
            self.with_nominal_zero(problem),
        )
        if kinematics is None:
            return self
        mine = np.flatnonzero(rows_of(problem, self.robot)).tolist()
        arm_views = tuple(views[index] for index in mine)
        arm = replace(self, kinematics=replace(kinematics, views=arm_views))
        if kinematics.errors:
            if (found := kinematics.functions) is not None:
                model = replace(
                    model, harmonic_directions=found.directions, harmonic_sizes=found.sizes
                )
            return arm._with_model(model.with_errors(kinematics.errors))
        if self.model is None:
            return arm
        # There are fewer inliers than when it was calibrated: errors are sought at the nominal arm.
        fit = kinematics.nominal.fit
        likelihood = robot_likelihood(problem, fit.state, fit.noise)
        return replace(arm, model=None).with_errors(likelihood, problem.robots.index(self.robot))

    def _block_jacobian(self, model: ArmModel, name: str) -> FloatArray:
        """Jacobian (s, 6, p) of the flange by the errors of a block."""
        if self.joints_rad is None:
            raise RuntimeError("an arm is calibrated by its joints")
        return self._by_stop(model.columns(name, self.joints_rad, self.loads))

    def relinearised(self, problem: Problem, state: State) -> tuple[Self, float]:
        """Relinearises the calibrated arm at a fit.

        Returns:
            The arm, and the largest step of its errors [rad].
        """
        if self.model is None:
            return self, 0.0
        name = f"arm of {self.robot}"
        start = [effect.values for effect in problem.effects if effect.name == name]
        if not start:
            return self, 0.0
        step = problem.values_of(name, state) - start[0]
        return self._with_model(self.model.moved(step)), float(np.abs(step).max())

    def _with_model(self, model: ArmModel) -> Self:
        """The arm with a calibrated model, and its errors linearised there."""
        if self.kinematics is None:
            return self
        blocks = self.kinematics.errors.values()
        arm, gain = replace(self, model=model), sum(block.gain for block in blocks)
        return replace(arm, errors=ArmErrors(arm.basis, next(iter(blocks)).sigma, gain, True))

    def _by_stop(self, columns: FloatArray) -> FloatArray:
        """(m, 6, p) spread over all stops, (s, 6, p): zero where the robot has no pose."""
        scattered = np.zeros((len(self.has_pose), *columns.shape[1:]))
        scattered[self.has_pose] = columns
        return scattered


def _size_of(errors: ArmErrors) -> ArmErrorsResult:
    """Size of the errors, as a section of a calibration."""
    if errors.fit_sigmas is not None and errors.white is not None:
        sigma_rad, sigma_m = np.sqrt(np.maximum(errors.fit_sigmas**2 - errors.white**2, 0.0))
        result = ArmErrorsResult(
            sigma_mm=1e3 * float(sigma_m),
            sigma_deg=float(np.rad2deg(sigma_rad)),
            likelihood_ratio=errors.gain,
            estimated=False,
            of="flange",
        )
        if errors.far_posture_errors is None:
            return result
        (deg, mm), (predicted_deg, predicted_mm) = (
            errors.far_posture_errors * [np.rad2deg(1.0), 1e3]
        ).tolist()
        return replace(
            result,
            away_mm=mm,
            away_deg=deg,
            away_predicted_mm=predicted_mm,
            away_predicted_deg=predicted_deg,
        )
    return ArmErrorsResult(
        sigma_mm=1e3 * LEVER_M * errors.sigma,
        sigma_deg=float(np.rad2deg(errors.sigma)),
        likelihood_ratio=errors.gain,
        estimated=errors.is_estimated,
    )


def arm_effects(arms: Mapping[str, RobotArm], *, freely: bool = False) -> Iterator[Effect]:
    """The effects of all arms; see `RobotArm.effects`."""
    for arm in arms.values():
        yield from arm.effects(freely=freely)


def check_arms(arms: Mapping[str, RobotArm], asked: str) -> None:
    """Refuses loads that determine no compliance.

    Raises:
        DataError: Compliance is requested, and no load bends the joints.
        DegenerateError: Loads change while an arm stands still.
    """
    for arm in arms.values():
        check_poses(arm.loads, arm.reported[arm.has_pose])
        check_elastic(asked, None if arm.matched is None else arm.matched.robot, arm.loads)
