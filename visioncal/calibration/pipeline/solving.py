"""From what was seen to the fit of the whole cell: lenses, boards, frames, arms; inliers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.arm_results import (
    arms_of,
    joint_offsets,
    one_by_one,
    with_drifts,
    with_errors,
    with_pose_errors,
)
from visioncal.calibration.pipeline.solved import Solved
from visioncal.calibration.pipeline.starting import Start, sensors_of, started
from visioncal.calibration.stages.arms import RobotArm, check_arms, effects_of
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.clocks import clock_effects
from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.calibration.stages.kinematics import check_asked
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.priors import loosened, without_most_contradicted
from visioncal.calibration.stages.refine import lens_levels, refined
from visioncal.calibration.stages.turned_images import ImageTurn, turned_how
from visioncal.calibration.stages.validate import predict_corners
from visioncal.core.choices import SolverName
from visioncal.core.errors import ConvergenceError, DegenerateError, VisioncalError
from visioncal.core.types import Mask, Mount
from visioncal.estimation.arm import rows_of
from visioncal.estimation.joint import settle as settle_looks
from visioncal.estimation.joint import target_sizes
from visioncal.estimation.lens_field import LensLevels
from visioncal.estimation.observability import (
    check_observability,
    refuse_open_motion,
    too_little_motion,
)
from visioncal.estimation.outliers import Agreed, agree, all_as_inliers, settle
from visioncal.estimation.parts import Effect, Observations, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.slight_steps import log_gain, slipped_joint
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    estimate_noise,
    solve_problem,
    starting_noise,
)
from visioncal.session.frames import frame_name

# Arms are linearised anew so often, or until their errors move by less, which is far below any
# arm's repeatability.
_ROUNDS, _AT_REST_RAD = 4, 1e-7
# Where all goes astray, boards that are off by more begin as they were found.
_FAR_SIZE = 5e-3
# A focal length that corners leave open by more than this share needs an arm that tilts.
_OPEN_FOCAL = 0.02

# What targets' sizes are known to while it is sought what agrees, as a share: prints are scaled to
# fit a page.
_SIZE_SIGMA = 0.03


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
        DegenerateError: A robot is tied to nothing, a frame may be in two places, or the
            motion of one robot leaves a direction, or the lens, open.
    """
    arms: Mapping[str, RobotArm] = arms_of(cell, looked.robots)
    check_arms(arms, asked)
    if cell.mount is not None:
        can = solver == "joint" and all(arm.is_modelled for arm in arms.values())
        check_asked(asked, can=can)
    if solver != "joint":
        cell, asked = replace(cell, priors=()), "hand-eye"
    begun = started(cell, looked)
    if begun.cell.mount is not None and begun.cell.priors and not looked.is_misread:
        _refuse_open_lens(looked, begun.problem, begun.cell.mount)
    try:
        found = _fitted(begun, looked, arms, asked)
    except (VisioncalError, np.linalg.LinAlgError):
        # Along a direction that nothing determines, the fit of lens and frames runs away.
        if begun.cell.mount is not None and not looked.is_misread:
            noise = starting_noise(begun.problem)
            refuse_open_motion(begun.problem, begun.state, noise, begun.cell.mount)
        raise
    return found if solver == "joint" else _by_closed_form(found, solver)


def _fitted(begun: Start, looked: Observed, arms: Mapping[str, RobotArm], asked: str) -> Solved:
    """Alternates between what agrees, lenses and boards, and arms."""
    cell, poses = begun.cell, begun.poses
    sizes: Mapping[str, float] = {}
    if looked.is_misread:
        agreed = all_as_inliers(begun.problem, begun.state)
    else:
        agreed, sizes = find_inliers(begun)
    late = clock_effects(cell, looked.clocks)
    start = Solved(cell, agreed, None, poses, begun.untied, arms, asked, late, looked.turned)
    found = _agreeing_looks(start, looked, sizes)
    if turned := {} if looked.is_misread else _turned_images(found):
        # Their corners would pass for a lens that changes from view to view.
        looked = replace(looked, turned=turned)
        found = _agreeing_looks(replace(start, turned=turned), looked, sizes)
    found = replace(found, arms=with_drifts(found.arms, found.part, found.agreed.fit, asked))
    if any(arm.drift is not None for arm in found.arms.values()):
        found = _agreeing_looks(found, looked, sizes)
    # Of one camera and one robot without priors, the looks have left nothing to settle.
    rested = None if cell.mount is None or cell.priors else found.agreed
    found = replace(found, agreed=levelled(cell, poses, found.agreed))
    # Poses that are misread say nothing of the arm, nor which views are outliers.
    found = found if looked.is_misread else _alternating(found, looked, rested)
    if asked != "hand-eye" and not looked.is_misread:
        found = _with_functions(found)
    found = replace(found, agreed=with_repeats(found.agreed))
    return replace(found, arms=with_pose_errors(found.arms, found.part, found.agreed.fit))


def _refuse_open_lens(looked: Observed, problem: Problem, mount: Mount) -> None:
    """Refuses a lens that corners leave open, nor turns about one axis beside priors determine."""
    poses = problem.poses[problem.robots[0]]
    # Images of a sweep have no pose of their own before its clock is known.
    poses = poses[np.isfinite(poses[:, 0, 0])]
    words, _ = too_little_motion(poses, mount) if len(poses) > 1 else ("", "")
    for look in looked.cameras.values() if words else ():
        if look.lens is None or look.lens.covariance is None:
            continue
        sigmas = np.sqrt(np.diag(look.lens.covariance)[:2]) / look.lens.camera.matrix[:2]
        if (focal := float(sigmas.max())) > _OPEN_FOCAL:
            raise DegenerateError(
                f"{words} Such motion does not determine the lens, of which the corners leave the "
                f"focal length open to {100.0 * focal:.1f} %.",
                culprits=["camera.matrix"],
                next_step="Give matrix and distortion in [camera]; or add images of the board held "
                "by hand, tilted by 30 to 45 degrees about different axes, with role = intrinsics.",
            )


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
    return replace(agreed, used=used).refitted()


def _alternating(found: Solved, looked: Observed, rested: Agreed | None) -> Solved:
    """Calibrates the arms by what agrees, and sees what agrees with these, until both stay.

    Args:
        found: The fit.
        looked: What was observed.
        rested: What agrees, where that was settled before; else None.
    """
    for turn in range(_ROUNDS + 1):
        if found.asked != "hand-eye":
            arms = _levels(found)
            erring = [name for name, arm in arms.items() if arm.frees_errors()]
            late = clock_effects(found.cell, looked.clocks, erring)
            found = _at_rest(replace(found, arms=arms, late=late))
        before = found.agreed
        # The arms are calibrated by what agreed last.
        if turn == _ROUNDS or before is rested:
            break
        agreed = _without_misreported(settled(found.cell, before), found.arms, before.used)
        found = _at_rest(replace(found, agreed=agreed))
        # What agrees by now, and what moved, has a say in how far the arms are calibrated.
        if _are_alike(before, agreed):
            break
    return found


def _are_alike(one: Agreed, other: Agreed) -> bool:
    """Whether the same observations agree, and the same frames are unknown."""
    alike = one.problem.unknown.keys() == other.problem.unknown.keys()
    return alike and np.array_equal(one.used, other.used)


def _by_closed_form(solved: Solved, solver: str) -> Solved:
    """The fit with the edges of a closed form, and the noise that these leave."""
    agreed, part = solved.agreed, solved.part
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


def _turned_images(fit: Solved) -> dict[int, ImageTurn]:
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
    found = replace(
        found, arms={name: arm.erring(None) for name, arm in found.arms.items()}
    ).posed()
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
            targets = [frame_name("target", name) for name in names]
            other = {index: sizes.get(targets[index], 0.0) for index in looks.printed}
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
    """Chooses how far each arm is calibrated."""
    fit = found.agreed.fit
    views = [found.cell.rows[index].view for index in np.flatnonzero(found.agreed.used)]

    def with_level(arm: RobotArm, stated: Problem, start: State) -> RobotArm:
        return arm.with_level(stated, start, found.asked, views, fit.noise)

    return one_by_one(found.arms, found.part, fit, with_level)


def _with_functions(found: Solved) -> Solved:
    """Fits with functions of the joints of each arm that has any."""
    # What agrees is known by then: their many values would make each look for outliers slow. They
    # explain much of what a joint does that slipped: where that alone explains more, there are
    # none.
    part, fit = found.part, found.agreed.fit

    def with_functions(arm: RobotArm, stated: Problem, start: State) -> RobotArm:
        more = arm.with_functions(stated, start, found.asked, fit.noise)
        if not more.gain_of_functions:
            return more
        slip = slipped_joint(part, fit, joint_offsets({arm.robot: arm}))
        slips = slip and log_gain(part, fit, slip.mahalanobis_sq) > more.gain_of_functions
        return arm if slips else more

    wider = one_by_one(found.arms, part, fit, with_functions)
    if all(wider[name] is arm for name, arm in found.arms.items()):
        return found
    return _at_rest(replace(found, arms=wider))


def _at_rest(found: Solved) -> Solved:
    """Fits with calibrated arms that are linearised anew until they stay."""
    is_modelled = any(arm.model is not None for arm in found.arms.values())
    for turn in range(_ROUNDS if is_modelled else 0):
        found = found.posed()
        if found.seen is None:
            others = (*found.late, *effects_of(found.arms))
            found = replace(found, agreed=_with_effects(found.agreed, others))
        else:
            side, seen = found.side, found.seen
            fitted = settle_looks(seen.looks, side, seen.moving, found.frames, before=seen)
            if turn == 0:  # What the arm did wrong may have passed for the lens's doing.
                looks = fitted.looks.with_levels(lens_levels(side, fitted))
                fitted = settle_looks(looks, side, fitted.moving, fitted.frames, fitted.others)
            found = found.settled(side, fitted)
        problem, state = found.agreed.problem, found.agreed.fit.state
        moved = {name: arm.moved(problem, state) for name, arm in found.arms.items()}
        found = replace(found, arms={name: arm for name, (arm, _) in moved.items()})
        if max(step for _, step in moved.values()) < _AT_REST_RAD:
            break
    return found


def _views_by_camera(looked: Observed, views: Sequence[ViewPoses]) -> dict[str, list[ViewPoses]]:
    """The views of each camera's images that some fit may use, each with its one pose."""
    known = {**looked.poses, **{view.view: view for view in views}}
    # Frames of a sweep that are not needed were taken on the move: rows of theirs are not at rest.
    out = looked.held_back | looked.spared.keys() | looked.turned.keys()
    return {
        frame: [known[corner] for corner in look.corners if corner in known and corner not in out]
        for frame, look in looked.cameras.items()
    }


def _with_effects(agreed: Agreed, effects: Sequence[Effect]) -> Agreed:
    problem = agreed.problem.with_effects(effects)
    state = State(agreed.fit.state.edges, problem.start_values)
    return replace(agreed, problem=problem, fit=replace(agreed.fit, state=state)).refitted()


def first_inliers(cell: Cell, looked: Observed, mount: Mount) -> tuple[Cell, Agreed]:
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
    start = started(cell, looked)
    check_observability(start.problem, start.state, starting_noise(start.problem), mount)
    return start.cell, find_inliers(start)[0]


def find_inliers(start: Start) -> tuple[Agreed, Mapping[str, float]]:
    """Finds what belongs together, and what of the priors the observations do not contradict.

    Returns:
        What agrees, and by which share each printed target of a whole cell is larger than stated,
        roughly.
    """
    cell, problem, state = start.cell, start.problem, start.state
    movable, seen = _movable(cell, problem), problem.observations
    if printed := _printed(seen) if movable else []:
        # All that is seen of a board of another size disagrees with the rest, and would be out.
        problem = problem.with_effects([target_sizes(problem, printed, _SIZE_SIGMA)])
        state = State(state.edges, problem.start_values)
    if not cell.priors:
        agreed = agree(problem, state, movable)
    else:
        loose = replace(problem, priors=loosened(cell.priors))
        agreed = _with_priors(cell, agree(loose, state, movable)).refitted()
    # What corners say of sizes is found with the lenses.
    edges, sizes = agreed.fit.state.edges, agreed.fit.state.values.tolist()
    fit = replace(agreed.fit, state=State(edges, np.zeros(0)))
    agreed = replace(agreed, problem=agreed.problem.with_effects(()), fit=fit)
    return agreed, dict(zip(printed, sizes, strict=True))


def settled(cell: Cell, agreed: Agreed) -> Agreed:
    """Settles what agrees, and what of the priors the observations do not contradict."""
    if cell.priors:
        loose = replace(agreed.problem, priors=loosened(cell.priors))
        agreed = settle(replace(agreed, problem=loose), _movable(cell, loose))
        agreed = _with_priors(cell, agreed)
    return settle(agreed, _movable(cell, agreed.problem))


def levelled(cell: Cell, poses: Sequence[ViewPoses], agreed: Agreed) -> Agreed:
    """Asks for the noise level of cameras, too, now that what is wrong is out."""
    # Corners of one image may err alike, as those of small squares do: poses then scatter by more
    # than corners do about them, but never by less. Where one camera sees one robot once a stop,
    # the robot's noise has taken that up.
    is_alone = cell.mount is not None and not agreed.problem.shared_units
    if is_alone or agreed.problem.is_combined:
        return agreed
    sensors = sensors_of(cell, poses)
    frames = tuple(dict.fromkeys((*sensors, *(row.seer for row in cell.rows))))
    places = {frame: at for at, frame in enumerate(frames)}
    problem = agreed.problem
    observations = replace(
        problem.observations,
        sensors=np.array([places[row.seer] for row in cell.rows], dtype=np.int64),
    )
    more = np.ones(len(frames) - len(sensors))
    least_levels = np.concatenate([np.zeros(len(sensors)), more])
    problem = replace(problem, observations=observations, least_levels=least_levels)
    noise = agreed.fit.noise
    noise = replace(noise, sensors=np.concatenate([noise.sensors, more]))
    # All that is tried with the arms begins here.
    return replace(agreed, problem=problem, fit=replace(agreed.fit, noise=noise)).refitted()


def with_repeats(agreed: Agreed) -> Agreed:
    """Fits once more, repeated views of still boards by still cameras sharing an error."""
    # What moved was looked for without it: their differences do not share it.
    return replace(agreed, problem=replace(agreed.problem, with_repeats=True)).refitted()


def _printed(seen: Observations) -> list[str]:
    """The targets of which corners were seen: the covariances of others' poses are not known."""
    pairs = zip(seen.observed, seen.sensors.tolist(), strict=True)
    return list(dict.fromkeys(target for target, sensor in pairs if sensor < 0))


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


def _movable(cell: Cell, problem: Problem) -> tuple[str, ...]:
    """What may be bumped or slip: all that is unknown but bases."""
    # One camera that sees one robot move cannot distinguish what slipped from a wrong pose.
    if cell.mount is not None:
        return ()
    bases = problem.tree.bases.values()
    return tuple(name for name in problem.tree.unknown if name not in bases)
