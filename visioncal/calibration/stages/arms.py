"""Robot arms: reported and calibrated poses, identified errors, and their effects in the fit."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages import thermal
from visioncal.calibration.stages.arm_report import ArmReport, report_of
from visioncal.calibration.stages.joints import MatchedJoints
from visioncal.calibration.stages.kinematics import (
    SelectedArmLevel,
    allows_functions,
    select_errors,
)
from visioncal.calibration.stages.reported_poses import move_to_arm
from visioncal.calibration.stages.thermal import HeatedStops, ThermalFit, drift_result, find_drift
from visioncal.core.choices import Convention
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import distances, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask
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
from visioncal.estimation.armmodel import ArmModel, blocks_of
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.robot_likelihood import RobotLikelihood, robot_likelihood
from visioncal.estimation.solve import Solution
from visioncal.results.arm import ArmErrorsResult, ArmSections
from visioncal.robot import Loads
from visioncal.session import Session, View
from visioncal.session.table import loads_of

# Rounding of written poses and joints [m, rad].
_ROUNDING = 1e-5
# Stops that differ by less are at one pose: a loaded arm may deflect by so much [m, rad].
_SAME_M, _SAME_RAD = 0.02, 0.02


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
    heat: HeatedStops | None = None  # Heat inputs; None where joints are not known.
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
        known = {} if matched is None else matched.joints_rad
        joints = [known[view.number] for view in views if view.number in known]
        q, heat = None, None
        if 0 < len(joints) == len(views):
            q = np.array(joints)
            stamps_s = np.array([view.stamp_s for view in views], dtype=float)
            numbers = np.array([view.number for view in views])
            heat = HeatedStops(*recorded, q, numbers, stamps_s)
        sides = [view.text.get("approach", "") for view in views]
        loads = loads_of([view.numbers for view in views], sides)
        has_pose = np.isfinite(reported[:, 0, 0])
        return cls(robot, reported, has_pose, q, loads, matched, heat)

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
        return self.thermal if self.thermal is not None and self.thermal.is_found else None

    def with_found_errors(self, errors: ArmErrors | None) -> Self:
        """The arm with errors found at some of its stops, none of them estimated yet."""
        arm = replace(self, errors=errors, kinematics=None, model=None)
        return arm if errors is None else replace(arm, errors=replace(errors, basis=arm.basis))

    @property
    def poses(self) -> FloatArray:
        """(s, 4, 4) poses of the flange, by the calibrated arm where there is one."""
        poses, drift = self.reported.copy(), self.drift
        if self.model is not None and self.joints_rad is not None:
            poses[self.has_pose] = self.model.base_from_flange(self.joints_rad, self.loads)
        if drift is not None and self.heat is not None:
            poses[self.has_pose] = poses[self.has_pose] @ drift.motion(self.heat)
        return poses

    def has_free_errors(self, *, freely: bool = False) -> bool:
        """Whether its errors are unknowns: estimated ones, or with `freely` any that were found."""
        return self.errors is not None and (freely or self.errors.is_estimated)

    def effects(self, *, freely: bool = False) -> tuple[Effect, ...]:
        """Effects that move its flange at the stops: drift uncertainty and errors."""
        drift, found = self.drift, []
        if drift is not None and self.heat is not None:
            found.append(drift.effect(self.robot, self.heat, self.has_pose))
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
        heat = self.at(stops_of(problem, self.robot)).heat
        if heat is None or self.matched is None:
            if asked == thermal.LEVEL:
                raise thermal.missing_error()
            return self
        inputs = heat.inputs(asked)
        if inputs is None:
            return self
        drift = find_drift(problem, start, self.robot, heat, inputs, self.matched.arm)
        return replace(self, thermal=drift)

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
        return problem.with_poses(self.robot, poses)

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
        """The observations of its errors; None for a nominal arm. See `report`."""
        columns = problem.effect_columns.get(f"arm of {self.robot}")
        stops = stops_of(problem, self.robot)
        used, every = self.at(stops), np.arange(problem.size)
        if self.model is None or self.errors is None or used.joints_rad is None or columns is None:
            return None
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
            used.joints_rad,
            used.loads,
            middles.get(pair.observed, np.zeros(3)),
            every[edges],
            measured=np.repeat([shows_pose, True], 3),
        )

    def report(
        self,
        problem: Problem,
        fit: Solution,
        covariance: FloatArray,
        middles: Mapping[str, FloatArray],
        views: Mapping[int, int],
        convention: Convention | None = None,
    ) -> ArmReport:
        """What was found of the arm.

        Args:
            problem: The inlier observations, with the arm's errors among the unknowns.
            fit: Their fit.
            covariance: (p, p) its covariance.
            middles: (3,) centre of each printed target by its frame, in that frame [m].
            views: The first view of each stop.
            convention: Convention of the arm's table; see `arm_report.add_parameters`.
        """
        stops, data = stops_of(problem, self.robot), self.data(problem, fit, covariance, middles)
        seen = [views[stop] for stop in stops.tolist()]
        heat, levels, found = self.at(stops).heat, self.kinematics, ArmReport()
        sections = ArmSections(arm=None if levels is None else levels.result)
        if data is not None and levels is not None:
            zero = None if self.matched is None else self.matched.zero
            found = report_of(data, levels, seen, convention, zero)
            sections = found.sections
        if self.errors is not None and self.errors.is_likely:
            sections = replace(sections, arm_errors=_size_of(self.errors))
        if self.drift is not None and heat is not None:
            drift = drift_result(self.drift, self.robot, heat, problem, fit)
            sections = replace(sections, thermal=drift)
        return replace(found, sections=sections)

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
        model = self.model or nominal
        return self._by_stop(model.columns("offsets", self.joints_rad, self.loads))

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
        q, every = used.joints_rad, self.joints_rad
        if self.matched is None or q is None or every is None or not len(q):
            return self
        if functions and not allows_functions(asked, len(q)):
            return self
        model = ArmModel.of(self.matched.arm, q, used.reported).loaded(q, used.loads)
        bases = {
            name: self._by_stop(model.columns(name, every, self.loads))
            for name in blocks_of(model.nominal, self.loads)
        }
        harmonics = model.robot.harmonic_jacobian(every, most_orders()) if functions else None
        mine = np.flatnonzero(rows_of(problem, self.robot)).tolist()
        kinematics = select_errors(
            problem,
            start,
            self.robot,
            bases,
            model.torque_nm,
            asked,
            noise,
            None if harmonics is None else self._by_stop(harmonics),
            self.with_nominal_zero(problem),
            tuple(views[index] for index in mine),
        )
        if kinematics is None:
            return self
        arm = replace(self, kinematics=kinematics)
        if kinematics.errors:
            return arm._with_model(model.with_errors(kinematics.errors, kinematics.functions))
        if self.model is None:
            return arm
        # There are fewer inliers than when it was calibrated: errors are sought at the nominal arm.
        fit = kinematics.nominal.fit
        likelihood = robot_likelihood(problem, fit.state, fit.noise)
        return replace(arm, model=None).with_errors(likelihood, problem.robots.index(self.robot))

    def relinearised(self, problem: Problem, state: State) -> tuple[Self, float]:
        """Relinearises the calibrated arm at a fit.

        Returns:
            The arm, and the largest step of its errors [rad].
        """
        name = f"arm of {self.robot}"
        start = [effect.values for effect in problem.effects if effect.name == name]
        if self.model is None or not start:
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
    units, sigmas = np.array([np.rad2deg(1.0), 1e3]), errors.sigma * np.array([1.0, LEVER_M])
    is_of_flange = errors.fit_sigmas is not None and errors.white is not None
    if errors.fit_sigmas is not None and errors.white is not None:
        sigmas = np.sqrt(np.maximum(errors.fit_sigmas**2 - errors.white**2, 0.0))
    deg, mm = (sigmas * units).tolist()
    return ArmErrorsResult(
        sigma_mm=mm,
        sigma_deg=deg,
        likelihood_ratio=errors.gain,
        estimated=errors.is_estimated,
        of="flange" if is_of_flange else None,
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
        kg, force_n = arm.loads.payload_kg, np.linalg.norm(arm.loads.force_n, axis=1)
        poses, robot = arm.reported[arm.has_pose], arm.matched.robot if arm.matched else None
        if len(poses) > 1 and (np.ptp(kg) > 0.0 or np.ptp(force_n) > 0.0):
            shift, angle = distances(poses, poses[0])
            if shift.max() <= _SAME_M and angle.max() <= _SAME_RAD:
                by_mass = bool(np.ptp(kg))
                changed = (
                    f"{kg.min():g} to {kg.max():g} kg" if by_mass else f"0 to {force_n.max():g} N"
                )
                raise DegenerateError(
                    f"the load changes ({changed}), and all {len(poses)} views are of one pose of "
                    "the arm: where the frames are cannot be separated from how far the joints "
                    "bend.",
                    culprits=["payload_kg" if by_mass else "force_x_n"],
                    next_step="Take the same loads to other poses, all over the workspace: ten or "
                    "more.",
                )
        if asked == "elastic" and robot and robot.masses is None and not arm.loads.any:
            raise DataError(
                f"level 'elastic' needs to know what bends the arm: the model of {robot.name} does "
                "not state the masses of its links, and no view has a payload_kg or a force.",
                culprits=["level", robot.name],
                next_step="Add mass_kg and com_m to each [[joint]] of its table, take its URDF, or "
                "record payload_kg (with payload_x_m, payload_y_m, payload_z_m) with every view.",
            )
