"""The fit of a whole cell, as the solver hands it on."""

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
    """The fit of a whole cell.

    Attributes:
        cell: The cell; its rows are the observations in the fit's order.
        agreed: The fit, what it uses, and what moved.
        seen: What all corners say of lenses and boards; None without images.
        poses: Each row's one pose.
        untied: Frames that nothing ties to the rest.
        arms: The robots' arms, as far as they were calibrated.
        asked: How far that was to be.
        late: The errors of clocks, as effects.
        turned: How images of views that disagree were turned or mirrored, by view.
        solver: By which solver the edges are.
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
        """The observations that the fit was made from."""
        return self.agreed.part

    @property
    def side(self) -> FramesSide:
        """The frames' side of the joint fit."""
        problem, views = self.agreed.problem, [row.view for row in self.cell.rows]
        used, noise = self.agreed.used, self.agreed.fit.noise
        return FramesSide(problem, used, views, self.arms, self.late, noise)

    @property
    def frames(self) -> dict[str, FloatArray]:
        """Where the unknown frames are."""
        return self.agreed.problem.frames(self.agreed.fit.state)

    def posed(self) -> Self:
        """The same with the robots' poses by their arms."""
        poses = {name: arm.poses for name, arm in self.arms.items()}
        problem = self.agreed.problem
        problem = replace(problem, poses={**problem.poses, **poses})
        return replace(self, agreed=replace(self.agreed, problem=problem))

    def settled(self, side: FramesSide, fitted: ConvergedFit) -> Self:
        """The same as lenses, boards and frames were fitted with a side."""
        agreed = replace(self.agreed, problem=side.whole(fitted.seen), fit=fitted.fit)
        return replace(self, agreed=agreed, seen=fitted.seen, arms=side.arms)

    def found_of_looks(self, covariance: FloatArray) -> Iterator[Finding]:
        """Says what was found of lenses and boards; see `stages.fit_messages`."""
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
        """Each camera's noise of a corner by its residuals, per axis, whatever is stated [px]."""
        if self.seen is None:
            return {}
        looks, found = self.seen.looks, {}
        for (camera, corner_problem), corners in zip(
            looks.problems.items(), self.seen.compressed, strict=True
        ):
            moving = np.flatnonzero(np.isin(looks.places(camera), self.seen.moving))
            unknowns = corner_problem.unknowns(corners, moving)
            found[camera] = corner_problem.stack.shown_px(corners.residuals, unknowns)
        return found

    @property
    def looks(self) -> CameraParameters | None:
        """Lenses and boards as they were found; None without images."""
        return self.looks_at(self.agreed.fit.state)

    def looks_at(self, state: State) -> CameraParameters | None:
        """Lenses and boards as some state has them; None without images."""
        if self.seen is None:
            return None
        free = self.seen.free
        found = self.agreed.problem.values_of(LENSES, state)[: len(free)]
        return self.seen.looks.with_values(free, found)

    def chain_px(self, rows: IntArray, state: State) -> FloatArray:
        """Reprojection errors (m,) [px] of some observations through the chain; NaN for none.

        Args:
            rows: (m,) the observations.
            state: The unknowns of the fit, or those of another one to a part of them.
        """
        chosen = np.isin(np.arange(len(self.cell.rows)), rows)
        poses = self.agreed.problem.subset(chosen).predicted(state)
        mine = [self.cell.rows[index] for index in rows]
        return self.pixels(mine, [self.poses[index] for index in rows], poses, state)

    def pixels(
        self,
        rows: Sequence[ObservationRow],
        views: Sequence[ViewPoses],
        poses: FloatArray,
        state: State,
    ) -> FloatArray:
        """Reprojection errors (m,) [px] of views whose targets are at (m, 4, 4) poses."""
        looks = self.looks_at(state)
        if looks is None:
            return np.full(len(rows), np.nan)
        lenses = {problem: looks.camera(problem) for problem in looks.problems}
        cameras = [lenses.get(row.seer) for row in rows]
        return chain_rms_px([view.corners for view in views], poses, cameras, looks.points)

    @property
    def lens_columns(self) -> slice:
        """The problem's columns of lenses and boards, and of what lenses do beyond their models."""
        return self.agreed.problem.effect_columns.get(LENSES, slice(0, 0))

    @property
    def field_columns(self) -> IntArray:
        """The problem's columns of what lenses do beyond their models."""
        mine, free = self.lens_columns, 0 if self.seen is None else len(self.seen.free)
        return np.arange(mine.start + free, mine.stop)

    def columns_of(self, places: IntArray) -> IntArray:
        """The problem's columns of free values of lenses and boards, by their places."""
        free = np.zeros(0) if self.seen is None else self.seen.free
        return np.asarray(self.lens_columns.start + np.searchsorted(free, places))


def within(places: IntArray, mine: slice) -> IntArray:
    """Those of some ascending places that lie in a slice."""
    return np.asarray(places[(places >= mine.start) & (places < mine.stop)])
