"""The fit of a cell: inliers, camera parameters and arms; its joint fit with the corners."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell import Cell, ObservationRow
from visioncal.calibration.stages.error_sizes import ErrorSizes
from visioncal.calibration.stages.validate import chain_rms_px
from visioncal.core.limits import CalibrationLimits
from visioncal.core.transforms import apply, pose_difference
from visioncal.core.types import Corners, FloatArray, IntArray
from visioncal.estimation.effects.lenses import CameraParameters, LinearisedCorners
from visioncal.estimation.fit import Fit
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.scene import BoardSizes, CornerProblem, Scene
from visioncal.estimation.unknowns import BOARD, LENS
from visioncal.vision.camera import intrinsics
from visioncal.vision.pnp import ViewPoses
from visioncal.vision.targets import corner_positions

# An arm without joint angles may look like a step of a frame.
_OTHER_POSTURE = (
    ", or the arm went over to another posture (shoulder, elbow or wrist) with its errors, or "
    "another load bends it, or one of its joints slipped"
)


@dataclass(frozen=True, eq=False)
class CellFit:
    """The fit of a cell, and the frames' side of its joint fit with corners; see `joint`."""

    cell: Cell  # The cell; its rows are the observations in the fit's order.
    inlier_fit: InlierFit  # The inliers, their fit, and the frames that moved.
    # Linearised corners of lenses and boards; None without images.
    linearised_corners: LinearisedCorners | None
    poses: tuple[ViewPoses, ...]  # The pose chosen for each row.
    unconnected: tuple[str, ...]  # Frames that no observation links to the rest.
    arms: Mapping[str, Arm]  # The robots' arms, as far as they were calibrated.
    level: str  # The requested calibration level of the arms.
    # Errors of clocks, and those that grow with time, reach or gravity.
    other_effects: tuple[Effect, ...]
    # Twice the gain in log-likelihood of those that grow, by their names.
    gains: Mapping[str, float] = field(default_factory=dict)
    sizes: ErrorSizes = field(default_factory=ErrorSizes)  # Of errors of lenses and boards.
    solver: str = "joint"  # The solver of the edges.
    # Views that are left out as of another camera or frame: their lens may be another one, too, and
    # no lens or board is estimated of them.
    apart: frozenset[int] = frozenset()

    @property
    def noise(self) -> Noise:
        """Noise levels of robots and sensors, from which another fit starts."""
        return self.inlier_fit.fit.noise

    @property
    def has_links(self) -> bool:
        """Whether errors of an arm's links are free."""
        return any(arm.has_free_errors for arm in self.arms.values())

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects beside lenses and boards: those of clocks, what grows, and errors of arms."""
        of_arms = (effect for arm in self.arms.values() for effect in arm.effects())
        return (*self.other_effects, *of_arms)

    def may_be_of_arms(self, step: FloatArray) -> bool:
        """Whether an arm without joint angles may be off by as much as a frame stepped, (4, 4).

        An arm that goes over to another posture of shoulder, elbow or wrist has its links' errors
        the other way from there on, at poses that do not tell.
        """
        mm, deg = pose_difference(np.eye(4), step)
        limit_mm, limit_deg = CalibrationLimits.arm_errors
        is_small = mm <= limit_mm and deg <= limit_deg
        return is_small and not all(arm.is_modelled for arm in self.arms.values())

    def instead_of(self, step: FloatArray) -> str:
        """An arm without joint angles that looks as if a frame stepped by (4, 4), as a clause."""
        if self.may_be_of_arms(step):
            return _OTHER_POSTURE
        is_known = all(arm.is_modelled for arm in self.arms.values())
        return "" if is_known else ", or a joint of the arm slipped"

    def with_arm_poses(self) -> Self:
        """Replaces the robots' poses by those of their arms."""
        problem, arms = self.inlier_fit.problem, self.arms.items()
        poses = {**problem.poses, **{name: arm.poses for name, arm in arms}}
        inlier_fit = replace(self.inlier_fit, problem=replace(problem, poses=poses))
        return replace(self, inlier_fit=inlier_fit)

    def with_joint_fit(self, fitted: Fit) -> Self:
        """Takes over a joint fit of lenses, boards and frames."""
        problem = self.full_problem(fitted.linearised).sized_at(fitted.state)
        inlier_fit = replace(self.inlier_fit, problem=problem, fit=fitted.solution)
        return replace(self, inlier_fit=inlier_fit, linearised_corners=fitted.linearised)

    @cached_property
    def fit(self) -> Fit:
        """The fit of the inliers, with the covariance by noise and priors alone."""
        return Fit(self.inlier_fit.part, self.inlier_fit.fit, self.linearised_corners)

    @cached_property
    def lens_changes(self) -> dict[str, FloatArray]:
        """(n, 6, 3) by camera: Jacobian of the inliers' poses by changes of its lens.

        Of the focal length, and of the centre along both axes, as shares of the focal length.
        """
        found, seen = dict[str, FloatArray](), self.linearised_corners
        if seen is None:
            return found
        rows = self.all_rows(seen)[self.inlier_fit.used]
        for name, compressed in zip(seen.camera_parameters.problems, seen.compressed, strict=True):
            part, focal = seen.camera_parameters.rows(name), seen.camera_parameters.camera(name)
            fx, fy = focal.matrix[:2].tolist()
            units = np.array([[fx, fy, 0.0, 0.0], [0.0, 0.0, fx, 0.0], [0.0, 0.0, 0.0, fy]]).T
            moves = np.zeros((len(seen.views) + 1, 6, 3))
            moves[part] = compressed.by_shared[:, :, :4] @ units
            found[name] = moves[rows]
        return found

    def pixels(
        self,
        rows: Sequence[ObservationRow],
        views: Sequence[ViewPoses],
        poses: FloatArray,
        state: State,
    ) -> FloatArray:
        """Reprojection errors (m,) [px] of views, given (m, 4, 4) poses of their targets."""
        if self.linearised_corners is None:
            return np.full(len(rows), np.nan)
        optics = self.fit.at(state).camera_parameters
        lenses = {name: optics.camera(name) for name in optics.problems}
        cameras = [lenses.get(row.seer) for row in rows]
        return chain_rms_px([view.corners for view in views], poses, cameras, optics.points)

    def problem(self, seen: LinearisedCorners) -> Problem:
        """The problem of the inliers, repeated ones sharing an error."""
        return replace(self.full_problem(seen), with_repeats=True).subset(self.inlier_fit.used)

    def all_rows(self, seen: LinearisedCorners) -> IntArray:
        """(n,) index of the corners' view of each observation of the cell; -1 for none."""
        places = {view: at for at, view in enumerate(seen.views)}
        return np.array([places.get(row.view, -1) for row in self.cell.rows], dtype=np.int64)

    def full_problem(self, seen: LinearisedCorners) -> Problem:
        """The problem of all observations, with the poses by current lenses and boards."""
        problem, rows = self.inlier_fit.problem, self.all_rows(seen)
        has_corners, stated = rows >= 0, problem.observations
        measured, covariance = stated.measured.copy(), stated.covariance.copy()
        measured[has_corners] = seen.camera_parameters.poses[rows[has_corners]]
        covariance[has_corners] = seen.covariance[rows[has_corners]]
        observations = replace(stated, measured=measured, covariance=covariance)
        problem = replace(problem, observations=observations)
        return problem.with_effects([seen.effect(rows), *self.effects])

    def refitted(self) -> Self:
        """The fit of the inliers beside all effects, without corners."""
        inliers = self.inlier_fit
        problem = inliers.problem.with_effects(self.effects)
        state = State(inliers.fit.state.edges, problem.start_values)
        inliers = replace(inliers, problem=problem, fit=replace(inliers.fit, state=state))
        return replace(self, inlier_fit=inliers.refitted())

    def with_errors(self, fitted: Fit) -> Self:
        """Looks for errors of the links of the arms whose errors are not free yet."""
        likelihood = robot_likelihood(fitted.problem, fitted.state, fitted.noise)
        robots = fitted.problem.robots
        arms = {
            name: arm if arm.has_free_errors else arm.with_errors(likelihood, robots.index(name))
            for name, arm in self.arms.items()
        }
        return replace(self, arms=arms)

    def stated_parameters(
        self, scenes: Mapping[str, Scene], views: Mapping[str, Sequence[ViewPoses]]
    ) -> CameraParameters:
        """The corners of scenes and views (by camera frame), with stated lenses and boards.

        They have the `sizes` of errors. Free values start where the one likelihood has them.
        """
        shares, sizes, problems, poses = self._shares, self.sizes, {}, {}
        stops = self.inlier_fit.problem.observations.stops.tolist()
        stop_of = {row.view: at for row, at in zip(self.cell.rows, stops, strict=True)}
        for frame, scene in scenes.items():
            corners = dict[int, Corners]()
            marks = np.concatenate([corner_positions(target) for target in scene.targets])
            for view in views[frame]:
                if view.corners is not None:
                    pose = view.cam_from_target[0]
                    shown = scene.camera, pose, apply(pose, marks[view.corners.ids])
                    station = stop_of.get(view.view, -1)
                    corners[view.view] = sizes.steadied(frame, station, view.corners, shown)
            problem, levels = CornerProblem.of(scene, corners, shares), sizes.levels.get(frame)
            problems[frame] = replace(
                problem if levels is None else problem.with_levels(levels),
                lens_covariance=sizes.lenses.get(frame),
                board_sizes=tuple(sizes.boards.get(at, BoardSizes()) for at in scene.printed),
            )
            with_corners = [view for view in views[frame] if view.view in corners]
            poses[frame] = np.array([view.cam_from_target[0] for view in with_corners])
        stated = CameraParameters.of(problems, poses)
        values = stated.values.copy()
        for frame, lens in sizes.cameras.items():
            if frame in problems:
                values[stated.parts[LENS, frame]] = intrinsics(lens)
        for name in next(iter(scenes.values())).printed:
            shape = sizes.shapes.get(self.cell.session.board_frames[name])
            if shape is not None:
                values[stated.parts[BOARD, name]] = shape
        free = np.setdiff1d(stated.free, stated.held)
        return stated.with_values(free, values[free])

    @property
    def _shares(self) -> dict[int, float]:
        """Weight of each view for lenses and boards; views of one stop share one weight."""
        observations, tree = self.inlier_fit.problem.observations, self.inlier_fit.problem.tree
        pairs = list(zip(observations.observers, observations.observed, strict=True))
        has_robot = {pair: any(step.robot for step in tree.path(*pair)) for pair in set(pairs)}
        rows = zip(self.cell.rows, pairs, observations.stops.tolist(), strict=True)
        repeated = {row.view: (pair, stop if has_robot[pair] else None) for row, pair, stop in rows}
        # Errors of a lens, a print or a detector in one of them are the same in all.
        counts = Counter(repeated.values())
        return {
            view: 0.0 if view in self.apart else 1.0 / counts[key] for view, key in repeated.items()
        }
