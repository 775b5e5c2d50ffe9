"""Content of a result, and what is derived of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.choices import PoseForm
from visioncal.core.codec import entries
from visioncal.core.errors import DataError
from visioncal.core.quantiles import freedom_of
from visioncal.core.summaries import ByName
from visioncal.core.types import FloatArray, Mount
from visioncal.core.verdict import Remedy, Verdict
from visioncal.results.arm import NOMINAL, ArmResult, ArmSections
from visioncal.results.cell import CellResult
from visioncal.results.conditions import Condition, conditions_of
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult, RayFrame, ray_frame
from visioncal.results.parts import NeedMet, RobotModel, RobotResult, SolverResult
from visioncal.results.sections import CalibrationSections, CellDetails, CellUncertainty
from visioncal.results.tree import FrameTree
from visioncal.results.views import Rms, Validation, ViewResult
from visioncal.robot import Loads, Robot
from visioncal.robot.elasticity import deflected_joints
from visioncal.robot.thermal import ThermalModel
from visioncal.session.frames import CELL, edge_names, frames_of_kind, object_name


@dataclass(frozen=True, eq=False)
class CalibrationContent(CalibrationSections):
    """Content of a calibration.json, and what is derived of it; see `Calibration`.

    It also has all attributes of `CalibrationSections` and `ArmSections`.
    """

    session_name: str  # The session's name.
    session_sha256: str  # Digest of the session's canonical content.
    created: str  # Time of creation, ISO 8601.
    mount: Mount  # Mount of the camera.
    edges: Mapping[str, Edge]  # Estimated transforms by name, in the order of `joint_covariance`.
    joint_covariance: FloatArray  # (6 k, 6 k) joint covariance of all edges, in that order.
    solvers: Mapping[str, SolverResult]  # Result of every solver.
    noise: Mapping[str, float]  # Estimated standard deviations by name.
    views: tuple[ViewResult, ...]  # One entry for each view of the session.
    rms: Rms  # Residuals over the used views.
    validation: Validation  # Residuals of left-out views.
    verdict: Verdict  # Verdict with its reasons.
    camera: CameraResult | None = None  # The camera, where the session has one.
    robot: Robot | None = None  # The nominal robot model, where the session names a known one.
    robot_form: str | None = None  # The form of its poses, a name among `POSE_FORMS`, where stated.
    # Tools and fixtures by transform name, as `flange_from_tool`.
    frames: Mapping[str, Frame] = field(default_factory=dict)
    # Cameras, robots and targets of a whole cell by name; None for one camera and robot. `of`
    # selects one of each.
    cell: CellResult | None = None
    # Required accuracy of picks, and the probability of meeting it; None where not stated.
    need: NeedMet | None = None

    @cached_property
    def ray_frame(self) -> RayFrame | None:
        """The camera's transform in the frame of its image's centre ray; see `RayFrame`."""
        edge = edge_names(self.mount)[0]
        if self.camera is None or edge not in self.edges:
            return None
        return ray_frame(edge, self.edges[edge], self.camera)

    @cached_property
    def conditions(self) -> tuple[Condition, ...]:
        """The conditions under which the result is valid."""
        return tuple(conditions_of(self.by_name, self.verdict))

    @property
    def unstated_conditions(self) -> tuple[str, ...]:
        """The conditions that no finding of the verdict states, in words."""
        stated = {finding.kind for finding in self.verdict.findings}
        return tuple(
            condition.words
            for condition in self.conditions
            if condition.kind != "calibrated-arm" or "calibrated_arm" not in stated
        )

    def controller(self, *frames: str) -> PoseForm | None:
        """The pose notation of the controller of the robot whose base or flange is among frames.

        Of other frames, that of all robots; None where unknown.
        """
        robots, bases = self.by_name.robots, {"cell": self.by_name.reference}
        for frame in (bases.get(frame, frame) for frame in frames):
            name = object_name(frame, "robot") if self.cell else ""
            if frames_of_kind((frame,), "base") or frames_of_kind((frame,), "flange"):
                return robots.get(name, RobotModel()).controller
        forms = {robot.controller for robot in robots.values()}
        return forms.pop() if len(forms) == 1 else None

    def rotation_words(self, name: str, edge: Edge) -> str:
        """The rotation of a named transform in words, also in the form of its robot's poses."""
        return edge.rotation_words(self.controller(*name.split("_from_")))

    @cached_property
    def by_name(self) -> CellResult:
        """Cameras, robots and targets by name, which is empty for one camera and one robot."""
        if self.cell is not None:
            return self.cell
        ends = (name.partition("_from_") for name in self.edges)
        placed = {child: parent for parent, _, child in ends}
        arm = {section.name: getattr(self, section.name) for section in entries(ArmSections)}
        return CellResult(
            reference="base",
            tree={"base": CELL, "flange": "base", **placed},
            cameras={} if self.camera is None else {"": self.camera},
            robots={"": RobotResult(self.robot, self.robot_form, **arm)},
            targets={},
            noise={"": self.noise},
            moved=(),
            untied=(),
            weakest="",
            details=CellDetails({} if self.clock is None else {"": self.clock}),
            uncertainty=None
            if self.uncertainty is None
            else CellUncertainty(budget_mm={}, noise_95={"": self.uncertainty.noise_95}),
        )

    @cached_property
    def tree(self) -> FrameTree:
        """Tree of the result's frames."""
        cell = self.by_name
        return FrameTree(
            cell.reference,
            cell.tree,
            cell.flanges,
            self.edges,
            self.joint_covariance,
            self.frames,
            frozenset(move.before for move in cell.moved),
        )

    @typed
    def between(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> Edge:
        """Transform between any two frames, with its covariance.

        The covariance of tools and fixtures is taken as independent of the calibration. A frame
        without measured rotation has that of its parent, without covariance.

        Args:
            first: A frame of the cell, a tool or a fixture.
            second: Another one.
            poses: (4, 4) `base_from_flange` by robot, for robots between the two; taken as exact. A
                robot without a name is `robot`.

        Returns:
            `first_from_second`.

        Raises:
            DataError: There is no such frame, or a robot's pose is needed.
        """
        return self.tree.between(first, second, poses)

    @property
    def next_steps(self) -> tuple[Remedy, ...]:
        """Remedies for the findings, also on tools and fixtures; the most urgent first."""
        doubtful = (name for name, frame in self.frames.items() if frame.verdict.status != "good")
        frames = (Remedy(f"Read what was found of {name} before it is used.") for name in doubtful)
        return (*self.verdict.next_steps, *frames)

    @property
    def transforms(self) -> ByName[RigidTransform]:
        """Estimated transforms by name, with those of tools and fixtures."""
        return ByName({name: edge.transform for name, edge in self.placed.items()})

    @property
    def placed(self) -> ByName[Edge]:
        """Estimated transforms with covariance by name, with those of tools and fixtures."""
        return ByName({**self.edges, **{name: frame.edge for name, frame in self.frames.items()}})

    @property
    def noise_dof(self) -> float:
        """Degrees of freedom of the noise levels; see `estimation.intervals.freedom_of`."""
        intervals = {} if self.uncertainty is None else self.uncertainty.noise_95
        return freedom_of(intervals.values()) if intervals else np.inf

    @typed
    def covariance(self, name: str) -> FloatArray:
        """Covariance of one transform.

        Args:
            name: Its name, such as `flange_from_cam`.

        Returns:
            (6, 6) of (rotation [rad], translation [m]), right perturbation.

        Raises:
            DataError: There is no transform of that name.
        """
        return self.placed[name].covariance

    @typed
    def base_from_flange(
        self,
        q: FloatArray,
        *,
        payload_kg: float | FloatArray = 0.0,
        payload_m: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
        force_n: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
        temperatures_c: FloatArray | None = None,
    ) -> RigidTransform:
        """Forward kinematics of the calibrated robot, with joint compliance where calibrated.

        Args:
            q: (m, n) joint angles [rad].
            payload_kg: Mass of the payload on the flange; one for all, or (m,) [kg].
            payload_m: (3,) or (m, 3) its centre in the flange's frame [m].
            force_n: (3,) or (m, 3) external force on the flange's origin, in the base's frame [N].
            temperatures_c: (m, n) temperatures of the links behind the joints, or (n,) for all
                [deg C], as from `OnlineCompensator`; None for those at the start of the views.

        Returns:
            m transforms, as one batched RigidTransform.

        Raises:
            DataError: The session named no known robot, q has another number of joints or is not
                finite, a load is invalid, or temperatures are given without calibrated drift.
        """
        q = np.atleast_2d(np.asarray(q, dtype=float))
        wrong = np.flatnonzero(~np.isfinite(q).all(axis=1))
        if wrong.size:
            raise DataError(f"q[{wrong[0]}] is not finite.", culprits=[f"q[{wrong[0]}]"])
        loads = Loads.alike(len(q), payload_kg, payload_m, force_n)
        poses = self.standing(q, loads)
        if temperatures_c is not None:
            poses = poses @ self.drift.motion(q, np.asarray(temperatures_c, dtype=float))
        return RigidTransform.from_matrix(poses)

    def standing(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Forward kinematics as `base_from_flange`, as (m, 4, 4).

        Args:
            q: (m, n) joint angles [rad].
            loads: Loads on the flange; the arm's own weight alone where None.

        Raises:
            DataError: The session named no known robot, or q has another number of joints.
        """
        arm = self.calibrated_robot
        if arm is None:
            raise DataError(
                "this calibration holds no robot model.",
                next_step="Name one in the session's [robot] table and calibrate again."
                if self.cell is None
                else "It is of a whole cell: take one robot out of it with of(robot=...).",
            )
        return arm.base_from_flange(
            deflected_joints(arm, q, self.compliance, loads, self.weight_moments)
        )

    @property
    def compliance(self) -> FloatArray:
        """(n,) compliance of each joint [rad/(N m)]; zero where unknown."""
        if self.elastic is None:
            return np.zeros(0 if self.robot is None else self.robot.joint_count)
        return self.elastic.compliance

    @cached_property
    def drift(self) -> ThermalModel:
        """Thermal model of the arm.

        Raises:
            DataError: Its drift was not calibrated.
        """
        arm = self.calibrated_robot
        if arm is None or self.thermal is None:
            raise DataError(
                f"calibration {self.session_name!r} does not say how its arm drifts with "
                "temperature.",
                culprits=["temperatures"],
                next_step="Record reference views while the arm warms up, with temp1_c ... or "
                "current1_a ..., and calibrate with --level thermal.",
            )
        return self.thermal.model(arm)

    @typed
    def at_temperatures(self, temperatures_c: FloatArray) -> Self:
        """Calibration with the arm at (n,) temperatures of its links [deg C].

        Raises:
            DataError: Its drift was not calibrated, or it has another number of joints.
        """
        warm = self.drift.robot_at(np.asarray(temperatures_c, dtype=float))
        return replace(
            self, arm=replace(self.arm or ArmResult(level=NOMINAL, levels=()), robot=warm)
        )

    @property
    def arm_is_calibrated(self) -> bool:
        """Whether the transforms are for the calibrated arm, not for the controller's."""
        return self.arm is not None and self.arm.robot is not None

    @property
    def calibrated_robot(self) -> Robot | None:
        """The calibrated arm, else its nominal model, where there is one."""
        return self.robot if self.arm is None or self.arm.robot is None else self.arm.robot

    @property
    def weight_moments(self) -> FloatArray | None:
        """(n, 4 n) compliance times unknown masses and first moments; None where not estimated.

        For `deflected_joints` of an arm whose model does not state the masses of its links.
        """
        return None if self.elastic is None else self.elastic.weight_moments
