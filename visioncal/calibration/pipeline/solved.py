"""The fit of a cell: inliers, camera parameters and arms, with its views on the problem."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.cell import Cell, ObservationRow
from visioncal.calibration.stages.fit_messages import found_of_looks
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.side import FramesSide
from visioncal.calibration.stages.turned_images import ImageTurn
from visioncal.calibration.stages.validate import chain_rms_px
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import Finding
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.joint import ConvergedFit
from visioncal.estimation.outliers import Agreed
from visioncal.estimation.parts import Effect, State
from visioncal.estimation.problem import Problem


@dataclass(frozen=True, eq=False)
class Solved:
    """The fit of a cell.

    Attributes:
        cell: The cell; its rows are the observations in the fit's order.
        agreed: The inliers, their fit, and the frames that moved.
        seen: Linearised corners of lenses and boards; None without images.
        poses: The pose chosen for each row.
        untied: Frames that no observation links to the rest.
        arms: The robots' arms, as far as they were calibrated.
        asked: The requested calibration level of the arms.
        late: The errors of clocks, as effects.
        turned: How images of outliers were turned or mirrored, by view.
        solver: The solver of the edges.
    """

    cell: Cell
    agreed: Agreed
    seen: LinearisedCorners | None
    poses: tuple[ViewPoses, ...]
    untied: tuple[str, ...]
    arms: Mapping[str, RobotArm]
    asked: str
    late: tuple[Effect, ...]
    turned: Mapping[int, ImageTurn] = field(default_factory=dict)
    solver: str = "joint"

    @property
    def part(self) -> Problem:
        """The problem of the inliers."""
        return self.agreed.part

    @property
    def side(self) -> FramesSide:
        """The frames' side of the joint fit."""
        agreed, views = self.agreed, [row.view for row in self.cell.rows]
        return FramesSide(
            agreed.problem, agreed.used, views, self.arms, self.late, agreed.fit.noise
        )

    @property
    def frames(self) -> dict[str, FloatArray]:
        """Poses (4, 4) of the unknown frames in their parents."""
        return self.agreed.problem.frames(self.agreed.fit.state)

    def posed(self) -> Self:
        """Replaces the robots' poses by those of their arms."""
        problem, arms = self.agreed.problem, self.arms.items()
        poses = {**problem.poses, **{name: arm.poses for name, arm in arms}}
        return replace(self, agreed=replace(self.agreed, problem=replace(problem, poses=poses)))

    def settled(self, side: FramesSide, fitted: ConvergedFit) -> Self:
        """Takes over a joint fit of lenses, boards and frames."""
        agreed = replace(self.agreed, problem=side.whole(fitted.seen), fit=fitted.fit)
        return replace(self, agreed=agreed, seen=fitted.seen, arms=side.arms)

    def found_of_looks(self, covariance: FloatArray) -> Iterator[Finding]:
        """Findings on lenses and boards; see `stages.fit_messages`."""
        if self.seen is not None:
            fitted = ConvergedFit(self.seen, self.part, self.agreed.fit)
            arms, stated = self.arms.values(), None
            if any(arm.model is not None for arm in arms):
                stated = self.part
                for arm in arms:
                    stated = arm.without_errors(stated)
            yield from found_of_looks(self.side, fitted, covariance, stated)

    @property
    def shown_px(self) -> dict[str, float]:
        """Standard deviation of corner residuals of each camera, per axis [px]."""
        if self.seen is None:
            return {}
        looks, sigmas_px = self.seen.looks, {}
        for (camera, problem), corners in zip(
            looks.problems.items(), self.seen.compressed, strict=True
        ):
            moving = np.flatnonzero(np.isin(looks.places(camera), self.seen.moving))
            unknowns = problem.unknowns(corners, moving)
            sigmas_px[camera] = problem.stack.shown_px(corners.residuals, unknowns)
        return sigmas_px

    @property
    def looks(self) -> CameraParameters | None:
        """Estimated lenses and boards; None without images."""
        return self.looks_at(self.agreed.fit.state)

    def looks_at(self, state: State) -> CameraParameters | None:
        """Lenses and boards at a state; None without images."""
        if self.seen is None:
            return None
        free = self.seen.free
        values = self.agreed.problem.values_of(LENSES, state)[: len(free)]
        return self.seen.looks.with_values(free, values)

    def chain_px(self, rows: IntArray, state: State) -> FloatArray:
        """Reprojection errors (m,) [px] of some observations through the chain; NaN for none.

        Args:
            rows: (m,) indices of the observations.
            state: The unknowns of this fit, or of one to a subset of the observations.
        """
        chosen = np.isin(np.arange(len(self.cell.rows)), rows)
        poses = self.agreed.problem.subset(chosen).predicted(state)
        cell_rows = [self.cell.rows[index] for index in rows]
        return self.pixels(cell_rows, [self.poses[index] for index in rows], poses, state)

    def pixels(
        self,
        rows: Sequence[ObservationRow],
        views: Sequence[ViewPoses],
        poses: FloatArray,
        state: State,
    ) -> FloatArray:
        """Reprojection errors (m,) [px] of views, given (m, 4, 4) poses of their targets."""
        looks = self.looks_at(state)
        if looks is None:
            return np.full(len(rows), np.nan)
        lenses = {problem: looks.camera(problem) for problem in looks.problems}
        cameras = [lenses.get(row.seer) for row in rows]
        return chain_rms_px([view.corners for view in views], poses, cameras, looks.points)

    @property
    def lens_columns(self) -> slice:
        """The problem's columns of lenses and boards, and of lens errors beyond their models."""
        return self.agreed.problem.effect_columns.get(LENSES, slice(0, 0))

    @property
    def field_columns(self) -> IntArray:
        """The problem's columns of lens errors beyond their models."""
        columns, free = self.lens_columns, 0 if self.seen is None else len(self.seen.free)
        return np.arange(columns.start + free, columns.stop)

    def columns_of(self, indices: IntArray) -> IntArray:
        """The problem's columns of free values of lenses and boards, given their indices."""
        free = np.zeros(0) if self.seen is None else self.seen.free
        return np.asarray(self.lens_columns.start + np.searchsorted(free, indices))


def within(indices: IntArray, part: slice) -> IntArray:
    """Those of ascending indices that lie in a slice."""
    return np.asarray(indices[(indices >= part.start) & (indices < part.stop)])
