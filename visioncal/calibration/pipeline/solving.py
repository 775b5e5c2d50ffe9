"""From what was seen to the fit of the whole cell: start, agreement, lenses and boards."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from visioncal.calibration.pipeline.arm_results import (
    arms_of,
    joint_offsets,
    with_drifts,
    with_errors,
    with_pose_errors,
)
from visioncal.calibration.pipeline.network_ties import ambiguous_error, untied_robots
from visioncal.calibration.stages.arms import RobotArm, check_arms, effects_of
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.clocks import clock_effects
from visioncal.calibration.stages.fit_messages import found_of_looks
from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.calibration.stages.init_frames import init_frames
from visioncal.calibration.stages.kinematics import check_asked
from visioncal.calibration.stages.observed import Observed, nothing_seen
from visioncal.calibration.stages.pairwise import AGREE_M
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.priors import loosened, without_most_contradicted
from visioncal.calibration.stages.refine import lens_levels, refined
from visioncal.calibration.stages.side import FramesSide
from visioncal.calibration.stages.turned_images import Turned, turned_how
from visioncal.calibration.stages.validate import chain_rms_px, predict_corners
from visioncal.core.choices import SolverName
from visioncal.core.errors import ConvergenceError, DegenerateError
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Mount, Target
from visioncal.core.verdict import Finding
from visioncal.estimation.arm import LEVER_M, rows_of
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.joint import Fitted, target_sizes
from visioncal.estimation.joint import settle as settle_looks
from visioncal.estimation.lens_field import LensLevels
from visioncal.estimation.moves import log_gain, slipped_joint
from visioncal.estimation.observability import (
    FEWEST_VIEWS,
    check_observability,
    refuse_too_few,
)
from visioncal.estimation.outliers import Agreed, agree, all_as_inliers, settle
from visioncal.estimation.parts import Effect, Observations, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    estimate_noise,
    fit_problem,
    solve_problem,
    starting_noise,
)
from visioncal.session.frames import frame_name

# Arms are linearised anew so often, or until their errors move by less, which is far below any
# arm's repeatability.
_ROUNDS, _AT_REST_RAD = 4, 1e-7
# What targets' sizes are known to while it is sought what agrees, as a share: prints are scaled to
# fit a page.
_SIZE_SIGMA = 0.03
# Where all goes astray, boards that are off by more begin as they were found.
_FAR_SIZE = 5e-3
# Covariance of a pose that was given without one, but for its level [rad^2, m^2].
_NOMINAL = np.diag(np.repeat([1e-3, 5e-4], 3) ** 2)


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
    turned: Mapping[int, Turned] = field(default_factory=dict)
    solver: str = "joint"

    @property
    def part(self) -> Problem:
        """The observations that the fit was made from."""
        return self.agreed.problem.subset(self.agreed.used)

    @property
    def side(self) -> FramesSide:
        """The frames' side of the joint fit."""
        problem, views = self.agreed.problem, [it.view for it in self.cell.rows]
        used, noise = self.agreed.used, self.agreed.fit.noise
        return FramesSide(problem, used, views, self.arms, self.late, noise)

    @property
    def frames(self) -> dict[str, FloatArray]:
        """Where the unknown frames are."""
        return dict(zip(self.agreed.problem.unknown, self.agreed.fit.state.edges, strict=True))

    def posed(self) -> Self:
        """The same with the robots' poses by their arms."""
        poses = {name: it.poses for name, it in self.arms.items()}
        problem = self.agreed.problem
        problem = replace(problem, poses={**problem.poses, **poses})
        return replace(self, agreed=replace(self.agreed, problem=problem))

    def settled(self, side: FramesSide, fitted: Fitted) -> Self:
        """The same as lenses, boards and frames were fitted with a side."""
        agreed = replace(self.agreed, problem=side.whole(fitted.seen), fit=fitted.fit)
        return replace(self, agreed=agreed, seen=fitted.seen, arms=side.arms)

    def found_of_looks(self, covariance: FloatArray) -> Iterator[Finding]:
        """Says what was found of lenses and boards; see `stages.fit_messages`."""
        if self.seen is not None:
            fitted = Fitted(self.seen, self.part, self.agreed.fit)
            arms, stated = self.arms.values(), None
            if any(it.model is not None for it in arms):
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
        for (camera, it), corners in zip(looks.problems.items(), self.seen.compressed, strict=True):
            moving = np.flatnonzero(np.isin(looks.places(camera), self.seen.moving))
            unknowns = it.unknowns(corners, moving)
            found[camera] = it.stack.shown_px(corners.residuals, unknowns)
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
        looks, chosen = self.looks_at(state), np.isin(np.arange(len(self.cell.rows)), rows)
        if looks is None:
            return np.full(len(rows), np.nan)
        poses = self.agreed.problem.subset(chosen).predicted(state)
        lenses = {it: looks.camera(it) for it in looks.problems}
        seen = [self.poses[it].corners for it in rows]
        cameras = [lenses.get(self.cell.rows[it].seer) for it in rows]
        return chain_rms_px(seen, poses, cameras, np.concatenate(looks.corners))

    @property
    def field_columns(self) -> IntArray:
        """The problem's columns of what lenses do beyond their models."""
        mine = self.agreed.problem.effect_columns.get(LENSES, slice(0, 0))
        free = 0 if self.seen is None else len(self.seen.free)
        return np.arange(mine.start + free, mine.stop)

    def columns_of(self, places: IntArray) -> IntArray:
        """The problem's columns of free values of lenses and boards, by their places."""
        first = self.agreed.problem.effect_columns.get(LENSES, slice(0, 0)).start
        free = np.zeros(0) if self.seen is None else self.seen.free
        return np.asarray(first + np.searchsorted(free, places))


def solve(
    cell: Cell, looked: Observed, asked: str = "auto", solver: SolverName = "joint"
) -> Solved:
    """Solves a cell, of one robot and one camera or of many.

    Args:
        cell: The cell.
        looked: What was observed in it.
        asked: How far the robots' arms are to be calibrated; see `stages.kinematics.check_level`.
        solver: `joint`, or the closed form that the edges of one robot and one camera are to be by.

    Raises:
        DataError: A level is asked for, and no arm has what it takes.
        DegenerateError: A robot is tied to nothing, or a frame may be in two places.
    """
    cell = _with_poses(cell, looked)
    arms: Mapping[str, RobotArm] = arms_of(cell, looked.robots)
    check_arms(arms, asked)
    if cell.mount is not None:
        can = solver == "joint" and all(it.is_modelled for it in arms.values())
        check_asked(asked, can=can)
    if solver != "joint":
        cell, asked = replace(cell, priors=()), "hand-eye"
    cell, lost = _tied_part(cell)
    views = [looked.poses[it.view] for it in cell.rows]
    cell, views, problem, state, unplaced = _started(cell, views)
    sizes: Mapping[str, float] = {}
    if looked.is_misread:
        agreed = all_as_inliers(problem, state)
    else:
        agreed, sizes = _agree(cell, problem, state)
    late = clock_effects(cell, looked.clocks)
    untied, poses = (*lost, *unplaced), tuple(views)
    start = Solved(cell, agreed, None, poses, untied, arms, asked, late, looked.turned)
    found = _agreeing_looks(start, looked, sizes)
    if turned := {} if looked.is_misread else _turned_images(found):
        # Their corners would pass for a lens that changes from view to view.
        looked = replace(looked, turned=turned)
        found = _agreeing_looks(replace(start, turned=turned), looked, sizes)
    found = replace(found, arms=with_drifts(found.arms, found.part, found.agreed.fit, asked))
    if any(it.drift is not None for it in found.arms.values()):
        found = _agreeing_looks(found, looked, sizes)
    found = replace(found, agreed=_levelled(cell, views, found.agreed))
    # Poses that are misread say nothing of the arm, nor which views are outliers.
    for _ in range(0 if looked.is_misread else _ROUNDS):
        if asked != "hand-eye":
            arms = _levels(found)
            erring = [name for name, it in arms.items() if it.frees_errors()]
            late = clock_effects(cell, looked.clocks, erring)
            found = _at_rest(replace(found, arms=arms, late=late))
        before = found.agreed.used
        agreed = _without_misreported(_settle(cell, found.agreed), found.arms, before)
        found = _at_rest(replace(found, agreed=agreed))
        # What agrees by now has a say in how far the arms are calibrated.
        if np.array_equal(before, found.agreed.used):
            break
    if asked != "hand-eye" and not looked.is_misread:
        found = _with_functions(found)
    found = replace(found, agreed=_with_repeats(found.agreed))
    found = replace(found, arms=with_pose_errors(found.arms, found.part, found.agreed.fit))
    return found if solver == "joint" else _by_closed_form(found, solver)


def first_agreement(cell: Cell, looked: Observed, mount: Mount) -> tuple[Cell, Agreed]:
    """Takes the first steps of `solve`: which views agree, before lens, board or arm are fitted.

    Args:
        cell: A cell of one robot and one camera.
        looked: What was observed in it.
        mount: Where the camera is.

    Returns:
        The cell, its rows in the order of the fit, and what agrees.

    Raises:
        DegenerateError: The motion is too poor for any answer, by its geometry alone.
    """
    cell, _ = _tied_part(_with_poses(cell, looked))
    views = [looked.poses[it.view] for it in cell.rows]
    cell, _, problem, state, _ = _started(cell, views)
    check_observability(problem, state, starting_noise(problem), mount)
    return cell, _agree(cell, problem, state)[0]


def agreeing_views(cell: Cell, looked: Observed) -> frozenset[int]:
    """The views that the first consensus of a cell's frames predicts; nothing is fitted.

    Raises:
        DataError: Nothing was seen.
        DegenerateError: A robot is tied to nothing, or a frame may be in two places.
    """
    cell, _ = _tied_part(_with_poses(cell, looked))
    views = [looked.poses[it.view] for it in cell.rows]
    cell, _, problem, state, _ = _started(cell, views)
    between = invert(problem.predicted(state)) @ problem.observations.measured
    away = np.linalg.norm(between[:, :3, 3], axis=1) + LEVER_M * rotation_angle(between)
    near = (away < AGREE_M).tolist()
    return frozenset(row.view for row, is_near in zip(cell.rows, near, strict=True) if is_near)


def _with_poses(cell: Cell, looked: Observed) -> Cell:
    """The cell without the observations that gave no pose."""
    missing = {
        it.view: cell.reasons.get(it.view, "nothing was found in its image")
        for it in cell.rows
        if it.view not in looked.poses
    }
    cell = cell.without(missing)
    if not cell.rows:
        raise nothing_seen(looked)
    return cell


def _without_misreported(agreed: Agreed, arms: Mapping[str, RobotArm], before: Mask) -> Agreed:
    """Leaves out what agrees with an arm's joints alone, where its reported pose is another."""
    # A wrong report says nothing against joints and cameras, but would mislead the next fit.
    problem, used = agreed.problem, agreed.used.copy()
    stops = problem.observations.stops
    for robot, arm in arms.items():
        mine = rows_of(problem, robot)
        sound = np.isin(np.arange(len(arm.stood)), stops[mine & before])
        used &= before | ~mine | arm.reported_alike(sound)[stops]
    if np.array_equal(used, agreed.used):
        return agreed
    fit = fit_problem(problem.subset(used), agreed.fit.state, agreed.fit.noise)
    return replace(agreed, used=used, fit=fit)


def _by_closed_form(solved: Solved, solver: str) -> Solved:
    """The fit with the edges of a closed form, and the noise that these leave."""
    agreed = solved.agreed
    part = agreed.problem.subset(agreed.used)
    mount = solved.cell.mount
    if mount is None:
        raise RuntimeError("closed forms are for one robot and one camera")
    state = closed_form_state(part, solver, agreed.fit.state, mount)
    noise = estimate_noise(part, state, starting_noise(part), from_above=True)
    return replace(solved, agreed=replace(agreed, fit=Solution(state, noise)), solver=solver)


def _agreeing_looks(start: Solved, looked: Observed, sizes: Mapping[str, float]) -> Solved:
    """Fits lenses, boards and frames, until the same observations agree under them."""
    # In a whole cell, what moved must not be taken for a wrong view: there it is left to the end,
    # when the arms are calibrated.
    found, levels = start, dict[str, LensLevels]()
    for _ in range(_ROUNDS):
        found = _with_looks(replace(found, arms=start.arms), looked, levels, sizes)
        levels = {} if found.seen is None else dict(found.seen.looks.levels)
        if found.cell.mount is None or looked.is_misread:
            break
        before = found.agreed.used
        found = replace(found, agreed=settle(found.agreed))
        if np.array_equal(before, found.agreed.used):
            break
    return found


def _turned_images(fit: Solved) -> dict[int, Turned]:
    """How images of views that disagree were turned or mirrored, by view."""
    agreed = fit.agreed
    looks, state, problem = fit.looks, agreed.fit.state, agreed.problem
    if looks is None or agreed.used.all():
        return {}
    typical_px = float(np.nanmedian(fit.chain_px(np.flatnonzero(agreed.used), state)))
    predicted, found = problem.predicted(state), {}
    for at in np.flatnonzero(~agreed.used).tolist():
        seer, view = fit.cell.rows[at].seer, fit.poses[at]
        if view.corners is None or seer not in looks.problems:
            continue
        camera = looks.camera(seer)
        places = predict_corners(camera, predicted[at], looks.corners[view.board])
        how = turned_how(view.corners.px, places, camera.resolution, typical_px)
        if how is not None:
            found[view.view] = how
    return found


def _with_looks(
    found: Solved, looked: Observed, levels: Mapping[str, LensLevels], sizes: Mapping[str, float]
) -> Solved:
    """Fits lenses, boards and frames, with errors of the arms sought anew beside their drift."""
    found = replace(found, arms={name: it.erring(None) for name, it in found.arms.items()}).posed()
    if looked.scenes and not found.agreed.problem.is_combined:
        side, frames = found.side, found.frames
        views = _views_by_camera(looked, found.poses)
        looks = side.looks(looked.scenes, views).with_levels(levels)
        if looked.is_misread:
            return found.settled(side, settle_looks(looks, side, looks.first, frames))
        try:
            fitted, side = refined(side, looks, frames)
        except ConvergenceError:
            names = next(iter(looked.scenes.values())).names
            targets = [frame_name("target", it) for it in names]
            other = {it: sizes.get(targets[it], 0.0) for it in looks.printed}
            far = {board: size for board, size in other.items() if abs(size) > _FAR_SIZE}
            if not far:
                raise
            fitted, side = refined(side, looks.with_sizes(far), frames)
        return found.settled(side, fitted)
    found = replace(found, seen=None)
    if drifts := tuple(effects_of(found.arms)):
        found = replace(found, agreed=_with_effects(found.agreed, drifts))
    found = replace(found, arms=with_errors(found.arms, found.part, found.agreed.fit))
    others = (*found.late, *effects_of(found.arms))
    return replace(found, agreed=_with_effects(found.agreed, others)) if others else found


def _levels(found: Solved) -> dict[str, RobotArm]:
    """Chooses how far each arm is calibrated, beside the errors of the others."""
    problem, chosen, fit = found.part, dict(found.arms), found.agreed.fit
    views = [found.cell.rows[it].view for it in np.flatnonzero(found.agreed.used)]
    for name, arm in found.arms.items():
        stated = arm.without_errors(problem)
        start = State(fit.state.edges, stated.start_values)
        chosen[name] = arm.with_level(stated, start, found.asked, views, fit.noise)
        problem = chosen[name].put_into(problem)
    return chosen


def _with_functions(found: Solved) -> Solved:
    """Fits with functions of the joints of each arm that has any, beside the errors of others."""
    # What agrees is known by then: their many values would make each look for outliers slow. They
    # explain much of what a joint does that slipped: where that alone explains more, there are
    # none.
    part, fit, wider = found.part, found.agreed.fit, dict(found.arms)
    problem = part
    for name, arm in found.arms.items():
        stated = arm.without_errors(problem)
        start = State(fit.state.edges, stated.start_values)
        more = arm.with_functions(stated, start, found.asked, fit.noise)
        if more.gain_of_functions:
            slip = slipped_joint(part, fit, joint_offsets({name: arm}))
            if slip and log_gain(part, fit, slip.mahalanobis_sq) > more.gain_of_functions:
                continue
        wider[name] = more
        problem = more.put_into(problem)
    if all(wider[name] is arm for name, arm in found.arms.items()):
        return found
    return _at_rest(replace(found, arms=wider))


def _at_rest(found: Solved) -> Solved:
    """Fits with calibrated arms that are linearised anew until they stay."""
    is_modelled = any(it.model is not None for it in found.arms.values())
    for turn in range(_ROUNDS if is_modelled else 0):
        found = found.posed()
        if found.seen is None:
            others = (*found.late, *effects_of(found.arms))
            found = replace(found, agreed=_with_effects(found.agreed, others))
        else:
            side, seen = found.side, found.seen
            fitted = settle_looks(seen.looks, side, seen.moving, found.frames)
            if turn == 0:  # What the arm did wrong may have passed for the lens's doing.
                looks = fitted.looks.with_levels(lens_levels(side, fitted))
                fitted = settle_looks(looks, side, fitted.moving, fitted.frames, fitted.others)
            found = found.settled(side, fitted)
        problem, state = found.agreed.problem, found.agreed.fit.state
        moved = {name: it.moved(problem, state) for name, it in found.arms.items()}
        found = replace(found, arms={name: arm for name, (arm, _) in moved.items()})
        if max(step for _, step in moved.values()) < _AT_REST_RAD:
            break
    return found


def _views_by_camera(looked: Observed, views: Sequence[ViewPoses]) -> dict[str, list[ViewPoses]]:
    """The views of each camera's images that some fit may use, each with its one pose."""
    known = {**looked.poses, **{it.view: it for it in views}}
    # Frames of a sweep that are not needed were taken on the move: rows of theirs are not at rest.
    out = looked.held_back | looked.spared.keys() | looked.turned.keys()
    return {
        frame: [known[it] for it in look.corners if it in known and it not in out]
        for frame, look in looked.cameras.items()
    }


def _with_repeats(agreed: Agreed) -> Agreed:
    """Fits once more, repeated views of still boards by still cameras sharing an error."""
    # What moved was looked for without it: their differences do not share it.
    problem = replace(agreed.problem, with_repeats=True)
    fit = fit_problem(problem.subset(agreed.used), agreed.fit.state, agreed.fit.noise)
    return replace(agreed, problem=problem, fit=fit)


def _agree(cell: Cell, problem: Problem, state: State) -> tuple[Agreed, Mapping[str, float]]:
    """Finds what belongs together, and what of the priors the observations do not contradict."""
    # Also gives by which share each printed target of a whole cell is larger than stated, roughly.
    movable, seen = _movable(cell, problem), problem.observations
    if printed := _printed(seen) if movable else []:
        # All that is seen of a board of another size disagrees with the rest, and would be out.
        problem = problem.with_effects([target_sizes(problem, printed, _SIZE_SIGMA)])
        state = State(state.edges, problem.start_values)
    if not cell.priors:
        agreed = agree(problem, state, movable)
    else:
        loose = replace(problem, priors=loosened(cell.priors))
        agreed = _with_priors(cell, agree(loose, state, movable))
        fit = fit_problem(agreed.problem.subset(agreed.used), agreed.fit.state, agreed.fit.noise)
        agreed = replace(agreed, fit=fit)
    # What corners say of sizes is found with the lenses.
    edges, sizes = agreed.fit.state.edges, agreed.fit.state.values.tolist()
    fit = replace(agreed.fit, state=State(edges, np.zeros(0)))
    agreed = replace(agreed, problem=agreed.problem.with_effects(()), fit=fit)
    return agreed, dict(zip(printed, sizes, strict=True))


def _printed(seen: Observations) -> list[str]:
    """The targets of which corners were seen: the covariances of others' poses are not known."""
    pairs = zip(seen.observed, seen.sensors.tolist(), strict=True)
    return list(dict.fromkeys(target for target, sensor in pairs if sensor < 0))


def _settle(cell: Cell, agreed: Agreed) -> Agreed:
    """Settles what agrees, and what of the priors the observations do not contradict."""
    if cell.priors:
        loose = replace(agreed.problem, priors=loosened(cell.priors))
        agreed = settle(replace(agreed, problem=loose), _movable(cell, loose))
        agreed = _with_priors(cell, agreed)
    return settle(agreed, _movable(cell, agreed.problem))


def _with_priors(cell: Cell, agreed: Agreed) -> Agreed:
    """Puts in the components of priors that the observations do not contradict."""
    # The worst is left out first: it misleads about the rest. The noise is that of a fit with loose
    # priors: estimated beside a wrong one, it would grow until it explains it.
    problem, noise = replace(agreed.problem, priors=cell.priors), agreed.fit.noise
    while True:
        part = problem.subset(agreed.used)
        fit = Solution(solve_problem(part, agreed.fit.state, noise)[0], noise)
        kept = without_most_contradicted(part, fit.state, covariance_of(part, fit))
        if kept is None:
            return replace(agreed, problem=problem, fit=fit)
        problem = replace(problem, priors=kept)


def _levelled(cell: Cell, views: Sequence[ViewPoses], agreed: Agreed) -> Agreed:
    """Asks for the noise level of cameras, too, now that what is wrong is out."""
    # Corners of one image may err alike, as those of small squares do: poses then scatter by more
    # than corners do about them, but never by less. Where one camera sees one robot once a stop,
    # the robot's noise has taken that up.
    is_alone = cell.mount is not None and not agreed.problem.shared_units
    if is_alone or agreed.problem.is_combined:
        return agreed
    sensors = sensors_of(cell, views)
    frames = tuple(dict.fromkeys((*sensors, *(it.seer for it in cell.rows))))
    places = {it: at for at, it in enumerate(frames)}
    problem = agreed.problem
    observations = replace(
        problem.observations,
        sensors=np.array([places[it.seer] for it in cell.rows], dtype=np.int64),
    )
    more = np.ones(len(frames) - len(sensors))
    least_levels = np.concatenate([np.zeros(len(sensors)), more])
    problem = replace(problem, observations=observations, least_levels=least_levels)
    noise = agreed.fit.noise
    noise = replace(noise, sensors=np.concatenate([noise.sensors, more]))
    # All that is tried with the arms begins here.
    fit = fit_problem(problem.subset(agreed.used), agreed.fit.state, noise)
    return replace(agreed, problem=problem, fit=fit)


def _with_effects(agreed: Agreed, effects: Sequence[Effect]) -> Agreed:
    problem = agreed.problem.with_effects(effects)
    state = State(agreed.fit.state.edges, problem.start_values)
    fit = fit_problem(problem.subset(agreed.used), state, agreed.fit.noise)
    return replace(agreed, problem=problem, fit=fit)


def _movable(cell: Cell, problem: Problem) -> tuple[str, ...]:
    """What may be bumped or slip: all that is unknown but bases."""
    # One camera that sees one robot move cannot distinguish what slipped from a wrong pose.
    if cell.mount is not None:
        return ()
    bases = {branch.parent for branch in problem.tree.branches.values() if branch.robot}
    return tuple(it for it in problem.tree.unknown if it not in bases)


def _tied_part(cell: Cell) -> tuple[Cell, tuple[str, ...]]:
    """The part of a cell that observations tie together, and the frames outside."""
    tied = cell.tied()
    lost = tuple(it for it in cell.tree.branches if it not in tied)
    untied_robots(cell, lost)
    return _without_frames(cell, lost), tuple(it for it in lost if not _is_flange(cell, it))


def _is_flange(cell: Cell, frame: str) -> bool:
    return bool(cell.tree.branches[frame].robot)


def _without_frames(cell: Cell, frames: Sequence[str]) -> Cell:
    tree = cell.tree.without(frames)
    reasons = {
        it.view: f"nothing ties {it.seer if it.seer in frames else it.seen} to the rest of the cell"
        for it in cell.rows
        if it.seer not in tree.branches or it.seen not in tree.branches
    }
    robots = set(tree.robots)
    poses = {name: it for name, it in cell.poses.items() if name in robots}
    priors = tuple(
        it for it in cell.priors if it.first in tree.branches and it.second in tree.branches
    )
    return replace(cell.without(reasons), tree=tree, poses=poses, priors=priors)


def _started(
    cell: Cell, views: Sequence[ViewPoses]
) -> tuple[Cell, list[ViewPoses], Problem, State, tuple[str, ...]]:
    """Finds a start, and gives each view its one pose by it."""
    if cell.mount is not None:
        refuse_too_few(problem_of(cell, views), cell.mount, len(cell.rows))
        _refuse_few_of_each(cell)
    placed = init_frames(problem_of(cell, views), views, targets_of(cell))
    tied, clear = placed.tied, {it.view: it for it in placed.views}
    if tied.untied:
        untied_robots(cell, tied.untied, seen=True)
        cell = _without_frames(cell, tied.untied)
    if tied.ambiguous:
        raise ambiguous_error(cell, tied.ambiguous)
    cell, lost = _tied_part(cell.without({it.view: it.reason for it in placed.rejections}))
    views = [clear[it.view] for it in cell.rows]
    problem = problem_of(cell, views)
    return cell, views, problem, problem.start(tied.edges), (*tied.untied, *lost)


def _refuse_few_of_each(cell: Cell) -> None:
    """Refuses several targets of which none is seen often enough to begin with."""
    shown = [it.seen for it in cell.rows]
    counts = {it: shown.count(it) for it in dict.fromkeys(shown)}
    if len(counts) > 1 and max(counts.values()) < FEWEST_VIEWS and cell.mount != "instrument":
        shares = ", ".join(f"{it.partition('_')[2]} in {count}" for it, count in counts.items())
        raise DegenerateError(
            f"hand-eye: of several targets, at least one must be seen in {FEWEST_VIEWS} views, to "
            f"begin with; here {shares}.",
            culprits=[it.replace("_", " ", 1) for it in counts],
            next_step="Add views of one of them, tilted about different axes.",
        )


def targets_of(cell: Cell) -> dict[str, Target]:
    """The printed targets by their frames."""
    return {f"target_{name}" if name else "target": it for name, it in cell.session.plates.items()}


def problem_of(cell: Cell, views: Sequence[ViewPoses]) -> Problem:
    """The problem of views with one pose each, lenses and boards as they are taken to be."""
    given = np.array([not it.covariance.any() for it in views])
    levels = {it: at for at, it in enumerate(sensors_of(cell, views))}
    sensors = [
        levels.get(row.seer, -1) if _is_sensed(row.seer, view) else -1
        for row, view in zip(cell.rows, views, strict=True)
    ]
    covariance = np.array([it.covariance[0] for it in views])
    places = np.array([it.is_place for it in cell.rows], dtype=bool)
    covariance[given] = _NOMINAL
    turned = {
        row.seen
        for row, init_frames in zip(cell.rows, places.tolist(), strict=True)
        if not init_frames
    }
    # What one camera measured with one robot, without a word of its noise, has that of both as one.
    is_combined = cell.mount is not None and cell.mount != "instrument" and bool(given.any())
    is_uneven = given & [not row.seer.startswith("instrument") for row in cell.rows]
    if is_combined:
        is_uneven |= True
        sensors, covariance = [-1] * len(views), np.zeros((len(views), 6, 6))
    return Problem(
        cell.tree,
        cell.poses,
        Observations(
            tuple(it.seer for it in cell.rows),
            tuple(it.seen for it in cell.rows),
            np.array([it.station for it in cell.rows]),
            np.array(sensors, dtype=np.int64),
            np.array([it.cam_from_target[0] for it in views]),
            covariance,
            ~places,
            is_uneven,
        ),
        priors=cell.priors,
        points=frozenset(it.seen for it in cell.rows) - turned,
        is_combined=is_combined,
    )


def _is_sensed(seer: str, view: ViewPoses) -> bool:
    """Whether an observation's noise is known up to a level: those of corners is known."""
    return seer.startswith("instrument") or not view.covariance.any()


def sensors_of(cell: Cell, views: Sequence[ViewPoses]) -> tuple[str, ...]:
    """The frames whose observations' noise is known up to a level; other cameras come behind.

    Of one camera or instrument with one robot it is the stated noise: the rest is the robot's.
    """
    if cell.mount is not None:
        return ()
    pairs = zip(cell.rows, views, strict=True)
    return tuple(dict.fromkeys(row.seer for row, view in pairs if _is_sensed(row.seer, view)))
