"""The frames' side of the joint fit: observations, arms and their effects."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages.arms import RobotArm, arm_effects, with_link_errors
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.types import Corners, IntArray, Mask
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.effects.lenses import CameraParameters, LinearisedCorners
from visioncal.estimation.joint import ConvergedFit
from visioncal.estimation.pose_errors import find_pose_errors
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.scene import CornerProblem, Scene
from visioncal.estimation.solve import fit_problem


@dataclass(frozen=True, eq=False)
class CellFrameModel:
    """Part of the joint fit beside corners, lenses and boards; see `joint.FrameModel`."""

    observed: Problem  # All n observations.
    used: Mask  # (n,) the inliers, which are fitted.
    views: Sequence[int]  # (n,) the view of each.
    arms: Mapping[str, RobotArm]  # The robots' arms, with the errors that were found.
    effects: Sequence[Effect] = ()  # All effects but lenses, boards and arms.
    noise: Noise | None = None  # Its levels to start from; None for those from above.

    @property
    def has_links(self) -> bool:
        """Whether errors of an arm's links are free."""
        return any(arm.has_free_errors for arm in self.arms.values())

    def problem(self, seen: LinearisedCorners) -> Problem:
        """The problem of the inliers, repeated ones sharing an error."""
        return replace(self.full_problem(seen), with_repeats=True).subset(self.used)

    def rows(self, seen: LinearisedCorners) -> IntArray:
        """(n,) index of the corners' view of each observation of `problem`; see `FrameModel`."""
        return self.all_rows(seen)[self.used]

    def all_rows(self, seen: LinearisedCorners) -> IntArray:
        """(n,) the same of all observations."""
        places = {view: at for at, view in enumerate(seen.views)}
        return np.array([places.get(view, -1) for view in self.views], dtype=np.int64)

    def full_problem(self, seen: LinearisedCorners) -> Problem:
        """The problem of all observations, with the poses by current lenses and boards."""
        problem, rows = self.observed, self.all_rows(seen)
        has_corners, stated = rows >= 0, problem.observations
        measured, covariance = stated.measured.copy(), stated.covariance.copy()
        measured[has_corners] = seen.camera_parameters.poses[rows[has_corners]]
        covariance[has_corners] = seen.covariance[rows[has_corners]]
        observations = replace(stated, measured=measured, covariance=covariance)
        effects = [
            seen.effect(rows),
            *self.effects,
            *arm_effects(self.arms),
        ]
        return replace(problem, observations=observations).with_effects(effects)

    def with_errors(self, fitted: ConvergedFit) -> Self:
        """Tests for errors of the arms that are not free yet."""
        return replace(self, arms=with_link_errors(self.arms, fitted.problem, fitted.fit))

    @property
    def arms_without_joints(self) -> dict[str, RobotArm]:
        """The arms without joint angles."""
        return {name: arm for name, arm in self.arms.items() if not arm.is_modelled}

    def pose_errors(self, fitted: ConvergedFit) -> dict[str, ArmErrors]:
        """Errors of the arms without joint angles beside a fit; see `find_pose_errors`."""
        problem, arms = fitted.problem, self.arms_without_joints
        for arm in arms.values():
            problem = arm.without_errors(problem)
        values, free = problem.start_values.copy(), len(fitted.linearised.free)
        values[:free] = fitted.fit.state.values[:free]
        fit = fit_problem(problem, State(fitted.fit.state.edges, values))
        found = {robot: find_pose_errors(problem, fit.state, fit.noise, robot) for robot in arms}
        return {robot: errors for robot, errors in found.items() if errors is not None}

    def camera_parameters(
        self, scenes: Mapping[str, Scene], views: Mapping[str, Sequence[ViewPoses]]
    ) -> CameraParameters:
        """The corners of scenes and views (by camera frame), with stated lenses and boards."""
        shares, problems, poses = self._shares, {}, {}
        for frame, scene in scenes.items():
            corners: dict[int, Corners] = {
                view.view: view.corners for view in views[frame] if view.corners is not None
            }
            problem = CornerProblem.of(scene, corners, shares)
            problems[frame] = replace(problem, holds_scales=bool(self.arms_without_joints))
            with_corners = [view for view in views[frame] if view.view in corners]
            poses[frame] = np.array([view.cam_from_target[0] for view in with_corners])
        return CameraParameters.of(problems, poses)

    @property
    def _shares(self) -> dict[int, float]:
        """Weight of each view for lenses and boards; views of one stop share one weight."""
        observations, tree = self.observed.observations, self.observed.tree
        pairs = list(zip(observations.observers, observations.observed, strict=True))
        has_robot = {pair: any(step.robot for step in tree.path(*pair)) for pair in set(pairs)}
        rows = zip(self.views, pairs, observations.stops.tolist(), strict=True)
        repeated = {view: (pair, stop if has_robot[pair] else None) for view, pair, stop in rows}
        # Errors of a lens, a print or a detector in one of them are the same in all.
        counts = Counter(repeated.values())
        return {view: 1.0 / counts[key] for view, key in repeated.items()}
