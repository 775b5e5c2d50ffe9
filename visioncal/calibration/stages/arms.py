"""Robot arms: reported and calibrated poses, identified errors, and their effects in the fit."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from visioncal.calibration.stages.arm_report import ArmReport, report_of
from visioncal.calibration.stages.joints import MatchedJoints
from visioncal.calibration.stages.kinematics import (
    ASKED,
    LevelFit,
    SelectedArmLevel,
    select_errors,
)
from visioncal.calibration.stages.thermal import (
    HeatedStops,
    ThermalFit,
    drift_result,
    find_drift,
    missing_error,
)
from visioncal.core.choices import Convention
from visioncal.core.errors import DataError
from visioncal.core.transforms import LEVER_M, distances, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.arm import arm_effect, find_arm_errors, rows_of, stops_of
from visioncal.estimation.arm_sizes import most_orders
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.fit import Fit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.robot_likelihood import RobotLikelihood, robot_likelihood
from visioncal.estimation.unknowns import ARM, EDGE
from visioncal.model.arm import sides_of_motion
from visioncal.results.arm import ArmErrorsResult, ArmSections
from visioncal.robot import Loads, Robot
from visioncal.robot.arm_model import HARMONICS, ArmModel, blocks_of
from visioncal.robot.errors import ArmErrors, link_basis, pose_basis
from visioncal.session import Session, View
from visioncal.session.table import loads_of


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

        `views` are the rows at the m stops with a pose, `recorded` the session and the robot's name
        there.
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
    def with_sides(self) -> Self:
        """The arm with the side of each joint's last motion, where none of approach is stated."""
        if self.joints_rad is None or self.loads.side.any():
            return self
        return replace(self, loads=replace(self.loads, side=sides_of_motion(self.joints_rad)))

    @property
    def is_modelled(self) -> bool:
        """Whether its joints at all stops belong to a known model."""
        return self.matched is not None and self.joints_rad is not None

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

    @property
    def as_reported(self) -> Self:
        """The arm as it reports itself, apart from its drift."""
        return replace(self, errors=None, kinematics=None, model=None)

    @property
    def poses(self) -> FloatArray:
        """(s, 4, 4) poses of the flange, by the calibrated arm where there is one."""
        poses, drift = self.reported.copy(), self.drift
        if self.model is not None and self.joints_rad is not None:
            poses[self.has_pose] = self.model.base_from_flange(self.joints_rad, self.loads)
        if drift is not None and self.heat is not None:
            poses[self.has_pose] = poses[self.has_pose] @ drift.motion(self.heat)
        return poses

    @property
    def has_free_errors(self) -> bool:
        """Whether its errors are unknowns of the fit."""
        return self.errors is not None and self.errors.is_estimated

    def effects(self) -> tuple[Effect, ...]:
        """Effects that move its flange at the stops: drift uncertainty and errors."""
        drift, found = self.drift, []
        if drift is not None and self.heat is not None:
            found.append(drift.effect(self.robot, self.heat, self.has_pose))
        if self.errors is not None and self.errors.is_estimated:
            values = None if self.model is None else self.model.values
            found.append(arm_effect(self.errors, self.robot, values=values))
        return tuple(found)

    def applied_to(self, problem: Problem) -> Problem:
        """A problem with this arm's poses and effects in place of its former ones."""
        effect_names = {f"{name} of {self.robot}" for name in ("arm", "temperature")}
        rest = [effect for effect in problem.effects if effect.name not in effect_names]
        return problem.with_poses(self.robot, self.poses).with_effects([*rest, *self.effects()])

    def without_errors(self, problem: Problem) -> Problem:
        """A problem with this arm as it reports itself."""
        return self.as_reported.applied_to(problem)

    def with_drift(self, problem: Problem, start: State) -> Self:
        """Estimates the drift with temperature; the problem has this arm as reported.

        Raises:
            DataError: The session lacks its inputs.
            DegenerateError: The temperature hardly changed.
        """
        heat = self.at(stops_of(problem, self.robot)).heat
        if heat is None or self.matched is None:
            raise missing_error()
        drift = find_drift(problem, start, self.robot, heat, heat.inputs(), self.matched.robot)
        return replace(self, thermal=drift)

    def with_errors(self, likelihood: RobotLikelihood, robot: int) -> Self:
        """Looks for errors of its links, by the likelihood at the fit with the nominal arm."""
        errors = find_arm_errors(likelihood, robot, self.basis) if self.is_modelled else None
        return replace(self, errors=errors)

    def reports_matching_joints(self, agrees: Mask) -> Mask:
        """Mask (s,) of stops whose reported pose matches the joints as at the inlier stops (s,).

        A wrong report says nothing against joints and cameras, but would mislead the fit.
        """
        if self.matched is None or self.joints_rad is None:
            return agrees
        nominal = self.matched.robot.base_from_flange(self.joints_rad)
        tools, inliers = invert(nominal) @ self.reported[self.has_pose], agrees[self.has_pose]
        residuals = distances(tools, mean_transform(tools[inliers]))
        matches = agrees.copy()
        # Rounding of written poses and joints [m, rad].
        matches[self.has_pose] = np.all(
            [array <= 2.0 * array[inliers].max() + 1e-5 for array in residuals], axis=0
        )
        return matches

    def data(self, fit: Fit, middles: Mapping[str, FloatArray]) -> ArmData | None:
        """The observations of its errors; None for a nominal arm. See `report`."""
        problem = fit.problem
        stops = stops_of(problem, self.robot)
        used, columns = self.at(stops), fit.unknowns.columns((ARM, self.robot))
        if self.model is None or self.errors is None or used.joints_rad is None or not len(columns):
            return None
        pair = ArmPair.of(problem, fit.state, self.robot)
        # A single point shows no rotation; several points make a frame.
        shows_pose = bool((problem.observations.directions[pair.rows] > 3).any())
        # A point has no rotation to be determined.
        edges = problem.counted.copy()
        edges[fit.unknowns[EDGE, pair.observed]] = True
        edges[6 * len(problem.unknown) :] = False
        return ArmData(
            fit,
            self.robot,
            self.model,
            self.errors.sigma,
            stops,
            used.joints_rad,
            used.loads,
            middles.get(pair.observed, np.zeros(3)),
            np.flatnonzero(edges),
            np.repeat([shows_pose, True], 3),
        )

    def report(
        self, fit: Fit, middles: Mapping[str, FloatArray], convention: Convention | None = None
    ) -> ArmReport:
        """Findings about the arm.

        Args:
            fit: The fit of a cell, with the arm's errors among the unknowns.
            middles: (3,) centre of each printed target by its frame, in that frame [m].
            convention: Convention of the arm's table; see `arm_report.add_parameters`.
        """
        stops, data = stops_of(fit.problem, self.robot), self.data(fit, middles)
        heat, levels, found = self.at(stops).heat, self.kinematics, ArmReport()
        sections = ArmSections(arm=None if levels is None else levels.result)
        if data is not None and levels is not None:
            found = report_of(data, levels, convention)
            sections = found.sections
        if self.errors is not None and self.errors.is_likely:
            sections = replace(sections, arm_errors=_size_of(self.errors))
        if self.drift is not None and heat is not None:
            drift = drift_result(self.drift, heat)
            sections = replace(sections, thermal=drift)
        return replace(found, sections=sections)

    @property
    def basis(self) -> FloatArray:
        """Jacobian (s, 6, p) of the flange by arm errors.

        The errors are those of the calibrated model, else of any link, else of the pose.
        """
        if self.matched is None or self.joints_rad is None:
            return self.by_stop(pose_basis(self.reported[self.has_pose]))
        if self.model is None:
            return self.by_stop(link_basis(self.matched.robot, self.joints_rad))
        return self.by_stop(self.model.basis(self.joints_rad, self.loads))

    @property
    def joint_offsets(self) -> FloatArray | None:
        """Jacobian (s, 6, n) of the flange by joint offsets; None without a model."""
        if self.matched is None or self.joints_rad is None:
            return None
        nominal = ArmModel.of(self.matched.robot, self.joints_rad, self.reported[self.has_pose])
        model = self.model or nominal
        return self.by_stop(model.columns("offsets", self.joints_rad, self.loads))

    def with_level(
        self,
        problem: Problem,
        start: State,
        level: str,
        views: Sequence[int],
        noise: Noise,
        *,
        functions: bool = False,
        nominal: LevelFit | None = None,
    ) -> Self:
        """Selects the errors of the arm's model by the data; see `select_errors`.

        The problem has this arm as reported; `views` has the view of each observation. With
        `functions` those of the joints are among them; where none are significant, the arm stays.
        `nominal` is the fit of the nominal arm, where it is known.
        """
        used = self.at(stops_of(problem, self.robot))
        q, every = used.joints_rad, self.joints_rad
        if self.matched is None or q is None or every is None or not len(q):
            return self
        # Fewest stops for functions of the joints.
        if functions and (HARMONICS not in ASKED[level] or len(q) < 20):
            return self
        found_levels = []
        for robot in self._hypotheses(used.loads):
            model = ArmModel.of(robot, q, used.reported).loaded(q, used.loads)
            bases = {
                name: self.by_stop(model.columns(name, every, self.loads))
                for name in blocks_of(model.nominal, self.loads)
            }
            harmonics = model.robot.harmonic_jacobian(every, most_orders()) if functions else None
            waves = None if harmonics is None else self.by_stop(harmonics)
            kinematics = select_errors(
                problem, start, self.robot, bases, model.torque_nm, level, noise, waves, nominal
            )
            if kinematics is not None:
                found_levels.append((kinematics, model))
                nominal = kinematics.nominal
        if not found_levels:
            return self
        kinematics, model = max(found_levels, key=lambda pair: pair[0].fit.gain)
        arm_rows = np.flatnonzero(rows_of(problem, self.robot)).tolist()
        kinematics = replace(kinematics, views=tuple(views[index] for index in arm_rows))
        arm = replace(self, kinematics=kinematics)
        if found := kinematics.fit.errors:
            return arm._with_model(model.with_errors(found, kinematics.fit.functions))
        if self.model is None:
            return arm
        # There are fewer inliers than when it was calibrated: errors are sought at the nominal arm.
        fit = kinematics.nominal.fit
        likelihood = robot_likelihood(problem, fit.state, fit.noise)
        return replace(arm, model=None).with_errors(likelihood, problem.robots.index(self.robot))

    def _hypotheses(self, loads: Loads) -> Iterator[Robot]:
        """The arm as stated; where loads could show it, also with its weight compensated."""
        if self.matched is None:
            return
        # Of functions of the joints only that arm is tried which the loads have shown.
        shown = None if self.model is None else self.model.nominal.weight_compensated
        stated = self.matched.robot
        is_testable = stated.masses is not None and loads.any and not stated.weight_compensated
        if not (shown and is_testable):
            yield stated
        if shown is not False and is_testable:
            yield stated.with_weight_compensated

    def relinearised(self, fit: Fit) -> tuple[Self, float]:
        """Relinearises the calibrated arm at a fit.

        Returns:
            The arm, and the largest step of its errors [rad].
        """
        step = fit.values((ARM, self.robot))
        if self.model is None or not len(step):
            return self, 0.0
        return self._with_model(self.model.moved(step)), float(np.abs(step).max())

    def _with_model(self, model: ArmModel) -> Self:
        """The arm with a calibrated model, and its errors linearised there."""
        if self.kinematics is None:
            return self
        arm, first = replace(self, model=model), next(iter(self.kinematics.fit.errors.values()))
        return replace(arm, errors=replace(first, basis=arm.basis))

    def by_stop(self, columns: FloatArray) -> FloatArray:
        """(m, ...) rows of posed stops, spread over all s stops: zero where it has no pose."""
        scattered = np.zeros((len(self.has_pose), *columns.shape[1:]))
        scattered[self.has_pose] = columns
        return scattered


def _size_of(errors: ArmErrors) -> ArmErrorsResult:
    """Size of the errors, as a section of a calibration."""
    of: Literal["flange"] | None = None
    sigmas = errors.sigma * np.array([1.0, LEVER_M])
    if errors.fit_sigmas is not None and errors.white is not None:
        of, sigmas = "flange", np.sqrt(np.maximum(errors.fit_sigmas**2 - errors.white**2, 0.0))
    return ArmErrorsResult(
        sigma_mm=1e3 * float(sigmas[1]),
        sigma_deg=float(np.rad2deg(sigmas[0])),
        likelihood_ratio=errors.gain,
        estimated=errors.is_estimated,
        of=of,
    )


def arm_effects(arms: Mapping[str, RobotArm]) -> Iterator[Effect]:
    """The effects of all arms; see `RobotArm.effects`."""
    for arm in arms.values():
        yield from arm.effects()


def with_link_errors(arms: Mapping[str, RobotArm], fit: Fit) -> dict[str, RobotArm]:
    """Looks for errors of the links of the arms whose errors are not free yet."""
    likelihood = robot_likelihood(fit.problem, fit.state, fit.noise)
    return {
        name: arm
        if arm.has_free_errors
        else arm.with_errors(likelihood, fit.problem.robots.index(name))
        for name, arm in arms.items()
    }


def check_arms(arms: Mapping[str, RobotArm], level: str) -> None:
    """Refuses a level that the loads cannot give.

    Raises:
        DataError: Compliance is requested, and no load bends the joints.
    """
    for arm in arms.values():
        robot = arm.matched.robot if arm.matched else None
        if level == "elastic" and robot and robot.masses is None and not arm.loads.any:
            raise DataError(
                f"level 'elastic' needs to know what bends the arm: the model of {robot.name} does "
                "not state the masses of its links, and no view has a payload_kg or a force.",
                culprits=["level", robot.name],
                next_step="Add mass_kg and com_m to each [[joint]] of its table, take its URDF, or "
                "record payload_kg (with payload_x_m, payload_y_m, payload_z_m) with every view.",
            )
