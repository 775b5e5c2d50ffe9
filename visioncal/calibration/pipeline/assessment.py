"""Examination of a fit: covariance, diagnosis, left-out residuals, held-back views."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from visioncal.calibration.pipeline.arm_results import (
    covariance_from_other_sources,
    joint_offsets,
    with_errors_beside_step,
    with_lasting_errors,
)
from visioncal.calibration.pipeline.budget import budget_mm, left_out, middles_of
from visioncal.calibration.pipeline.ended import as_it_ends, as_it_went
from visioncal.calibration.pipeline.starting import problem_of, sensors_of, targets_of
from visioncal.calibration.stages.arm_report import ArmReport, report_of
from visioncal.calibration.stages.cell import Cell, ObservationRow
from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.stages.clock_offset import ClockPair
from visioncal.calibration.stages.clocks import clock_effects
from visioncal.calibration.stages.likely_steps import steps_of, with_free_sizes
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.validate import HeldOutResiduals, pose_residuals
from visioncal.calibration.suspects.moved_views import PoseFault, later_part
from visioncal.calibration.suspects.outliers import explained_outliers, movements, versions
from visioncal.core.choices import Convention
from visioncal.core.types import FloatArray
from visioncal.estimation.chain import scatter
from visioncal.estimation.fit import Fit
from visioncal.estimation.intervals import noise_intervals
from visioncal.estimation.joint import BOARD_OR_ARM, between_boards_and_arm
from visioncal.estimation.moves import Creep, creep_effects
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import fit_problem
from visioncal.estimation.steps import Step
from visioncal.estimation.unknowns import EDGE, LENS, Unknown
from visioncal.results import HELD_BACK, Edge, Moved, ViewResult
from visioncal.results.sections import ClockResult, Intervals
from visioncal.vision.corners import CornerStack
from visioncal.vision.pnp import ViewPoses
from visioncal.vision.poses import fit_poses

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class FitAssessment:
    """A fit with its covariance and diagnosis."""

    cell_fit: CellFit  # The fit, with what it is of.
    fit: Fit  # The same with its covariance from all sources.
    # The same with what moved at once where it stood before and after: residuals and noise are its.
    went: CellFit
    steps: tuple[Step, ...]  # Steps that the residuals show, likeliest first.
    arms: Mapping[str, ArmReport]  # Findings about the arms, by robot.
    held_out: HeldOutResiduals  # Residuals of observations that were left out of the fit in turn.
    moved: tuple[Moved, ...]  # Frames that moved, in the order of time.
    faults: tuple[PoseFault, ...]  # Wrong poses and images that explain outliers.
    # Views left out that are off by no more than an arm's errors now and then.
    marginal: frozenset[int]
    views: tuple[ViewResult, ...]  # Result of each observation.
    # Estimated standard deviations, by frame or robot and by name.
    sigmas: Mapping[str, Mapping[str, float]]

    @cached_property
    def versions(self) -> dict[str, str]:
        """Names in the result of all unknown frames over time, by their names in the problem."""
        return versions(self.cell_fit)

    @cached_property
    def ended(self) -> Fit:
        """The fit as the session ends, for which picks come: see `as_it_ends`."""
        if self.cell_fit.solver != "joint":
            return self.fit
        later = None if self.steps else later_part(self.cell_fit)
        problem, steps = (self.fit.problem, self.steps) if later is None else later
        return as_it_ends(self.fit, problem, self.cell_fit.arms, steps)

    @cached_property
    def edges(self) -> dict[str, Edge]:
        """The estimated transforms, by the result's names of their child frames."""
        return {
            self.versions[frame]: Edge(matrix, self.ended.covariance((EDGE, frame)))
            for frame, matrix in self.ended.frames.items()
        }

    @property
    def last_edges(self) -> dict[str, Edge]:
        """The estimated transforms at the end of the session, by frame."""
        last = {key.partition("@")[0] for key in self.versions}
        return {frame: edge for frame, edge in self.edges.items() if frame in last}

    def clocks(self, observed: Observed) -> dict[ClockPair, ClockResult]:
        """Clock offsets, from the fit where it estimates them."""
        clocks = {}
        for pair, clocked in observed.clocks.items():
            clock = clocked.clock
            offset, readout = map(self._fitted_time, (pair.effect, pair.readout))
            if offset is not None:
                ahead_s, shutter = clock.camera_minus_robot_s + offset[0], clock.shutter
                if shutter is not None and readout is not None:
                    shutter = shutter.corrected(*readout)
                clock = replace(
                    clock, camera_minus_robot_s=ahead_s, sigma_s=offset[1], shutter=shutter
                )
            clocks[pair] = clock
        return clocks

    def _fitted_time(self, effect: str) -> tuple[float, float] | None:
        """Estimated correction of a time, and its sigma [s]; None where the fit has none."""
        unknown = Unknown.of_effect(effect)
        pairs = zip(self.fit.values(unknown), self.fit.sigmas(unknown), strict=True)
        return next(((float(value), float(sigma)) for value, sigma in pairs), None)

    @cached_property
    def budget_mm(self) -> dict[str, dict[str, float]]:
        """Standard deviations of each frame's position in its parent, by source [mm]."""
        budget = budget_mm(self.cell_fit, self.ended)
        return {self.versions[key]: sigmas for key, sigmas in budget.items()}

    @cached_property
    def sized(self) -> Fit:
        """The fit beside boards of any size, where it holds sizes: causes are judged by it."""
        return with_free_sizes(self.fit)

    @property
    def is_stepped(self) -> bool:
        """Whether the result is that after a step."""
        return self.went is not self.cell_fit

    @property
    def fit_of_noise(self) -> Fit:
        """The fit that residuals and noise are of."""
        return self.went.fit if self.is_stepped else self.fit

    @cached_property
    def sized_of_noise(self) -> Fit:
        """The same beside boards of any size."""
        return with_free_sizes(self.went.fit) if self.is_stepped else self.sized

    @cached_property
    def intervals(self) -> FloatArray:
        """(r, 2, 2) 95 % intervals of the robots' noise; see `estimation.intervals`."""
        fit = self.fit_of_noise
        return noise_intervals(fit.problem, fit.state, fit.noise)

    @property
    def noise_95(self) -> dict[str, Intervals]:
        """95 % intervals of the robots' noise levels, by robot and by name."""
        pairs = zip(self.fit.problem.robots, self.intervals.tolist(), strict=True)
        return {
            robot: {
                "translation_mm": (1e3 * metres[0], 1e3 * metres[1]),
                "rotation_deg": (math.degrees(rad[0]), math.degrees(rad[1])),
            }
            for robot, (rad, metres) in pairs
        }

    def of_robot(self, levels: Mapping[str, Mapping[str, _T]]) -> dict[str, _T]:
        """Figures on the noise of the only robot, or of robot and camera combined, by name."""
        problem = self.fit.problem
        of = "combined" if problem.is_combined else "robot"
        return {f"{of}_{name}": level for name, level in levels[problem.robots[0]].items()}


def assess_fit(
    cell: Cell, observed: Observed, cell_fit: CellFit, convention: Convention | None
) -> FitAssessment:
    """Examines a fit.

    Args:
        cell: The cell as it was read.
        observed: The observations in it.
        cell_fit: The fit of its connected part.
        convention: Joint table convention of calibrated arms' parameters.
    """
    fit = cell_fit.fit
    # A closed form is no minimum, which would pass for a misfit.
    is_fit = cell_fit.solver == "joint"
    errors = {
        name: arm.errors
        for name, arm in cell_fit.arms.items()
        if not arm.is_modelled and arm.errors
    }
    steps: tuple[Step, ...] = ()
    if not observed.misread:
        converged = fit.solution if is_fit else fit_problem(fit.problem, fit.state)
        offsets = joint_offsets(cell_fit.arms)
        converged_fit = replace(fit, solution=converged)
        steps = steps_of(converged_fit, errors, offsets, cell_fit.lens_changes)
        arms = with_errors_beside_step(cell_fit.arms, fit, steps)
        cell_fit = replace(cell_fit, arms=arms)
    by_source = covariance_from_other_sources(fit, cell_fit.arms, steps, is_fit=is_fit)
    if cell_fit.has_links and (between := between_boards_and_arm(fit, cell.session.boards)).any():
        by_source[BOARD_OR_ARM] = between
    fit = replace(with_lasting_errors(fit, cell_fit.arms) if is_fit else fit, by_source=by_source)
    went = as_it_went(cell_fit, steps) if is_fit else cell_fit
    held_out = left_out(went)
    (faults, reasons, marginal), middles = explained_outliers(cell_fit), middles_of(cell_fit.cell)
    return FitAssessment(
        cell_fit,
        fit,
        went,
        steps,
        {name: report_of(arm, fit, middles, convention) for name, arm in cell_fit.arms.items()},
        held_out,
        movements(cell_fit),
        faults,
        marginal,
        _views(observed, cell, went, held_out, reasons),
        _sigmas(went),
    )


def _sigmas(cell_fit: CellFit) -> dict[str, dict[str, float]]:
    """Estimated standard deviations of robots by name, and of cameras and instruments by frame."""
    fit, noise = cell_fit.fit, cell_fit.fit.noise
    of_robots = zip(fit.problem.robots, noise.robots.tolist(), strict=True)
    results = {
        robot: {"translation_mm": 1e3 * sigma_m, "rotation_deg": float(np.rad2deg(sigma_rad))}
        for robot, (sigma_rad, sigma_m) in of_robots
    }
    results |= {frame: {"pixel_px": sigma} for frame, sigma in fit.sigmas_px.items()}
    sensors = dict.fromkeys(
        (*sensors_of(cell_fit.cell, cell_fit.poses), *(row.seer for row in cell_fit.cell.rows))
    )
    for frame, level in zip(sensors, noise.sensors.tolist(), strict=False):
        results[frame] = {**results.get(frame, {}), "level": level}
    return results


@dataclass(frozen=True, eq=False)
class SeenRows:
    """Observations that can be compared with a fit, at its lenses and boards."""

    rows: tuple[ObservationRow, ...]  # The n observations.
    views: tuple[ViewPoses, ...]  # Their poses.
    problem: Problem  # Their problem, with the unknowns of the fit.
    is_held: bool = False  # Whether the session holds them back from the fit.

    def residuals(self, cell_fit: CellFit) -> FloatArray:
        """(n, 3) residuals from what the fit predicts, NaN for none [mm], [deg], [px].

        Those of one camera and one robot are the distances of the target, as each view places it,
        from its mean over the inliers.
        """
        problem, part, state = self.problem, cell_fit.fit.problem, cell_fit.fit.state
        predicted = problem.predicted(state)
        away_m, away_rad = pose_residuals(problem, state, predicted)
        if cell_fit.cell.session.has_one_pair:
            fitted = np.isin(problem.observations.observed, part.observations.observed)
            mean_m, mean_rad = scatter(problem.subset(fitted), part, state)
            away_m[fitted] = mean_m
            away_rad[fitted] = np.where(np.isnan(away_rad[fitted]), np.nan, mean_rad)
        px = cell_fit.pixels(self.rows, self.views, predicted, state)
        return np.stack([1e3 * away_m, np.rad2deg(away_rad), px], axis=1)


def seen_rows(cell_fit: CellFit, observed: Observed) -> Iterator[SeenRows]:
    """The observations of a fit, with its outliers, and held-back ones that compare with it."""
    cell, inliers = cell_fit.cell, cell_fit.inlier_fit
    yield SeenRows(cell.rows, cell_fit.poses, inliers.problem)
    state, frames = inliers.fit.state, cell.tree.branches.keys()
    rows = [
        row for row in cell.held if row.view in observed.poses and {row.seer, row.seen} <= frames
    ]
    if not rows:
        return
    cell_fit = replace(cell_fit, cell=replace(cell, rows=tuple(rows)))
    views = [observed.poses[row.view] for row in rows]
    first = _problem(cell_fit, observed, [view.chosen(0, None) for view in views])
    fit, targets = cell_fit.fit, targets_of(cell)
    for at, (row, pose) in enumerate(zip(rows, first.predicted(state), strict=True)):
        view = views[at].nearest(pose, targets.get(row.seen))
        if view.corners is not None and row.seer in fit.unknowns.of(LENS):
            stack = CornerStack.of({row.view: view.corners}, fit.camera_parameters.points)
            poses = fit_poses(stack, fit.camera(row.seer), view.cam_from_target)
            view = replace(view, cam_from_target=poses.cam_from_target)
        views[at] = view
    problem = _problem(cell_fit, observed, views)
    yield SeenRows(tuple(rows), tuple(views), problem, is_held=True)


def _views(
    observed: Observed,
    cell: Cell,
    cell_fit: CellFit,
    held_out: HeldOutResiduals,
    reasons: Mapping[int, str],
) -> tuple[ViewResult, ...]:
    """Result of each observation, in the order of the session's rows."""
    used = cell_fit.inlier_fit.used
    left_out = np.full((len(used), 3), np.nan)
    left_out[used] = np.stack(
        [1e3 * held_out.residual_m, np.rad2deg(held_out.residual_rad), held_out.rms_px], axis=1
    )
    results: dict[int, ViewResult] = {}
    for seen in seen_rows(cell_fit, observed):
        is_held = seen.is_held
        for at, (mm, deg, px) in enumerate(map(_finite_or_none, seen.residuals(cell_fit))):
            row, corners = seen.rows[at], seen.views[at].corners
            results[row.view] = ViewResult(
                row.view,
                not is_held and bool(used[at]),
                HELD_BACK if is_held else reasons.get(row.view, ""),
                None if corners is None else len(corners.ids),
                px,
                mm,
                deg,
                row.seer,
                row.seen,
                cell_fit.cell.stops[row.station],
                *_finite_or_none(left_out[at] if not is_held else np.full(3, np.nan)),
            )
    for observation in cell.session.observations:
        number, station = observation.view.number, observation.station
        if number not in results and not observation.view.is_of_lens:
            results[number] = ViewResult(
                number,
                used=False,
                reason=cell_fit.cell.reasons.get(number, ""),
                seer=observation.seer,
                seen=observation.seen,
                stop=cell.stops[station] if station < len(cell.stops) else number,
            )
    return tuple(results[view.number] for view in cell.session.views if view.number in results)


def _finite_or_none(figures: FloatArray) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in figures.tolist()]


def _problem(cell_fit: CellFit, observed: Observed, views: Sequence[ViewPoses]) -> Problem:
    """The problem of a cell's rows, with the unknowns of the fit."""
    fitted = cell_fit.inlier_fit.problem
    problem = replace(problem_of(cell_fit.cell, views), tree=fitted.tree, poses=fitted.poses)
    observations, none = problem.observations, np.zeros(len(problem), dtype=bool)
    for move in cell_fit.inlier_fit.moves:
        later = observations.stops >= move.stop
        observations = observations.renamed(move.frame, move.twin, later)
    problem = replace(problem, observations=observations, points=fitted.points)
    edges = State(cell_fit.fit.state.edges, np.zeros(0))
    creeps = [Creep.at(problem, edges, at.frame, at.rate) for at in creep_effects(fitted)]
    known = {
        effect.name: effect for effect in (*clock_effects(cell_fit.cell, observed.clocks), *creeps)
    }
    effects = [
        known.get(effect.name)
        or replace(
            effect, by_sensor=None, rows_concerned=None if effect.rows_concerned is None else none
        )
        for effect in fitted.effects
    ]
    return problem.with_effects(effects)
