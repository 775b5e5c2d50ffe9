"""The frames' side of the joint fit, of one robot and one camera or of many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages.arms import RobotArm, effects_of
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.types import Corners, FloatArray, IntArray, Mask
from visioncal.estimation.arm import ArmErrors, misfit_covariance
from visioncal.estimation.effects.lenses import CameraParameters, LinearisedCorners
from visioncal.estimation.joint import ConvergedFit
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.pose_errors import find_pose_errors
from visioncal.estimation.problem import Problem
from visioncal.estimation.scene import CornerProblem, Scene, repeat_shares
from visioncal.estimation.solve import fit_problem, fitted_covariance, robot_likelihood


@dataclass(frozen=True, eq=False)
class FramesSide:
    """What the joint fit has beside corners, lenses and boards; see `joint.Side`.

    Attributes:
        observed: All n observations.
        used: (n,) those that the fit is made from.
        views: (n,) the view of each.
        arms: The robots' arms, and which of their errors were found.
        effects: All effects but lenses, boards and arms.
        noise: Its levels to start from; None for those from above.
        freely: Whether all errors that were found are free, and not those alone that are estimated.
    """

    observed: Problem
    used: Mask
    views: Sequence[int]
    arms: Mapping[str, RobotArm]
    effects: Sequence[Effect] = ()
    noise: Noise | None = None
    freely: bool = False

    @property
    def errors(self) -> tuple[ArmErrors, ...]:
        """The errors of arms that were found."""
        return tuple(arm.errors for arm in self.arms.values() if arm.errors is not None)

    @property
    def has_errors(self) -> bool:
        """Whether errors of an arm are free."""
        return any(arm.frees_errors(freely=self.freely) for arm in self.arms.values())

    @property
    def has_links(self) -> bool:
        """Whether those of an arm's own links are."""
        return self.has_errors and any(error.of_links for error in self.errors)

    def problem(self, seen: LinearisedCorners) -> Problem:
        """The problem of the observations that agree, repeated ones sharing an error."""
        return replace(self.whole(seen), with_repeats=True).subset(self.used)

    def rows(self, seen: LinearisedCorners) -> IntArray:
        """(n,) which of the corners' views each observation of `problem` is; see `joint.Side`."""
        return self._all_rows(seen)[self.used]

    def _all_rows(self, seen: LinearisedCorners) -> IntArray:
        places = {view: at for at, view in enumerate(seen.views)}
        return np.array([places.get(view, -1) for view in self.views], dtype=np.int64)

    def whole(self, seen: LinearisedCorners) -> Problem:
        """The problem of all observations, with poses as lenses and boards make them."""
        problem, rows = self.observed, self._all_rows(seen)
        mine, before = rows >= 0, problem.observations
        measured, covariance = before.measured.copy(), before.covariance.copy()
        measured[mine], covariance[mine] = seen.looks.poses[rows[mine]], seen.covariance[rows[mine]]
        arms = effects_of(self.arms, freely=self.freely)
        return replace(
            problem, observations=replace(before, measured=measured, covariance=covariance)
        ).with_effects([seen.effect(rows), *self.effects, *arms])

    def with_errors(self, fitted: ConvergedFit) -> Self:
        """Looks for errors of the arms that are not free yet."""
        problem, fit = fitted.problem, fitted.fit
        likelihood = robot_likelihood(problem, fit.state, fit.noise)
        arms = {
            name: arm
            if arm.frees_errors(freely=self.freely)
            else arm.with_errors(likelihood, problem.robots.index(name))
            for name, arm in self.arms.items()
        }
        return replace(self, arms=arms)

    @property
    def poses_alone(self) -> dict[str, RobotArm]:
        """The arms whose joints are not known."""
        return {name: arm for name, arm in self.arms.items() if not arm.is_modelled}

    def covariance_by_posture(self, fitted: ConvergedFit) -> FloatArray:
        """(p, p) a fit's covariance, errors of arms without joint angles being what they may be.

        These are taken for noise, and weighed by `find_pose_errors`.
        """
        problem, alone = fitted.problem, self.poses_alone
        for arm in alone.values():
            problem = arm.without_errors(problem)
        values, free = problem.start_values.copy(), len(fitted.seen.free)
        values[:free] = fitted.fit.state.values[:free]
        fit = fit_problem(problem, State(fitted.fit.state.edges, values))
        found = fitted_covariance(problem, fit.state, fit.noise)
        for robot in alone:
            errors = find_pose_errors(problem, fit.state, fit.noise, robot)
            if errors is not None:
                found += misfit_covariance(problem, fit.state, fit.noise, robot, errors)
        return found

    def freed(self, *, freely: bool) -> Self:
        """Frees all errors of the arms that were found, or those alone that are estimated."""
        return replace(self, freely=freely)

    def looks(
        self, scenes: Mapping[str, Scene], views: Mapping[str, Sequence[ViewPoses]]
    ) -> CameraParameters:
        """Corners, and lenses and boards as they are stated.

        Args:
            scenes: What each camera looks at, by its frame.
            views: Its views, each with its one pose.
        """
        shares, problems, poses = self._shares, {}, {}
        for frame, scene in scenes.items():
            corners: dict[int, Corners] = {
                view.view: view.corners for view in views[frame] if view.corners is not None
            }
            problems[frame] = CornerProblem.of(scene, corners, shares)
            poses[frame] = np.array(
                [view.cam_from_target[0] for view in views[frame] if view.view in corners]
            )
        return CameraParameters.of(problems, poses)

    @property
    def _shares(self) -> dict[int, float]:
        """As how much of a view each counts for lenses and boards: those of one stop as one."""
        seen, tree = self.observed.observations, self.observed.tree
        pairs = list(zip(seen.observers, seen.observed, strict=True))
        parted = {pair: any(step.robot for step in tree.path(*pair)) for pair in set(pairs)}
        rows = zip(self.views, pairs, seen.stops.tolist(), strict=True)
        return repeat_shares(
            {index: (pair, stop if parted[pair] else None) for index, pair, stop in rows}
        )
