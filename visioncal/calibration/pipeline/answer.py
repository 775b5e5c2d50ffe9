"""The answer: a fit with its covariance, and what speaks for and against it; held-back views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.calibration.pipeline.arm_results import (
    beside_steps,
    covariance_beside_noise,
    joint_offsets,
)
from visioncal.calibration.pipeline.budget import budget_mm, left_out, middles_of
from visioncal.calibration.pipeline.fault_messages import (
    PoseFault,
    Version,
    movements,
    pose_faults,
    reasons,
    residuals,
    versions,
)
from visioncal.calibration.pipeline.lens_fields import LensErrors, lens_errors
from visioncal.calibration.pipeline.solved import Solved
from visioncal.calibration.pipeline.starting import problem_of, sensors_of, targets_of
from visioncal.calibration.stages.arms import ArmFound
from visioncal.calibration.stages.cell import Cell, ObservationRow
from visioncal.calibration.stages.clock_offset import ClockOffset, FoundDelay
from visioncal.calibration.stages.clock_sweep import ClockPair
from visioncal.calibration.stages.clocks import clock_effects
from visioncal.calibration.stages.diagnose import ResidualTest, misfits
from visioncal.calibration.stages.kinematics import unseen_views
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.pose_ambiguity import choose_by, chosen
from visioncal.calibration.stages.validate import HeldOut, apart
from visioncal.core.choices import Convention
from visioncal.core.types import FloatArray
from visioncal.estimation.chain import scatter
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.intervals import noise_intervals
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.poses import fit_poses
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, covariance_of, fit_problem
from visioncal.results import HELD_BACK, Edge, Moved, ViewResult
from visioncal.results.arm import UnseenView


@dataclass(frozen=True, eq=False)
class Answer:
    """A fit with its covariance, and what speaks for and against it.

    Attributes:
        solved: The fit.
        problem: The observations in it.
        covariance: (p, p) of its unknowns, with all that counts beside noise.
        beside: (p, p) what that is, by its source.
        lenses: What lenses do beyond their models, by camera.
        misfits: What the residuals of each robot's stops show beyond noise.
        arms: What the stops determine of the arms, by robot.
        held_out: Residuals of observations that were left out of the fit in turn.
        moved: What moved, in the order of time.
        faults: What wrong poses of robots explain.
        views: What became of each observation.
        sigmas: Estimated standard deviations, by frame or robot and by name.
    """

    solved: Solved
    problem: Problem
    covariance: FloatArray
    beside: Mapping[str, FloatArray]
    lenses: Mapping[str, LensErrors]
    misfits: Mapping[str, ResidualTest]
    arms: Mapping[str, ArmFound]
    held_out: HeldOut
    moved: tuple[Moved, ...]
    faults: tuple[PoseFault, ...]
    views: tuple[ViewResult, ...]
    sigmas: Mapping[str, Mapping[str, float]]

    @property
    def fit(self) -> Solution:
        """The unknowns and the noise."""
        return self.solved.agreed.fit

    @property
    def state(self) -> State:
        """The unknowns."""
        return self.fit.state

    @property
    def noise(self) -> Noise:
        """The levels of robots and sensors."""
        return self.fit.noise

    @cached_property
    def versions(self) -> dict[str, Version]:
        """All unknown frames over time, by their names in the problem."""
        return versions(self.solved)

    @cached_property
    def edges(self) -> dict[str, Edge]:
        """The estimated transforms by the frames that they place, as the result names these."""
        found, edges = {}, self.state.edges
        for key, at in self.problem.unknown.items():
            block = self.covariance[6 * at : 6 * at + 6, 6 * at : 6 * at + 6]
            found[self.versions[key].name] = Edge(edges[at], block)
        return found

    @property
    def last_edges(self) -> dict[str, Edge]:
        """The edges of frames at their last places."""
        named = self.versions.values()
        return {
            version.frame: self.edges[version.frame]
            for version in named
            if version.name == version.frame
        }

    def clocks(self, looked: Observed) -> dict[ClockPair, ClockOffset]:
        """The clocks as the fit has them, where it estimates them."""
        return {
            pair: self._fitted_clock(pair, clock.clock) for pair, clock in looked.clocks.items()
        }

    def _fitted_clock(self, pair: ClockPair, clock: ClockOffset) -> ClockOffset:
        found = self._fitted_time(pair.effect)
        if found is None:
            return clock
        late_s, sigma_s = found
        return replace(
            clock,
            camera_minus_robot_s=clock.camera_minus_robot_s + late_s,
            sigma_s=sigma_s,
            delays=tuple(self._fitted_delay(pair, delay) for delay in clock.delays),
        )

    def _fitted_delay(self, pair: ClockPair, delay: FoundDelay) -> FoundDelay:
        found = self._fitted_time(pair.delay(delay.of))
        if found is None:
            return delay
        late_s, sigma_s = found
        return replace(delay, time_s=delay.time_s + late_s, sigma_s=sigma_s)

    def _fitted_time(self, effect: str) -> tuple[float, float] | None:
        """By how much a time is later in the fit, and its sigma [s]; None where it is not in it."""
        columns = self.problem.effect_columns.get(effect)
        if columns is None:
            return None
        (late_s,) = self.problem.values_of(effect, self.state)
        return float(late_s), float(np.sqrt(self.covariance[columns.start, columns.start]))

    @cached_property
    def budget_mm(self) -> dict[str, dict[str, float]]:
        """Sigmas of each frame's place in its parent, by the frame and by source [mm]."""
        found = budget_mm(self.solved, self.beside)
        return {self.versions[key].name: sigmas for key, sigmas in found.items()}

    @cached_property
    def intervals(self) -> FloatArray:
        """(r, 2, 2) 95 % intervals of the robots' noise; see `noise_intervals`."""
        return noise_intervals(self.problem, self.state, self.noise)


def answer_of(
    cell: Cell, looked: Observed, solved: Solved, convention: Convention | None
) -> Answer:
    """Examines a fit.

    Args:
        cell: The cell as it was read.
        looked: What was observed in it.
        solved: The fit of what of it is tied.
        convention: Of the joint table in which calibrated arms' numbers are given.
    """
    part, fit = solved.part, solved.agreed.fit
    # A closed form is not at rest, and that would pass for a misfit.
    at_rest = fit if solved.solver == "joint" else fit_problem(part, fit.state)
    arms = {
        name: arm.errors for name, arm in solved.arms.items() if not arm.is_modelled and arm.errors
    }
    offsets = joint_offsets(solved.arms)
    found = misfits(part, at_rest, arms, offsets)
    is_fit = solved.solver == "joint"
    solved = replace(solved, arms=beside_steps(solved.arms, part, fit, found))
    beside = covariance_beside_noise(part, fit, solved.arms, found, offsets, is_fit=is_fit)
    covariance = sum(beside.values(), covariance_of(part, fit))
    faults, held_out = pose_faults(solved), left_out(solved)
    return Answer(
        solved,
        part,
        covariance,
        beside,
        lens_errors(solved),
        found,
        _arms_found(solved, covariance, convention),
        held_out,
        movements(solved),
        faults,
        _views(looked, cell, solved, held_out, faults),
        _sigmas(solved),
    )


def _arms_found(
    solved: Solved, covariance: FloatArray, convention: Convention | None
) -> dict[str, ArmFound]:
    """What the stops determine of the arms, by robot."""
    agreed, middles = solved.agreed, middles_of(solved.cell)
    part = solved.part
    return {
        name: arm.found(part, agreed.fit, covariance, middles, convention)
        for name, arm in solved.arms.items()
    }


def _sigmas(solved: Solved) -> dict[str, dict[str, float]]:
    """Estimated standard deviations: of robots by name, of cameras and instruments by frame."""
    fit, problem = solved.agreed.fit, solved.agreed.problem
    found = {
        robot: {
            "translation_mm": 1e3 * float(sigma_m),
            "rotation_deg": float(np.rad2deg(sigma_rad)),
        }
        for robot, (sigma_rad, sigma_m) in zip(problem.robots, fit.noise.robots, strict=True)
    }
    if solved.seen is not None:
        pairs = zip(solved.seen.looks.problems, solved.seen.sigmas_px, strict=True)
        found |= {frame: {"pixel_px": sigma} for frame, sigma in pairs}
    sensors = dict.fromkeys(
        (*sensors_of(solved.cell, solved.poses), *(row.seer for row in solved.cell.rows))
    )
    for frame, level in zip(sensors, fit.noise.sensors.tolist(), strict=False):
        found[frame] = {**found.get(frame, {}), "level": level}
    return found


def _views(
    looked: Observed, cell: Cell, solved: Solved, held_out: HeldOut, faults: Sequence[PoseFault]
) -> tuple[ViewResult, ...]:
    """What became of each observation, in the order of the session's rows."""
    rows, used = solved.cell.rows, solved.agreed.used
    away, why = _away(solved), reasons(solved, faults)
    rms_px = solved.chain_px(np.arange(len(rows)), solved.agreed.fit.state)
    unseen = np.full((len(rows), 3), np.nan)
    unseen[used] = np.stack(
        [1e3 * held_out.away_m, np.rad2deg(held_out.away_rad), held_out.rms_px], axis=1
    )
    found = {}
    for at, row in enumerate(rows):
        mm, deg, px = _known(np.append(away[at], rms_px[at]))
        corners = solved.poses[at].corners
        found[row.view] = ViewResult(
            row.view,
            bool(used[at]),
            why.get(row.view, ""),
            None if corners is None else len(corners.ids),
            px,
            mm,
            deg,
            row.seer,
            row.seen,
            solved.cell.stops[row.station],
            *_known(unseen[at]),
        )
    found |= held_views(solved, looked)
    lost = solved.cell.reasons
    for observation in cell.session.observations:
        number = observation.view.number
        if number not in found and not observation.view.is_of_lens:
            stop = (
                cell.stops[observation.station] if observation.station < len(cell.stops) else number
            )
            why_not = lost.get(number, "")
            found[number] = ViewResult(
                number,
                used=False,
                reason=why_not,
                seer=observation.seer,
                seen=observation.seen,
                stop=stop,
            )
    return tuple(
        found[index] for index in (view.number for view in cell.session.views) if index in found
    )


def _known(figures: FloatArray) -> list[float | None]:
    """Figures, None in the place of those that are not known."""
    return [value if np.isfinite(value) else None for value in figures.tolist()]


def _away(solved: Solved) -> FloatArray:
    """(n, 2) residuals of the observations [mm], [deg]."""
    # Of one camera and one robot it is how far each places its target from where those that are
    # used do on average; of a whole cell, how far it is from what the rest predicts.
    if solved.cell.mount is None:
        return residuals(solved)
    problem = solved.agreed.problem
    away_m, away_rad = scatter(problem, solved.part, solved.agreed.fit.state)
    turned = problem.observations.has_rotation
    return np.stack([1e3 * away_m, np.where(turned, np.rad2deg(away_rad), np.nan)], axis=1)


@dataclass(frozen=True, eq=False)
class Held:
    """The observations that are held back, as the lenses and boards of the fit have them.

    Attributes:
        rows: The h observations.
        views: Their poses.
        problem: What they measured, with the unknowns of the fit.
    """

    rows: tuple[ObservationRow, ...]
    views: tuple[ViewPoses, ...]
    problem: Problem


def held_back(solved: Solved, looked: Observed) -> Held | None:
    """What is held back and can be compared with the fit; None for nothing."""
    cell, state, placed = solved.cell, solved.agreed.fit.state, solved.cell.tree.branches.keys()
    rows = [row for row in cell.held if row.view in looked.poses and {row.seer, row.seen} <= placed]
    if not rows:
        return None
    solved = replace(solved, cell=replace(cell, rows=tuple(rows)))
    views = [looked.poses[row.view] for row in rows]
    predicted = _problem(solved, looked, [chosen(view, 0, None) for view in views]).predicted(state)
    targets = targets_of(cell)
    views = [
        choose_by(view, pose, targets.get(row.seen))
        for view, pose, row in zip(views, predicted, rows, strict=True)
    ]
    looks = solved.looks
    for at, (view, row) in enumerate(zip(views, rows, strict=True)):
        if looks is not None and view.corners is not None and row.seer in looks.problems:
            stack, camera = CornerStack.of({view.view: view.corners}, looks.points), row.seer
            poses = fit_poses(stack, looks.camera(camera), view.cam_from_target).cam_from_target
            views[at] = replace(view, cam_from_target=poses)
    return Held(tuple(rows), tuple(views), _problem(solved, looked, views))


def held_views(solved: Solved, looked: Observed) -> dict[int, ViewResult]:
    """How far such observations are from what the rest of the cell predicts, by view."""
    held = held_back(solved, looked)
    if held is None:
        return {}
    state, problem = solved.agreed.fit.state, held.problem
    away_m, away_rad = apart(problem, state)
    if solved.cell.mount is not None:
        among = set(solved.part.observations.observed)
        known = np.array([name in among for name in problem.observations.observed])
        from_mean = scatter(problem.subset(known), solved.part, state)
        away_m[known] = from_mean[0]
        away_rad[known] = np.where(np.isnan(away_rad[known]), np.nan, from_mean[1])
    rms_px = solved.pixels(held.rows, held.views, problem.predicted(state), state)
    figures = np.stack([1e3 * away_m, np.rad2deg(away_rad), rms_px], axis=1)
    found = {}
    for row, seen, each in zip(held.rows, held.views, figures, strict=True):
        mm, deg, px = _known(each)
        stop = solved.cell.stops[row.station]
        count = None if seen.corners is None else len(seen.corners.ids)
        found[row.view] = ViewResult(
            row.view, False, HELD_BACK, count, px, mm, deg, row.seer, row.seen, stop
        )
    return found


def held_by_both_arms(solved: Solved, looked: Observed, robot: str) -> tuple[UnseenView, ...]:
    """How far what is held back is off by a robot's nominal arm with its own fit, and by ours."""
    arm, held = solved.arms[robot], held_back(solved, looked)
    if held is None or arm.kinematics is None:
        return ()
    stated = arm.without_errors(held.problem)
    stated = arm.stated(stated) or stated
    was, now = (
        np.stack(apart(problem, _in(problem, state))[::-1], axis=1)
        for problem, state in (
            (stated, arm.kinematics.nominal.fit.state),
            (held.problem, solved.agreed.fit.state),
        )
    )
    views = [row.view for row in held.rows]
    return unseen_views(views, was, now, np.isfinite(now[:, 0]))


def _in(problem: Problem, state: State) -> State:
    """The state of an earlier fit, of other random coefficients of lenses: these move nothing."""
    if not problem.effects:
        return state
    first = problem.effects[0]
    behind = len(problem.start_values) - len(first)
    values = [state.values[: len(first.determined)], np.zeros(first.random)]
    return State(state.edges, np.concatenate([*values, state.values[len(state.values) - behind :]]))


def _problem(solved: Solved, looked: Observed, views: Sequence[ViewPoses]) -> Problem:
    """The problem of a cell's rows, with the unknowns of the fit."""
    fitted = solved.agreed.problem
    problem = replace(problem_of(solved.cell, views), tree=fitted.tree, poses=fitted.poses)
    seen, none = problem.observations, np.zeros(len(problem), dtype=bool)
    for move in solved.agreed.moves:
        seen = seen.renamed(move.frame, move.twin, seen.stops >= move.stop)
    late = {effect.name: effect for effect in clock_effects(solved.cell, looked.clocks)}
    effects = [
        late.get(effect.name)
        or replace(effect, by_sensor=None, concerned=None if effect.concerned is None else none)
        for effect in fitted.effects
    ]
    return replace(problem, observations=seen, points=fitted.points).with_effects(effects)
