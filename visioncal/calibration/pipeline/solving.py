"""Solves a cell: alternates between inliers, the fit of lenses, boards and frames, and arms."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.arm_results import (
    arms_of,
    joint_offsets,
    one_nominal,
    with_drifts,
    with_pose_errors,
)
from visioncal.calibration.pipeline.inliers import initial_inliers, updated_inliers, with_repeats
from visioncal.calibration.pipeline.starting import Start, find_start
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.stages.clocks import clock_effects
from visioncal.calibration.stages.error_sizes import (
    ErrorSizes,
    MeasuredErrors,
    error_sizes,
    measured_errors,
)
from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.calibration.stages.kinematics import (
    check_arms,
    check_level_is_possible,
    with_likely_errors,
)
from visioncal.calibration.stages.likely_steps import CLEARLY, likely_steps
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.random_effects import KINDS, random_effects
from visioncal.calibration.stages.refine import refine_jointly
from visioncal.calibration.suspects.moved_views import views_apart
from visioncal.core.choices import SolverName
from visioncal.core.errors import ConvergenceError, VisioncalError
from visioncal.core.limits import CONTRADICTION
from visioncal.core.types import Mask
from visioncal.estimation.arm import rows_of
from visioncal.estimation.fit import Fit
from visioncal.estimation.joint import fit_jointly, target_sizes
from visioncal.estimation.moves import creep_effects
from visioncal.estimation.observability import chain_words, check_determined
from visioncal.estimation.outliers import (
    InlierFit,
    all_as_inliers,
    refine_inliers,
)
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import (
    Solution,
    estimate_noise,
    solve_problem,
    starting_noise,
)
from visioncal.estimation.steps import FRAME, find_steps, joints_of
from visioncal.estimation.unknowns import SIZE
from visioncal.model.effects import Creeps
from visioncal.vision.pnp import ViewPoses

# Arms are relinearised at most so often, or until their errors change by less, which is far below
# any arm's repeatability.
_ROUNDS, _CONVERGED_RAD = 4, 1e-6


def solve(
    cell: Cell, observed: Observed, level: str = "auto", solver: SolverName = "joint"
) -> CellFit:
    """Solves a cell, of one robot and one camera or of many.

    Args:
        cell: The cell.
        observed: The observations in it.
        level: The calibration level of the arms; see `stages.kinematics.check_level`.
        solver: `joint`, or a closed form for the edges of one robot and one camera.

    Raises:
        DataError: No arm has the data that the requested level needs.
        DegenerateError: A robot is linked to nothing, a frame may be in two places, or the motion
            of one robot leaves a direction undetermined.
    """
    arms: Mapping[str, Arm] = arms_of(cell, observed.robots)
    check_arms(arms, level)
    if cell.session.has_one_pair:
        can = solver == "joint" and all(arm.is_modelled for arm in arms.values())
        check_level_is_possible(level, can=can)
    if solver != "joint":
        cell, level = replace(cell, priors=()), "hand-eye"
    start = find_start(cell, observed, is_solved=not observed.misread)
    arms = {name: arm.with_sides if start.has_play(name) else arm for name, arm in arms.items()}
    measured = measured_errors(None if observed.scenes else start.solved)
    start = _with_shapes(start, measured)
    try:
        cell_fit = _fit(start, observed, arms, level, measured)
    except (VisioncalError, np.linalg.LinAlgError):
        # Along an undetermined direction the fit of lens and frames diverges.
        if start.cell.mount is not None and not observed.misread:
            noise = starting_noise(start.problem)
            words = chain_words(start.problem, start.cell.mount, can_tilt=observed.can_tilt)
            check_determined(start.problem, start.state, noise, words, only_open=True)
        raise
    return cell_fit if solver == "joint" else _by_closed_form(cell_fit, solver)


def _with_shapes(start: Start, measured: MeasuredErrors) -> Start:
    """The start with the noise of measured poses by distance and line of sight; itself of others.

    A program that finds a board in an image tells neither: tilt and distance of a single marker are
    less sure by ten times than what is across the sight.
    """
    problem, rows = start.problem, start.cell.rows
    if not problem.is_combined or not all(row.view in measured.noise for row in rows):
        return start
    covariance = np.array([measured.noise[row.view] for row in rows])
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=(0, 2))
    shapes = np.linalg.cholesky(covariance) / np.sqrt(np.repeat(variances, 3))
    observations = replace(problem.observations, shapes=shapes)
    return replace(start, problem=replace(problem, observations=observations))


def _fit(
    start: Start,
    observed: Observed,
    arms: Mapping[str, Arm],
    level: str,
    measured: MeasuredErrors,
) -> CellFit:
    """Alternates between inliers, lenses and boards, and arms."""
    cell, poses, sizes = start.cell, start.poses, measured.sizes
    misread = observed.misread
    inliers = all_as_inliers(start.problem, start.state) if misread else initial_inliers(start)
    others = (*clock_effects(cell, observed.clocks), *creep_effects(inliers.problem))
    known = ErrorSizes(opened=measured.opened)
    initial = CellFit(cell, inliers, None, poses, start.untied, arms, level, others, sizes=known)
    if misread:
        # Misread poses determine neither lens, board and arm nor which views are outliers.
        return _of_misread(initial, observed)
    if observed.scenes and not inliers.problem.is_combined:
        initial = replace(initial, sizes=error_sizes(observed, start.solved))
    cell_fit = _fit_with_inliers(initial, observed)
    cell_fit = _with_own_lens(cell_fit, observed)
    if cell_fit.inlier_fit.problem.is_combined and not observed.scenes:
        cell_fit = _with_likelier_noise(cell_fit, observed)
    cell_fit = replace(cell_fit, arms=with_drifts(cell_fit.arms, cell_fit.fit, level))
    if any(arm.drift is not None for arm in cell_fit.arms.values()):
        cell_fit = _fit_with_inliers(cell_fit, observed)
    corners = cell_fit.linearised_corners
    rows = None if corners is None else cell_fit.all_rows(corners)
    found = random_effects(cell_fit.inlier_fit, cell_fit.arms, cell_fit.sizes, corners, rows)
    if found := _without_stepped(found, cell_fit):
        gains = {effect.name: gain for effect, gain in found.items()}
        with_effects = replace(cell_fit, other_effects=(*others, *found), gains=gains)
        cell_fit = _fit_with_inliers(with_effects, observed)
    # Of one camera and one robot without priors, the inliers are final with lenses and boards.
    is_final = cell.session.has_one_pair and not cell.priors
    nominal = cell_fit
    cell_fit, noise = _calibrate_arms(nominal, observed, cell_fit.inlier_fit if is_final else None)
    if sizes:
        # Boards of another size look as other lengths of an arm do. Slopes by a size are those at
        # the poses of the fit before, which a size of some percent moves.
        for _ in range(2):
            nominal = _fit_with_inliers(_with_sizes(nominal, sizes), observed)
        cell_fit, noise = _calibrate_arms(nominal, observed, None)
    if level != "hand-eye":
        # The many unknowns of functions of the joints would slow each update of the inliers down.
        arms = _choose_levels(cell_fit, noise, functions=True)
        if any(arms[name] is not arm for name, arm in cell_fit.arms.items()):
            cell_fit = _converge_arms(replace(cell_fit, arms=arms))
    cell_fit = replace(cell_fit, inlier_fit=with_repeats(cell_fit.inlier_fit))
    return replace(cell_fit, arms=with_pose_errors(cell_fit.arms, cell_fit.fit))


def _without_stepped(found: dict[Effect, float], cell_fit: CellFit) -> dict[Effect, float]:
    """Random effects without creep where a frame that moved at once is clearly likelier."""
    kinds = {effect: KINDS[effect.name.partition(" of ")[0]] for effect in found}
    crept = {effect for effect, kind in kinds.items() if issubclass(kind, Creeps)}
    if not crept:
        return found
    fit, offsets = cell_fit.fit, joint_offsets(cell_fit.arms)
    (step, *_) = (*likely_steps(fit.problem, fit.solution, {}, offsets, {}), None)
    if step is None or step.kind != FRAME:
        return found
    gain = step.gain - CLEARLY
    return {effect: has for effect, has in found.items() if effect not in crept or has > gain}


def _with_own_lens(cell_fit: CellFit, observed: Observed) -> CellFit:
    """The fit whose lens is not estimated of views that are left out as of another camera."""
    if cell_fit.linearised_corners is None or not (apart := views_apart(cell_fit)):
        return cell_fit
    # The views that are left may be too few for a lens, as the session's are not.
    with suppress(VisioncalError, np.linalg.LinAlgError):
        reduced = replace(cell_fit, apart=apart, linearised_corners=None)
        return _fit_with_inliers(reduced, observed)
    return cell_fit


def _with_sizes(cell_fit: CellFit, sigmas: Mapping[str, float]) -> CellFit:
    """The fit beside sizes of targets, whose poses a program measured."""
    problem, state = cell_fit.inlier_fit.problem, cell_fit.inlier_fit.fit.state
    sizes, columns = target_sizes(problem, sigmas), problem.effect_columns
    values = np.append(state.values, sizes.values)
    if SIZE in columns:
        values = state.values
        sizes = replace(sizes, values=problem.values_of(SIZE, state))
    kept = [effect for effect in problem.effects if effect.name != SIZE]
    problem = problem.with_effects([*kept, sizes])
    sized = problem.sized_at(State(state.edges, values)).effects[-1]
    others = (effect for effect in cell_fit.other_effects if effect.name != SIZE)
    return replace(cell_fit, other_effects=(*others, replace(sized, values=np.zeros(len(sizes)))))


def _of_misread(cell_fit: CellFit, observed: Observed) -> CellFit:
    """Solves the frames once by all observations, with lenses and boards as they are."""
    cell_fit = cell_fit.with_arm_poses()
    if observed.scenes and not cell_fit.inlier_fit.problem.is_combined:
        views = _views_by_camera(observed, cell_fit.poses)
        corners = cell_fit.stated_parameters(observed.scenes, views).linearised()
        problem = cell_fit.problem(corners)
        start, noise = problem.start(cell_fit.fit.frames), cell_fit.noise
        state = solve_problem(problem, start, noise)[0]
        fit = Solution(state, estimate_noise(problem, state, noise))
        return cell_fit.with_joint_fit(Fit(problem, fit, corners))
    return replace(cell_fit, inlier_fit=cell_fit.inlier_fit.refitted())


def _with_likelier_noise(cell_fit: CellFit, observed: Observed) -> CellFit:
    """Takes the combined noise of robot and camera as the flange's, where that is clearly likelier.

    Servo arms turn by a degree from stop to stop. Taken for noise of the targets, that attenuates
    the edges, since the robot's poses are then regressors without errors (Fuller 1987, 1.1).
    """
    inliers = cell_fit.inlier_fit
    of_flange = replace(inliers, problem=replace(inliers.problem, is_combined=False))
    if len(of_flange.problem.units[1]) < len(of_flange.problem):
        # Several observations of one stop separate both noises, but not as one level.
        return cell_fit
    try:
        of_flange = of_flange.refitted()
        other = _fit_with_inliers(replace(cell_fit, inlier_fit=of_flange), observed)
    except (VisioncalError, np.linalg.LinAlgError):
        # A state to which no fit converges is not likelier.
        return cell_fit

    def misfit(found: InlierFit) -> float:
        """Negative log-likelihood of the same observations."""
        part, fit = found.problem.subset(inliers.used), found.fit
        misfit = robot_likelihood(part, fit.state, fit.noise).white[1]
        # It is that of errors by which noise acts, in whose units the residuals are.
        is_shaped = part.is_combined and part.observations.shapes is not None
        return misfit + float(np.linalg.slogdet(part.ideal_errors(fit.state))[1].sum()) * is_shaped

    return other if misfit(inliers) - misfit(other.inlier_fit) > CONTRADICTION else cell_fit


def _without_misreported(inliers: InlierFit, arms: Mapping[str, Arm], before: Mask) -> InlierFit:
    """Removes new inliers whose reported robot pose contradicts the arm's joint angles."""
    # They agree with joints and camera, but their reported poses would mislead the next fit.
    problem, used = inliers.problem, inliers.used.copy()
    stops = problem.observations.stops
    for robot, arm in arms.items():
        by_robot = rows_of(problem, robot)
        sound = np.isin(np.arange(len(arm.has_pose)), stops[by_robot & before])
        used &= before | ~by_robot | arm.reports_matching_joints(sound)[stops]
    if np.array_equal(used, inliers.used):
        return inliers
    return replace(inliers, used=used).refitted()


def _calibrate_arms(
    cell_fit: CellFit, observed: Observed, final: InlierFit | None
) -> tuple[CellFit, Noise]:
    """Alternates between calibrating the arms and updating the inliers until neither changes.

    Args:
        cell_fit: The fit.
        observed: The observations.
        final: Inliers that need no update, if any.

    Returns:
        The fit, and its noise without errors that repeated views share.
    """
    noise = cell_fit.noise
    for iteration in range(_ROUNDS + 1):
        if observed.progress is not None:
            observed.progress("arms", iteration, _ROUNDS + 1)
        if cell_fit.level != "hand-eye":
            arms = _choose_levels(cell_fit, noise)
            erring = [name for name, arm in arms.items() if arm.has_free_errors]
            clocks = clock_effects(cell_fit.cell, observed.clocks, erring)
            names = {effect.name for effect in clocks}
            others = (effect for effect in cell_fit.other_effects if effect.name not in names)
            effects = (*clocks, *others)
            cell_fit = _converge_arms(replace(cell_fit, arms=arms, other_effects=effects))
        before = cell_fit.inlier_fit
        # The arms are calibrated with the last inliers.
        if iteration == _ROUNDS or before is final:
            break
        # Beside errors that repeated views share, the noise is another: each search has its own.
        inliers = _without_misreported(
            updated_inliers(cell_fit.cell, before.with_noise(noise)), cell_fit.arms, before.used
        )
        noise = inliers.fit.noise
        creeps = creep_effects(inliers.problem)[len(creep_effects(before.problem)) :]
        cell_fit = replace(cell_fit, other_effects=(*cell_fit.other_effects, *creeps))
        # Other inliers, or other moved frames, may allow another calibration level.
        if (
            not creeps
            and before.problem.unknown.keys() == inliers.problem.unknown.keys()
            and np.array_equal(before.used, inliers.used)
            and before.problem.priors == inliers.problem.priors
        ):
            inliers = replace(inliers, problem=before.problem, fit=before.fit)
            return replace(cell_fit, inlier_fit=inliers), noise
        inliers = inliers.with_noise(before.fit.noise)
        cell_fit = _converge_arms(replace(cell_fit, inlier_fit=inliers))
    return cell_fit, noise


def _by_closed_form(cell_fit: CellFit, solver: str) -> CellFit:
    """Replaces the edges by those of a closed form, and the noise by that of its residuals."""
    inliers, part, mount = cell_fit.inlier_fit, cell_fit.inlier_fit.part, cell_fit.cell.mount
    if mount is None:
        raise RuntimeError("closed forms are for one robot and one camera")
    state = closed_form_state(part, solver, inliers.fit.state, mount)
    noise = estimate_noise(part, state, starting_noise(part), from_above=True)
    return replace(cell_fit, inlier_fit=replace(inliers, fit=Solution(state, noise)), solver=solver)


def _fit_with_inliers(start: CellFit, observed: Observed) -> CellFit:
    """Fits lenses, boards and frames, and updates the inliers until they do not change."""
    # In a whole cell the inliers are updated at the end, once the arms are calibrated: a frame
    # that moved must not be taken for outliers.
    cell_fit = start
    for iteration in range(_ROUNDS):
        if observed.progress is not None:
            observed.progress("lenses", iteration, _ROUNDS)
        # Errors of an arm are sought beside the stated lenses and boards, which may hide them.
        if any(arm.errors and arm.errors.is_significant for arm in cell_fit.arms.values()):
            cell_fit = replace(cell_fit, linearised_corners=None)
        cell_fit = _fit_lenses_and_frames(replace(cell_fit, arms=start.arms), observed)
        if not cell_fit.cell.session.has_one_pair:
            break
        before = cell_fit.inlier_fit.used
        cell_fit = replace(cell_fit, inlier_fit=refine_inliers(cell_fit.inlier_fit))
        if np.array_equal(before, cell_fit.inlier_fit.used):
            break
    return cell_fit


def _fit_lenses_and_frames(cell_fit: CellFit, observed: Observed) -> CellFit:
    """Fits lenses, boards and frames, with posture-dependent errors of the arms and their drift."""
    nominal = {name: arm.as_reported for name, arm in cell_fit.arms.items()}
    cell_fit = replace(cell_fit, arms=nominal).with_arm_poses()
    if observed.scenes and not cell_fit.inlier_fit.problem.is_combined:
        if (corners := cell_fit.linearised_corners) is not None:
            # Where other inliers are too far from the last fit, it starts anew.
            with suppress(ConvergenceError):
                return refine_jointly(cell_fit, corners.camera_parameters)
        views = _views_by_camera(observed, cell_fit.poses)
        return refine_jointly(cell_fit, cell_fit.stated_parameters(observed.scenes, views))
    cell_fit = replace(cell_fit, linearised_corners=None)
    if cell_fit.effects:
        cell_fit = cell_fit.refitted()
    erring = cell_fit.with_errors(cell_fit.fit)
    return erring.refitted() if len(erring.effects) > len(cell_fit.effects) else erring


def _choose_levels(cell_fit: CellFit, noise: Noise, *, functions: bool = False) -> dict[str, Arm]:
    """Selects the errors of each arm; functions of its joints only where asked for."""
    fit, level, arms = cell_fit.fit, cell_fit.level, dict(cell_fit.arms)
    views = [cell_fit.cell.rows[index].view for index in np.flatnonzero(cell_fit.inlier_fit.used)]
    for arm, nominal, start in one_nominal(arms, fit):
        found = with_likely_errors(arm, nominal, start, level, noise, views, functions=functions)
        if functions:
            waves = None if found.model is None else found.model.waves
            joints = joints_of(fit.problem, joint_offsets({arm.robot: arm}))
            steps = find_steps(fit.problem, fit.solution, joints) if waves is not None else ()
            # Functions of the joints also explain much of a slipped joint: where the slip explains
            # more, they are left out.
            if waves is None or any(step.gain > waves.gain for step in steps):
                continue
        arms[arm.robot] = found
    return arms


def _converge_arms(cell_fit: CellFit) -> CellFit:
    """Fits and relinearises the calibrated arms in turn until they converge."""
    is_modelled = any(arm.model is not None for arm in cell_fit.arms.values())
    effects_of_fit = cell_fit.inlier_fit.problem.effect_columns
    # The fit may still estimate an arm that is nominal again, with other inliers.
    is_outdated = any(
        f"arm of {name}" in effects_of_fit and not arm.has_free_errors
        for name, arm in cell_fit.arms.items()
    )
    for _ in range(_ROUNDS if is_modelled or is_outdated else 0):
        cell_fit = cell_fit.with_arm_poses()
        if (corners := cell_fit.linearised_corners) is None:
            cell_fit = cell_fit.refitted()
        else:
            fitted = fit_jointly(corners.camera_parameters, cell_fit, cell_fit.fit.frames)
            cell_fit = cell_fit.with_joint_fit(fitted)
        moved = {name: arm.relinearised(cell_fit.fit) for name, arm in cell_fit.arms.items()}
        cell_fit = replace(cell_fit, arms={name: arm for name, (arm, _) in moved.items()})
        if max(step for _, step in moved.values()) < _CONVERGED_RAD:
            break
    return cell_fit


def _views_by_camera(observed: Observed, views: Sequence[ViewPoses]) -> dict[str, list[ViewPoses]]:
    """The views that a fit may use of each camera's images, each with its chosen pose."""
    poses = {**observed.poses, **{view.view: view for view in views}}
    # Spared frames of a sweep were taken while the robot moved.
    excluded = observed.held_back | observed.spared.keys()
    return {
        frame: [poses[view] for view in look.corners if view in poses and view not in excluded]
        for frame, look in observed.cameras.items()
    }
