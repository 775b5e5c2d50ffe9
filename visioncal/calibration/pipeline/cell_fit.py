"""The fit of a cell: inliers, camera parameters and arms, with its views on the problem."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.cell import Cell, ObservationRow
from visioncal.calibration.stages.frame_model import CellFrameModel
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.validate import chain_rms_px
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.joint import ConvergedFit
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State


@dataclass(frozen=True, eq=False)
class CellFit:
    """The fit of a cell."""

    cell: Cell  # The cell; its rows are the observations in the fit's order.
    inlier_fit: InlierFit  # The inliers, their fit, and the frames that moved.
    # Linearised corners of lenses and boards; None without images.
    linearised_corners: LinearisedCorners | None
    poses: tuple[ViewPoses, ...]  # The pose chosen for each row.
    unconnected: tuple[str, ...]  # Frames that no observation links to the rest.
    arms: Mapping[str, RobotArm]  # The robots' arms, as far as they were calibrated.
    level: str  # The requested calibration level of the arms.
    # Errors of clocks, and those that grow with time, reach or gravity.
    other_effects: tuple[Effect, ...]
    solver: str = "joint"  # The solver of the edges.

    @property
    def inlier_problem(self) -> Problem:
        """The problem of the inliers."""
        return self.inlier_fit.part

    @property
    def frame_model(self) -> CellFrameModel:
        """The frames' model of the joint fit."""
        agreed, views = self.inlier_fit, [row.view for row in self.cell.rows]
        return CellFrameModel(
            agreed.problem, agreed.used, views, self.arms, self.other_effects, agreed.fit.noise
        )

    @property
    def frames(self) -> dict[str, FloatArray]:
        """Poses (4, 4) of the unknown frames in their parents."""
        return self.inlier_fit.problem.frames(self.inlier_fit.fit.state)

    def with_arm_poses(self) -> Self:
        """Replaces the robots' poses by those of their arms."""
        problem, arms = self.inlier_fit.problem, self.arms.items()
        poses = {**problem.poses, **{name: arm.poses for name, arm in arms}}
        inlier_fit = replace(self.inlier_fit, problem=replace(problem, poses=poses))
        return replace(self, inlier_fit=inlier_fit)

    def with_joint_fit(self, model: CellFrameModel, fitted: ConvergedFit) -> Self:
        """Takes over a joint fit of lenses, boards and frames."""
        problem = model.full_problem(fitted.linearised)
        inlier_fit = replace(self.inlier_fit, problem=problem, fit=fitted.fit)
        corners, arms = fitted.linearised, model.arms
        return replace(self, inlier_fit=inlier_fit, linearised_corners=corners, arms=arms)

    @property
    def joint_fit(self) -> ConvergedFit | None:
        """The fit of lenses and boards with the inliers; None without images."""
        seen = self.linearised_corners
        if seen is None:
            return None
        return ConvergedFit(seen, self.inlier_problem, self.inlier_fit.fit)

    @property
    def residual_px(self) -> dict[str, float]:
        """Standard deviation of corner residuals of each camera, per axis [px]."""
        if self.linearised_corners is None:
            return {}
        optics, sigmas_px = self.linearised_corners.camera_parameters, {}
        for (camera, problem), corners in zip(
            optics.problems.items(), self.linearised_corners.compressed, strict=True
        ):
            unknowns = problem.unknowns(corners)
            sigmas_px[camera] = problem.stack.shown_px(corners.residuals, unknowns)
        return sigmas_px

    @property
    def camera_parameters(self) -> CameraParameters | None:
        """Estimated lenses and boards; None without images."""
        return self.camera_parameters_at(self.inlier_fit.fit.state)

    def camera_parameters_at(self, state: State) -> CameraParameters | None:
        """Lenses and boards at a state; None without images."""
        if self.linearised_corners is None:
            return None
        free = self.linearised_corners.free
        values = self.inlier_fit.problem.values_of(LENSES, state)[: len(free)]
        return self.linearised_corners.camera_parameters.with_values(free, values)

    def pixels(
        self,
        rows: Sequence[ObservationRow],
        views: Sequence[ViewPoses],
        poses: FloatArray,
        state: State,
    ) -> FloatArray:
        """Reprojection errors (m,) [px] of views, given (m, 4, 4) poses of their targets."""
        optics = self.camera_parameters_at(state)
        if optics is None:
            return np.full(len(rows), np.nan)
        lenses = {problem: optics.camera(problem) for problem in optics.problems}
        cameras = [lenses.get(row.seer) for row in rows]
        return chain_rms_px([view.corners for view in views], poses, cameras, optics.points)

    @property
    def lens_columns(self) -> slice:
        """The problem's columns of lenses and boards, and of lens errors beyond their models."""
        return self.inlier_fit.problem.effect_columns.get(LENSES, slice(0, 0))

    @property
    def field_columns(self) -> IntArray:
        """The problem's columns of lens errors beyond their models."""
        columns, corners = self.lens_columns, self.linearised_corners
        free = 0 if corners is None else len(corners.free)
        return np.arange(columns.start + free, columns.stop)

    def columns_of(self, indices: IntArray) -> IntArray:
        """The problem's columns of free values of lenses and boards, given their indices."""
        free = np.zeros(0) if self.linearised_corners is None else self.linearised_corners.free
        return np.asarray(self.lens_columns.start + np.searchsorted(free, indices))


def within(indices: IntArray, part: slice) -> IntArray:
    """Those of ascending indices that lie in a slice."""
    return np.asarray(indices[(indices >= part.start) & (indices < part.stop)])
