"""The robots' arms: where each stood, which of its errors show, and how they are unknowns."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages import elastic, thermal
from visioncal.calibration.stages.arm_identifiability import ArmIdentifiability, identify_arm
from visioncal.calibration.stages.carrying import carries_over, functions_of
from visioncal.calibration.stages.elastic import Elastic, plays_of, springs_of
from visioncal.calibration.stages.joints import Matched
from visioncal.calibration.stages.kinematics import (
    Kinematics,
    allows_functions,
    choose_level,
    with_functions,
)
from visioncal.calibration.stages.loads import check_elastic, check_poses
from visioncal.calibration.stages.reported_poses import moved_arm
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
from visioncal.estimation.armmodel import RIGID, ArmModel, blocks_of
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import RobotLikelihood, Solution, robot_likelihood
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
from visioncal.session.loads import loads_of

# Poses and joints are written with so many digits [m, rad].
_ROUNDED = 1e-5


@dataclass(frozen=True, eq=False)
class ArmFound:
    """What the stops determine of an arm.

    Attributes:
        numbers: Identifiability of its parameters; None where it stands as stated.
        springs: Of its joints as springs; None for a rigid one.
        plays: Of the play in its joints; empty where stops did not come from both sides.
        drift: Its drift with temperature; None for none.
        carries: Where it is better than as stated; None where it stands as stated.
        functions: Of its joints; None without any.
        measured: Over which ranges of its joints that is.
    """

    numbers: ArmIdentifiability | None = None
    springs: Elastic | None = None
    plays: tuple[JointBacklash, ...] = ()
    drift: ThermalResult | None = None
    carries: CarriesOver | None = None
    functions: JointFunctions | None = None
    measured: tuple[JointRange, ...] = ()

    def notes(self) -> Iterator[str]:
        """Words what is no reason for doubt."""
        if self.carries is not None:
            yield self.carries.words
        if self.numbers is not None and self.numbers.advice:
            yield self.numbers.advice
        yield from elastic.play_remarks(self.plays)
        if self.springs is not None:
            yield from elastic.remarks(self.springs)

    def doubts(self) -> Iterator[Finding]:
        """Words what speaks against it."""
        if self.springs is not None:
            yield from elastic.doubts(self.springs)


@dataclass(frozen=True, eq=False)
class RobotArm:
    """A robot's arm at the s stops of a cell.

    Attributes:
        robot: The robot, as the problem has it.
        reported: (s, 4, 4) `base_from_flange` as it was reported; not a number where unknown.
        stood: (s,) the m stops at which it was.
        joints_rad: (m, n) its joints there; None where they are missing or belong to no model.
        loads: What it carried there.
        matched: Its model, beside poses and joints; None where none is known.
        heat: What heats it; None where its joints are not known.
        thermal: How it drifts with that; None where that was not asked or cannot be.
        errors: Errors that follow its posture, where they are likely.
        kinematics: Which levels were compared; None where that was not asked or cannot be.
        model: The arm with the errors of the level that was taken; None where it stays as stated.
    """

    robot: str
    reported: FloatArray
    stood: Mask
    joints_rad: FloatArray | None
    loads: Loads
    matched: Matched | None = None
    heat: Heat | None = None
    thermal: ThermalFit | None = None
    errors: ArmErrors | None = None
    kinematics: Kinematics | None = None
    model: ArmModel | None = None

    @classmethod
    def of(
        cls,
        robot: str,
        reported: FloatArray,
        views: Sequence[View],
        matched: Matched | None,
        recorded: tuple[Session, str],
    ) -> Self:
        """Reads an arm, as it is stated.

        Args:
            robot: The robot, as the problem has it.
            reported: (s, 4, 4) `base_from_flange`; not a number at stops at which it was not.
            views: The rows that have its pose at the m stops at which it was.
            matched: Its model, beside poses and joints; None where none is known.
            recorded: The session, and the robot's name there.
        """
        joints = [] if matched is None else [matched.joints_rad.get(view.number) for view in views]
        q = [joint for joint in joints if joint is not None]
        known, heat = 0 < len(q) == len(views), None
        if known:
            stamps_s = np.array([view.stamp_s for view in views], dtype=float)
            numbers = np.array([view.number for view in views])
            heat = Heat(*recorded, len(q[0]), numbers, stamps_s)
        return cls(
            robot,
            reported,
            np.isfinite(reported[:, 0, 0]),
            np.array(q) if known else None,
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
        """Whether its flange turns about more than one direction, as far as is known."""
        return self.matched is None or self.matched.robot.can_tilt

    @property
    def has_functions(self) -> bool:
        """Whether functions of its joints were found."""
        return self.kinematics is not None and self.kinematics.functions is not None

    @property
    def gain_of_functions(self) -> float:
        """Twice what functions of its joints gain of the log-likelihood; zero without any."""
        if self.kinematics is None or self.kinematics.functions is None:
            return 0.0
        *others, functions = (fit.gain for fit in self.kinematics.fits.values())
        return functions - max(others)

    def at(self, stops: IntArray) -> Self:
        """The arm at (k,) of its stops."""
        stood = self.stood[stops]
        kept = (np.cumsum(self.stood) - 1)[stops][stood]
        joints, errors = self.joints_rad, self.errors
        return replace(
            self,
            reported=self.reported[stops],
            stood=stood,
            joints_rad=None if joints is None else joints[kept],
            loads=self.loads.chosen(kept),
            heat=None if self.heat is None else self.heat.at(kept),
            errors=None if errors is None else replace(errors, basis=errors.basis[stops]),
        )

    @property
    def drift(self) -> ThermalFit | None:
        """How it drifts with its temperature; None where it does not beyond chance."""
        return None if self.thermal is None or not thermal.is_found(self.thermal) else self.thermal

    @property
    def warming(self) -> ThermalStops:
        """Where it stood, and when; a stop without a time counts as at the start."""
        if self.joints_rad is None or self.heat is None or self.thermal is None:
            raise RuntimeError("an arm drifts by its joints and what heats them")
        start_s = self.thermal.inputs.stamps_s[0]
        stamps_s = np.nan_to_num(self.heat.stamps_s, nan=start_s)
        return ThermalStops(self.robot, np.flatnonzero(self.stood), self.joints_rad, stamps_s)

    def erring(self, errors: ArmErrors | None) -> Self:
        """The arm with errors that were found at some of its stops, none of them estimated yet."""
        arm = replace(self, errors=errors, kinematics=None, model=None)
        return arm if errors is None else replace(arm, errors=replace(errors, basis=arm.basis))

    @property
    def poses(self) -> FloatArray:
        """(s, 4, 4) where the flange stood, by the calibrated arm where there is one."""
        poses = self.reported.copy()
        if self.model is not None and self.joints_rad is not None:
            poses[self.stood] = self.model.base_from_flange(self.joints_rad, self.loads)
        if self.drift is not None:
            poses[self.stood] = poses[self.stood] @ self.drift.motion(self.warming)
        return poses

    def frees_errors(self, *, freely: bool = False) -> bool:
        """Whether its errors are unknowns: those that are estimated, or freely all found."""
        return self.errors is not None and (freely or self.errors.is_estimated)

    def effects(self, *, freely: bool = False) -> tuple[Effect, ...]:
        """What moves its flange at all stops: the uncertainty of its drift, and its errors."""
        drift, found = self.drift, []
        if drift is not None:
            found.append(drift.effect(self.warming, len(self.stood)))
        if self.errors is not None and self.frees_errors(freely=freely):
            values = None if self.model is None else self.model.values
            found.append(self.errors.effect(self.robot, values=values))
        return tuple(found)

    def put_into(self, problem: Problem) -> Problem:
        """A problem with this arm in the place of what it has of it."""
        mine = {f"{name} of {self.robot}" for name in ("arm", "temperature")}
        rest = [effect for effect in problem.effects if effect.name not in mine]
        return problem.with_poses(self.robot, self.poses).with_effects([*rest, *self.effects()])

    def without_errors(self, problem: Problem) -> Problem:
        """A problem with this arm as reported, but for its drift."""
        return self.erring(None).put_into(problem)

    def with_drift(self, problem: Problem, start: State, asked: str) -> Self:
        """Looks for how it drifts with its temperature, where the session determines it.

        Args:
            problem: The observations, with this arm as reported.
            start: Where to start.
            asked: A key of `stages.kinematics.ASKED`.

        Raises:
            DataError: The level asks for it, and the session lacks what it takes.
            DegenerateError: The level asks for it, and all views were taken about equally warm.
        """
        seen = self.at(stops_of(problem, self.robot))
        inputs = heating(seen.heat if self.is_modelled else None, asked)
        if inputs is None or seen.heat is None or seen.joints_rad is None or self.matched is None:
            return self
        places = stops_of(problem, self.robot)
        stops = ThermalStops(self.robot, places, seen.joints_rad, seen.heat.stamps_s)
        found = find_drift(problem, start, stops, inputs, self.matched.arm)
        return replace(self, thermal=found)

    def with_errors(self, likelihood: RobotLikelihood, robot: int) -> Self:
        """Looks for errors that follow its posture.

        Args:
            likelihood: That of the robots' levels with this arm as stated, at the fit.
            robot: Its place among the robots.
        """
        found = find_arm_errors(likelihood, robot, self.basis, of_links=self.is_modelled)
        return replace(self, errors=found)

    def stated(self, problem: Problem) -> Problem | None:
        """A problem with a lost zero where the model has it; None where none is lost.

        Args:
            problem: The observations, with the zero where it was found.
        """
        matched, q = self.matched, self.joints_rad
        if matched is None or matched.zero is None or q is None:
            return None
        poses = problem.poses[self.robot].copy()
        poses[self.stood] = moved_arm(poses[self.stood], q, matched.arm, matched.robot)
        return replace(problem, poses={**problem.poses, self.robot: poses})

    def reported_alike(self, agrees: Mask) -> Mask:
        """(s,) where the reported poses are those of the joints, as much as where views agree.

        A wrong report says nothing against joints and cameras, but would mislead the fit.

        Args:
            agrees: (s,) where they do.
        """
        if self.matched is None or self.joints_rad is None:
            return agrees
        nominal = self.matched.arm.base_from_flange(self.joints_rad)
        tools, sound = invert(nominal) @ self.reported[self.stood], agrees[self.stood]
        away = distances(tools, mean_transform(tools[sound]))
        found = agrees.copy()
        found[self.stood] = np.all(
            [array <= 2.0 * array[sound].max() + _ROUNDED for array in away], axis=0
        )
        return found

    def data(
        self,
        problem: Problem,
        fit: Solution,
        covariance: FloatArray,
        middles: Mapping[str, FloatArray],
    ) -> ArmData | None:
        """What was seen of its errors; None where it stands as stated."""
        columns = problem.effect_columns.get(f"arm of {self.robot}")
        if self.model is None or self.errors is None or self.joints_rad is None or columns is None:
            return None
        stops, every = stops_of(problem, self.robot), np.arange(problem.size)
        rows = np.searchsorted(np.flatnonzero(self.stood), stops)
        pair = ArmPair.of(problem, fit.state, self.robot)
        # Readings of one point show its place and no rotation; several points make a frame.
        shows_pose = bool((problem.observations.directions[pair.rows] > 3).any())
        # The rotation of what is only a point beside it is no value of its frame.
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

    def found(
        self,
        problem: Problem,
        fit: Solution,
        covariance: FloatArray,
        middles: Mapping[str, FloatArray],
        convention: Convention | None = None,
    ) -> ArmFound:
        """What the stops determine of it.

        Args:
            problem: The observations that agree, with its errors among the unknowns.
            fit: Their fit.
            covariance: (p, p) its covariance.
            middles: (3,) the middle of each printed target by its frame, in that [m].
            convention: Of the table that is wanted; see `stages.arm_identifiability`.
        """
        drift = None
        if self.drift is not None and self.heat is not None:
            seen = self.at(stops_of(problem, self.robot))
            stops = replace(seen.warming, places=stops_of(problem, self.robot))
            views = [] if seen.heat is None else seen.heat.views.tolist()
            drift = drift_result(self.drift, stops, views, problem, fit)
        data = self.data(problem, fit, covariance, middles)
        if data is None or self.kinematics is None:
            return ArmFound(drift=drift)
        # With nothing but play and springs its numbers are as stated.
        erring = data.model.weights.keys() & set(RIGID)
        return ArmFound(
            identify_arm(data, convention) if erring else None,
            springs_of(data, self.kinematics.errors),
            plays_of(data.model, data.arm_covariance),
            drift,
            carries_over(data, self.kinematics) if erring else None,
            functions_of(data, self.kinematics),
            tuple(
                JointRange(name, float(column.min()), float(column.max()))
                for name, column in zip(data.model.nominal.joint_names, data.q.T, strict=True)
            ),
        )

    def result(self, found: ArmFound, views: Sequence[int]) -> ArmSections:
        """What was found of it, as sections of a calibration.

        Args:
            found: What the stops determine of it.
            views: By which views these stops go.
        """
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
            backlash=found.plays,
            functions=found.functions,
            measured=found.measured,
        )
        if found.numbers is not None:
            zero = None if self.matched is None else self.matched.zero
            arm = found.numbers.in_result(arm, self.model.nominal, views, zero)
            arm = replace(arm, left_out=self.kinematics.left_out(), carries_over=found.carries)
        springs = None if found.springs is None else found.springs.result(views)
        return replace(sections, arm=arm, elastic=springs)

    @property
    def basis(self) -> FloatArray:
        """(s, 6, p) how small errors move its flange.

        They are those of its model where it is calibrated, or else of any of its links, where these
        are known.
        """
        if self.matched is None or self.joints_rad is None:
            return self._by_stop(pose_basis(self.reported[self.stood]))
        if self.model is None:
            return self._by_stop(link_basis(self.matched.arm, self.joints_rad))
        return self._by_stop(self.model.basis(self.joints_rad, self.loads))

    @property
    def joint_offsets(self) -> FloatArray | None:
        """(s, 6, n) how its flange moves with the offsets of its joints; None without a model."""
        if self.matched is None or self.joints_rad is None:
            return None
        stated = ArmModel.of(self.matched.arm, self.joints_rad, self.reported[self.stood])
        return self._columns(self.model or stated, "offsets")

    def with_level(
        self,
        problem: Problem,
        start: State,
        asked: str,
        views: Sequence[int],
        noise: Noise | None = None,
    ) -> Self:
        """Chooses how far it is calibrated.

        Args:
            problem: The observations, with this arm as reported.
            start: Where to start.
            asked: A key of `stages.kinematics.ASKED`.
            views: (n,) by which view each observation goes.
            noise: The noise's levels to start from; those from above where None.
        """
        stops = stops_of(problem, self.robot)
        if self.matched is None or self.joints_rad is None or not len(stops):
            return self
        seen = self.at(stops)
        q, loads = seen.joints_rad, seen.loads
        if q is None:
            return self
        model = ArmModel.of(self.matched.arm, q, seen.reported).loaded(q, loads)
        blocks = blocks_of(model.nominal, self.loads)
        bases = {name: self._columns(model, name) for name in blocks}
        found = choose_level(
            problem, start, self.robot, bases, asked, self.stated(problem), noise=noise
        )
        mine = np.flatnonzero(rows_of(problem, self.robot)).tolist()
        arm = replace(self, kinematics=replace(found, views=tuple(views[index] for index in mine)))
        if found.errors:
            return arm._bending(model.erring(found.errors))
        if self.model is None:
            return arm
        # Fewer views agree than when it was calibrated: its errors are sought as of a stated one.
        fit = found.nominal.fit
        likelihood = robot_likelihood(problem, fit.state, fit.noise)
        return replace(arm, model=None).with_errors(likelihood, problem.robots.index(self.robot))

    def with_functions(self, problem: Problem, start: State, asked: str, noise: Noise) -> Self:
        """Looks for functions of its joints beside all that a level of its geometry has.

        Args:
            problem: The observations, with this arm as reported.
            start: Where to start.
            asked: A key of `stages.kinematics.ASKED`.
            noise: The noise's levels to start from.
        """
        seen = self.at(stops_of(problem, self.robot))
        q, reported = seen.joints_rad, seen.reported
        if self.matched is None or self.joints_rad is None or q is None or self.kinematics is None:
            return self
        if not allows_functions(asked, len(q)):
            return self
        model = ArmModel.of(self.matched.arm, q, reported).loaded(q, seen.loads)
        placed = np.eye(len(self.stood))[:, self.stood]
        stops = (placed, self.joints_rad, self.loads)
        found = with_functions(self.kinematics, problem, start, self.robot, model, stops, noise)
        if found.functions is None:
            return self
        model = replace(
            model,
            harmonic_directions=found.functions.directions,
            harmonic_sizes=found.functions.sizes,
        ).erring(found.errors)
        return replace(self, kinematics=found)._bending(model)

    def _columns(self, model: ArmModel, name: str) -> FloatArray:
        """(s, 6, p) how the flange moves with the errors of a block."""
        if self.joints_rad is None:
            raise RuntimeError("an arm is calibrated by its joints")
        return self._by_stop(model.columns(name, self.joints_rad, self.loads))

    def moved(self, problem: Problem, state: State) -> tuple[Self, float]:
        """Linearises the calibrated arm anew where a fit has it.

        Returns:
            The arm, and how far its farthest error has moved [rad].
        """
        if self.model is None:
            return self, 0.0
        name = f"arm of {self.robot}"
        start = [effect.values for effect in problem.effects if effect.name == name]
        if not start:
            return self, 0.0
        step = problem.values_of(name, state) - start[0]
        return self._bending(self.model.moved(step)), float(np.abs(step).max())

    def _bending(self, model: ArmModel) -> Self:
        """The arm with the errors of its model as they move the flange."""
        if self.kinematics is None:
            return self
        found = self.kinematics.errors.values()
        arm, gain = replace(self, model=model), sum(arm_errors.gain for arm_errors in found)
        return replace(arm, errors=ArmErrors(arm.basis, next(iter(found)).sigma, gain, True))

    def _by_stop(self, columns: FloatArray) -> FloatArray:
        """(s, 6, p) of (m, 6, p): zero where the robot did not stand."""
        found = np.zeros((len(self.stood), *columns.shape[1:]))
        found[self.stood] = columns
        return found


def _size_of(errors: ArmErrors) -> ArmErrorsResult:
    """The size of errors, as a section of a calibration."""
    if errors.look is not None and errors.white is not None:
        turned, shifted = np.sqrt(np.maximum(errors.look**2 - errors.white**2, 0.0))
        found = ArmErrorsResult(
            sigma_mm=1e3 * float(shifted),
            sigma_deg=float(np.rad2deg(turned)),
            likelihood_ratio=errors.gain,
            estimated=False,
            of="flange",
        )
        if errors.away is None:
            return found
        (deg, mm), (predicted_deg, predicted_mm) = (errors.away * [np.rad2deg(1.0), 1e3]).tolist()
        return replace(
            found,
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


def effects_of(arms: Mapping[str, RobotArm], *, freely: bool = False) -> Iterator[Effect]:
    """The errors of all arms that are unknowns; see `RobotArm.effects`."""
    for arm in arms.values():
        yield from arm.effects(freely=freely)


def check_arms(arms: Mapping[str, RobotArm], asked: str) -> None:
    """Refuses loads that determine nothing.

    Raises:
        DataError: Springs are asked for that nothing bends.
        DegenerateError: Loads change while an arm stands still.
    """
    for arm in arms.values():
        check_poses(arm.loads, arm.reported[arm.stood])
        check_elastic(asked, None if arm.matched is None else arm.matched.robot, arm.loads)
