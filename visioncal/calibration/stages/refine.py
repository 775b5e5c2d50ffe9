"""Joint fit of lenses, boards and frames, and the selection of the values that it frees."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from visioncal.calibration.stages.frame_model import CellFrameModel
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.priors import with_loose_positions
from visioncal.core.errors import ConvergenceError
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Corners, FloatArray, IntArray
from visioncal.estimation.appearance import Appearance, Compressed, LensBoardParameters, compress
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.effects.lenses import CameraParameters, LinearisedCorners
from visioncal.estimation.joint import (
    FOLLOWS,
    ConvergedFit,
    FrameModel,
    MeasuredScale,
    Scores,
    chance_limit,
    contradicted_lens,
    diverging,
    fit_jointly,
    measured_scale,
    moved_mahalanobis_sq,
    refit_jointly,
)
from visioncal.estimation.lens_field import LensLevels
from visioncal.estimation.lens_levels import are_beyond, estimate_levels
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.mixed import likely_sigma
from visioncal.estimation.normal_equations import equations_and_cost
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.problem_parts import State
from visioncal.estimation.scene import lens_prior
from visioncal.estimation.solve import (
    covariance_of,
    left_out_residuals,
)

# Relative error of a board's size beyond the linear range.
_NONLINEAR = 2e-3
# Larger robot noise [m] may come from a board with a wrong size: fits with sizes that differ by
# this step are compared, and a size is taken where it reduces the noise to less than this ratio.
_ROUGH_M, _STEP, _NOISE_RATIO = 1e-3, 5e-3, 0.5
# Largest relative error of a board's size.
_FARTHEST = 0.15


def free_parameters_of_camera(seen: LinearisedCorners) -> LensBoardParameters:
    """Lens and boards of the only camera, and their covariance."""
    cameras, prior = seen.camera_parameters, seen.known
    ((name, problem),) = cameras.problems.items()
    return LensBoardParameters(
        Appearance(cameras.camera(name), cameras.values[cameras.boards]),
        problem.basis,
        problem.positions,
        seen.free,
        seen.held,
        prior.information,
        prior.gradient,
    )


def refine_jointly(
    side: CellFrameModel, optics: CameraParameters, frames: Mapping[str, FloatArray]
) -> tuple[ConvergedFit, CellFrameModel]:
    """Fits lenses, boards and frames to all corners together; see `free_supported_values`.

    With these fitted, the residuals determine the noise of each view, and all is fitted once more
    with that. `optics` has stated lenses and boards, `frames` the initial poses of unknown frames.

    Returns:
        The fit, and the side with the errors of its arms.
    """
    try:
        with diverging():
            fitted, new_side = _fit_with_levels(side, optics, frames, is_plain=False)
        levels = fitted.camera_parameters.levels
        sigmas = zip(fitted.camera_parameters.problems, fitted.linearised.sigmas_px, strict=True)
        if not any(name in levels and are_beyond(levels[name], value) for name, value in sigmas):
            return _with_lens_priors(new_side, fitted), new_side
    except ConvergenceError:
        pass
    # A field of many pixels is wrong: poses diverge with it. The lens models are then used without
    # fields.
    no_levels = dict.fromkeys(optics.problems, LensLevels())
    with diverging():
        return _fit_with_levels(side, optics.with_levels(no_levels), frames, is_plain=True)


def _fit_with_levels(
    side: CellFrameModel,
    optics: CameraParameters,
    frames: Mapping[str, FloatArray],
    *,
    is_plain: bool,
) -> tuple[ConvergedFit, CellFrameModel]:
    levels = optics.levels
    fitted, side = _fit_with_own_weights(side, optics, frames)
    optics = fitted.camera_parameters.weighed(fitted.linearised)
    stacks = {name: problem.stack for name, problem in fitted.camera_parameters.problems.items()}
    if any(problem.stack is not stacks[name] for name, problem in optics.problems.items()):
        fitted = refit_jointly(fitted, side, fitted.moving, optics)
    elif np.array_equal(fitted.moving, optics.first) and not (levels or side.has_errors):
        return fitted, side
    if is_plain:
        return fitted, side
    optics = fitted.camera_parameters.with_levels(lens_levels(side, fitted))
    return refit_jointly(fitted, side, fitted.moving, optics), side


def _fit_with_own_weights(
    side: CellFrameModel, optics: CameraParameters, frames: Mapping[str, FloatArray]
) -> tuple[ConvergedFit, CellFrameModel]:
    """Fits all with the corners' own weights."""
    # Errors of an arm are estimated once lenses and boards are fitted. Before, they may have looked
    # like another lens or board: the free values are then chosen once more with them free. Errors
    # of any arm's shape decide which values are free, but are not estimated. Their sigma is that
    # under the stated lenses and boards: a board whose size changes with the arm hides a part of
    # it.
    stated = _with_refined_matrices(side, fit_jointly(optics, side, optics.first, frames))
    if not optics.levels:
        levels = lens_levels(side, _with_measured_sizes(side, stated))
        stated = refit_jointly(
            stated, side, stated.moving, stated.camera_parameters.with_levels(levels)
        )
    selected = free_supported_values(side, stated)
    new_side = side.with_errors(selected)
    if not any(error.is_significant for error in new_side.errors):
        return selected, new_side
    under_stated = side.with_errors(stated)
    freeing = (under_stated if under_stated.errors else new_side).freed(freely=True)
    selected = free_supported_values(freeing, _still_significant(freeing, stated, selected))
    estimating = freeing.freed(freely=False)
    if all(error.is_estimated for error in freeing.errors):
        return selected, estimating
    fitted = _with_other_effects(estimating, selected)
    new_side = estimating.with_errors(fitted)
    # Errors that were not significant under the stated lenses may be so under these.
    if [error.is_estimated for error in new_side.errors] != [
        error.is_estimated for error in estimating.errors
    ]:
        fitted = _with_other_effects(new_side, fitted)
    return fitted, new_side


def _with_other_effects(side: FrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """Fits again with other effects beside lenses and boards, which start at their own values."""
    return fit_jointly(
        fitted.camera_parameters, side, fitted.moving, fitted.frames, before=fitted.linearised
    )


def _with_refined_matrices(side: FrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """The fit without those stated priors of matrices that it contradicts by many sigmas."""
    problems = fitted.camera_parameters.problems.items()
    refined = [name for name, problem in problems if problem.is_refined_by_prior]
    freed = _tried(fitted, partial(_without_contradicted_priors, side, fitted, refined))
    return freed if freed is fitted or _is_determined(freed, fitted) else fitted


def _with_measured_sizes(side: FrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """The fit with board sizes by the motion, where these differ much from the stated ones."""
    optics = fitted.camera_parameters
    scales = np.array([_measured_size(side, fitted, index).scale for index in optics.printed])
    if not np.any(np.abs(scales) > _NONLINEAR):
        return fitted
    sizes = np.concatenate([optics.scale_of(index) for index in optics.printed])
    optics = optics.without_prior(sizes.tolist()).with_values(sizes, scales)
    moving = np.union1d(fitted.moving, sizes)
    return _tried(fitted, partial(refit_jointly, fitted, side, moving, optics))


def lens_levels(side: FrameModel, fitted: ConvergedFit) -> dict[str, LensLevels]:
    """Estimates the sizes of deviations of lenses from their models, near a fit.

    Lenses and boards are free for that, so that their errors do not count as such deviations.
    """
    levels = fitted.camera_parameters.levels
    if any(level.breathing for level in levels.values()):
        # Linearised at a value far from zero, breathing would be underestimated.
        no_breathing = {name: replace(level, breathing=0.0) for name, level in levels.items()}
        fitted = refit_jointly(
            fitted, side, fitted.moving, fitted.camera_parameters.with_levels(no_breathing)
        )
    optics = fitted.linearised.camera_parameters
    # The board's size is left to the motion: a wrong one would look like breathing, and so would a
    # focal length.
    doubted = {name: item for name, item in optics.problems.items() if len(item.doubted)}
    optics = optics.doubting(
        {name: (lens_prior(item.scene), item.doubted[:0]) for name, item in doubted.items()}
    )
    sizes = [optics.scale_of(index) for index in optics.printed]
    unsized = optics.without_prior(np.concatenate([np.zeros(0), *sizes]).tolist())
    seen = fitted.linearised.freed(np.arange(len(optics.values)), unsized)
    # Priors may be wrong, which is tested later; without them, frames may be undetermined.
    problem = side.problem(seen)
    problem = replace(problem, priors=with_loose_positions(problem.priors))
    values = np.append(optics.values, np.zeros(seen.by_field.shape[2]))
    state = State(fitted.fit.state.edges, np.concatenate([values, fitted.others]))
    return {
        name: estimate_levels(seen, problem, side.rows(seen), state, fitted.fit.noise, name)
        for name in optics.problems
    }


def _with_lens_priors(side: FrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """Refits with priors on given lenses that were held, whose sigmas corners and motion determine.

    A given lens may have errors that are not significant. Where its focal length follows from the
    motion alone, that moves a camera by many of its sigmas. The focal length and the centre get a
    prior each, whose sigma is estimated by restricted likelihood (REML). They are freed where the
    data determine them better than the prior, and count in the covariance where not.
    """
    optics, moving = fitted.camera_parameters, [fitted.moving]
    # A size error within the board's sigma looks like another focal length.
    scales = np.array(
        [value for board in optics.printed for value in optics.scale_of(board)], dtype=int
    )
    held = [
        name
        for name, problem in optics.problems.items()
        if not problem.scene.estimated
        and problem.scene.matrix_sigma_px is None
        and problem.scene.mode == "auto"
        and problem.has_spare_corners
        and not np.isin(optics.lens_of(name), fitted.moving).any()
    ]
    if not held:
        return fitted
    scores = Scores.of(side, fitted)
    doubts = {}
    for name in held:
        problem, lens = optics.problems[name], optics.lens_of(name)
        focal_px, sigma = optics.values[lens[:2]], lens_prior(problem.scene)
        step, covariance = scores.asked_for(np.append(lens[:4], scales), fitted.moving)
        step, covariance = step[:4], covariance[:4, :4]
        # Both focal lengths have one factor: their ratio is determined well, and not in doubt.
        factors = np.zeros((4, 3))
        factors[:2, 0], factors[2, 1], factors[3, 2] = focal_px, 1.0, 1.0
        information = covariance_from(covariance)
        factor_covariance = covariance_from(factors.T @ information @ factors)
        factor_steps = factor_covariance @ (factors.T @ information @ step)
        in_covariance = [lens[:0]]
        for axes, places, unit in ((slice(1), slice(2), focal_px), (slice(1, 3), slice(2, 4), 1.0)):
            sigma_factor = likely_sigma(factor_steps[axes], factor_covariance[axes, axes])
            if sigma_factor > 0.0:
                sigma[places] = unit * sigma_factor
                in_covariance.append(problem.lens[places])
            if sigma_factor**2 > np.diag(factor_covariance)[axes].mean():
                moving += [lens[places], scales]
        doubts[name] = sigma, np.concatenate(in_covariance)
    if not any(len(places) for _, places in doubts.values()):
        return fitted
    free = np.unique(np.concatenate(moving))
    return _with_contested_lenses(side, refit_jointly(fitted, side, free, optics.doubting(doubts)))


def _still_significant(
    side: FrameModel, stated: ConvergedFit, fitted: ConvergedFit
) -> ConvergedFit:
    """The fit with arm errors and with those freed values that are still significant."""
    # Before, these errors were part of the noise: values that had absorbed them return to the
    # stated ones, and real deviations are clear now.
    refit = _with_other_effects(side, fitted)
    optics = fitted.camera_parameters
    groups = [optics.shape_of(index) for index in optics.printed] + [
        optics.lens_of(problem) for problem in optics.problems
    ]
    kept = [
        array
        for array in groups
        if np.isin(array, fitted.moving).all()
        and not np.isin(array, stated.moving).any()
        and moved_mahalanobis_sq(refit, array) > chance_limit(len(array))
    ]
    sizes, refit = _significant_sizes(side, refit)
    places = np.concatenate([stated.moving, *kept, *sizes])
    without_prior = places[np.isinf(optics.prior_sigma[places])]
    restated = stated.camera_parameters.without_prior(without_prior.tolist())
    restated = restated.with_values(places, refit.camera_parameters.values[places])
    return fit_jointly(restated, side, np.unique(places), fitted.frames)


def _significant_sizes(side: FrameModel, fit: ConvergedFit) -> tuple[list[IntArray], ConvergedFit]:
    """The board scales that still differ from the stated ones, and the fit with these free."""
    # An error common to all boards looks like one of the arms' links, and with all free together
    # none is significant: the least significant one is reset, and the others are measured again.
    optics = fit.camera_parameters
    boards = [
        board for board in optics.printed if np.isin(optics.scale_of(board), fit.moving).all()
    ]
    while boards:
        measured = [measured_scale(side, fit, board) for board in boards]
        least = min(measured, key=lambda value: abs(value.scale) / value.sigma)
        if least.is_another:
            break
        boards.remove(least.board)
        place = optics.scale_of(least.board)
        restated = fit.camera_parameters.with_values(place, optics.stated[place])
        fit = refit_jointly(fit, side, np.setdiff1d(fit.moving, place), restated)
    return [optics.scale_of(index) for index in boards], fit


def _measured_size(side: FrameModel, fitted: ConvergedFit, board: int) -> MeasuredScale:
    """Measures a board's size by the robots' motion, also beyond the linear range."""
    # A view's line of sight is determined much better than its distance. Where views and chain
    # disagree by millimetres, because a board's size is wrong, their lines of sight do, too, and
    # restrain a size that is linear about the views' poses. The costs of fits with other sizes do
    # not have this bias.
    linear, optics = measured_scale(side, fitted, board), fitted.camera_parameters
    noise, place = fitted.fit.noise, optics.scale_of(board)
    if linear.is_another or not any(robot[1] > _ROUGH_M for robot in noise.robots):
        return linear

    def refit(scale: float) -> ConvergedFit:
        value = optics.values[place] + scale
        return refit_jointly(fitted, side, fitted.moving, optics.with_values(place, value))

    below, centre, above = (
        equations_and_cost(item.problem, item.fit.state, noise)[2]
        for item in (refit(-_STEP), fitted, refit(_STEP))
    )
    curvature = below + above - 2.0 * centre
    if curvature <= 0.0:
        return linear
    least = 0.5 * _STEP * (below - above) / curvature
    refitted = refit(float(np.clip(least, -_FARTHEST, _FARTHEST)))
    is_reduced = refitted.fit.noise.robots[:, 1] < _NOISE_RATIO * noise.robots[:, 1]
    return measured_scale(side, refitted, board) if is_reduced.any() else linear


def free_supported_values(side: CellFrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """Frees the values that the data support, beside those that are free from the start.

    The boards' bends, given intrinsics together with them, and the boards' scales are freed where
    corners and chains support it significantly, the frames stay determined, and held-out views are
    not predicted worse. Held values that the corners contradict, and a held scale, count by their
    priors in the covariance.
    """
    best = fitted
    for moving in _shape_sets(side, fitted):
        freed = _tried(fitted, partial(_fit_freed, side, moving, fitted))
        is_other = freed is not fitted and _is_determined(freed, fitted)
        if is_other and not _predicts_worse(freed, fitted):
            best = freed
            break
    resized = _with_freed_scales(side, _with_contested_lenses(side, best))
    if np.array_equal(resized.moving, best.moving):
        return resized
    # A board of another size may contradict lenses, too.
    return _with_contested_lenses(side, resized)


def _with_contested_lenses(side: FrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """The fit with the uncertainty of held intrinsics that corners contradict."""
    contested = _contested_cameras(side, fitted)
    if contested == [
        name for name, problem in fitted.camera_parameters.problems.items() if problem.contested
    ]:
        return fitted
    return refit_jointly(
        fitted, side, fitted.moving, fitted.camera_parameters.contesting(contested)
    )


def _fit_freed(side: FrameModel, moving: IntArray, fitted: ConvergedFit) -> ConvergedFit:
    """Fits with more values free, without priors of lenses that they contradict."""
    wider = refit_jointly(fitted, side, moving)
    optics = wider.camera_parameters
    return _without_contradicted_priors(
        side,
        wider,
        [name for name in optics.problems if np.isin(optics.lens_of(name), moving).all()],
    )


def _without_contradicted_priors(
    side: FrameModel, fitted: ConvergedFit, cameras: Sequence[str]
) -> ConvergedFit:
    """Fits without the priors of those cameras' free lenses that contradict them."""
    optics, moving = fitted.camera_parameters, fitted.moving
    wrong = [
        np.intersect1d(optics.lens_of(name), moving)
        for name in cameras
        if contradicted_lens(fitted, name)
    ]
    if not wrong:
        return fitted
    return refit_jointly(fitted, side, moving, optics.without_prior(np.concatenate(wrong).tolist()))


def _with_freed_scales(side: CellFrameModel, fitted: ConvergedFit) -> ConvergedFit:
    """Frees the boards' scales where the robot measures others than are stated."""
    # One after the other: a wrong size biases the others, too, and the arm's errors, beside which a
    # size is tested.
    result, sizes = fitted, list[MeasuredScale]()
    for _ in fitted.camera_parameters.printed:
        size = _most_wrong_size(side, result)
        if size is None:
            break
        resized = _tried(result, partial(_with_scale, side, result, size))
        if resized is result or not _is_determined(resized, result):
            break
        result = resized
        sizes.append(size)
    if not (sizes and side.arms_without_joints):
        return result
    covariance = side.covariance_with_pose_errors(result)
    significant = [size for size in sizes if _is_clear(side, result, size, covariance)]
    if len(significant) < len(sizes):
        result = fitted
        for size in significant:
            result = _with_scale(side, result, size)
    return result


def _with_scale(side: CellFrameModel, fitted: ConvergedFit, size: MeasuredScale) -> ConvergedFit:
    """The fit with the scale of a board free, from its measured value."""
    place = fitted.camera_parameters.scale_of(size.board)
    optics = fitted.camera_parameters.with_values(place, np.array([size.scale]))
    if size.contradicts:
        optics = optics.without_prior(place.tolist())
    return refit_jointly(fitted, side, np.union1d(fitted.moving, place), optics)


def _most_wrong_size(side: CellFrameModel, fitted: ConvergedFit) -> MeasuredScale | None:
    """The held board scale that differs most significantly from the stated one, or None."""
    optics = fitted.camera_parameters
    held = [index for index in optics.printed if optics.scale_of(index)[0] not in fitted.moving]
    measured = [_measured_size(side, fitted, board) for board in held]
    wrong = [size for size in measured if _is_wrong(side, size)]
    return max(wrong, key=lambda value: abs(value.scale) / value.sigma, default=None)


def _is_wrong(side: CellFrameModel, size: MeasuredScale) -> bool:
    # An arm whose links are all too long is hard to distinguish from a board that is too large.
    return size.contradicts if side.has_errors else size.is_another


def _is_clear(
    side: CellFrameModel, resized: ConvergedFit, size: MeasuredScale, covariance: FloatArray
) -> bool:
    """Whether a board's size is still significant beside errors of arms without joint angles.

    Such errors depend on the posture and look like a size, whose sigma by white noise is far too
    small.
    """
    optics = resized.camera_parameters
    (place,) = optics.scale_of(size.board)
    column = resized.columns.start + int(np.searchsorted(resized.linearised.free, place))
    # Removes the prior's information.
    prior_information = optics.prior_sigma[place] ** -2.0
    information = 1.0 / covariance[column, column] - prior_information
    if information <= 0.0:
        return False
    scale, sigma = optics.values[place] * (1.0 + prior_information / information), information**-0.5
    tested = replace(size, scale=float(scale), sigma=max(float(sigma), size.sigma))
    return _is_wrong(side, tested)


def _tried(fitted: ConvergedFit, refit: Callable[[], ConvergedFit]) -> ConvergedFit:
    """A refit with more values free; the fit before, where it diverges."""
    # Cameras that disagree about a stop agree once the board has shrunk to nothing, or the lenses
    # image nothing: such a fit may converge, but no corner is where it was seen.
    try:
        freed = refit()
    except ConvergenceError:
        return fitted
    sigmas = zip(freed.linearised.sigmas_px, fitted.linearised.sigmas_px, strict=True)
    follows = all(sigma <= FOLLOWS * floored_sigma_px(before) for sigma, before in sigmas)
    return freed if follows else fitted


def _is_determined(wider: ConvergedFit, fitted: ConvergedFit) -> bool:
    """Whether the views still determine all frames acceptably, errors of arms aside."""
    after, before = _largest_sigmas(wider), _largest_sigmas(fitted)
    limits = np.tile([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], len(after) // 2)
    # Frames that were undetermined before are not due to lens and board.
    return bool(np.all((after < limits) | (before >= limits)))


def _largest_sigmas(fitted: ConvergedFit) -> FloatArray:
    """(2 e,) the largest sigma of each unknown frame's rotation [rad] and position [m]."""
    optics, fit = [effect.determined for effect in fitted.problem.effects[:1]], fitted.fit
    problem = fitted.problem.with_effects(optics)
    values = fit.state.values[: sum(map(len, optics))]
    covariance = covariance_of(problem, replace(fit, state=State(fit.state.edges, values)))
    places = np.arange(6 * len(problem.unknown)).reshape(-1, 3)
    return np.sqrt([np.linalg.eigvalsh(covariance[np.ix_(place, place)])[-1] for place in places])


def _contested_cameras(side: FrameModel, fitted: ConvergedFit) -> list[str]:
    """Cameras with held intrinsics that the corners contradict."""
    optics, moving = fitted.camera_parameters, fitted.moving
    held = [
        problem for problem in optics.problems if not np.isin(optics.lens_of(problem), moving).all()
    ]
    if not held or not optics.has_spare_corners:
        return []
    bent = np.union1d(moving, optics.shape)
    lenses = {name: optics.lens_of(name) for name in held}
    scores = Scores.of(side, fitted)
    least = scores.gain(bent)
    return [
        name
        for name, lens in lenses.items()
        if scores.gain(np.union1d(bent, lens)) - least > chance_limit(len(lens))
    ]


def recompute_poses(
    views: Sequence[ViewPoses], free: LensBoardParameters, sigma_px: float
) -> tuple[ViewPoses, ...]:
    """Recomputes the poses of views that are not in the fit, with the fitted lens and board.

    Each view has its one pose and its corners; `sigma_px` is the noise of a corner's coordinate.
    """
    if not views:
        return ()
    stack = CornerStack.of(_corners(views), free.positions)
    starts = np.array([view.cam_from_target[0] for view in views])
    with one_blas_thread():
        compressed = compress(stack, free.basis, free.appearance, starts)
    return tuple(
        _remade_view(view, compressed, free.columns, sigma_px, at) for at, view in enumerate(views)
    )


def _shape_sets(side: FrameModel, fitted: ConvergedFit) -> Iterator[IntArray]:
    """Sets of values to free: the bends, with given intrinsics or without, where significant."""
    optics, moving = fitted.camera_parameters, fitted.moving
    if not optics.has_spare_corners:
        return
    bent = np.union1d(moving, optics.shape)
    stated = {
        name: np.setdiff1d(optics.lens_of(name), bent)
        for name, problem in optics.problems.items()
        if problem.scene.mode != "hold"
    }
    scores = Scores.of(side, fitted)
    gain_bent = scores.gain(bent)
    gains = {
        name: scores.gain(np.union1d(bent, lens)) - gain_bent - chance_limit(len(lens))
        for name, lens in stated.items()
        if len(lens)
    }
    # The least significant one is dropped first.
    significant = sorted(
        (name for name, gain in gains.items() if gain > 0.0), key=lambda index: -gains[index]
    )
    while significant:
        yield np.unique(np.concatenate([bent, *(stated[name] for name in significant)]))
        significant.pop()
    if len(bent) > len(moving) and gain_bent > chance_limit(len(bent) - len(moving)):
        yield bent


def _predicts_worse(wider: ConvergedFit, fitted: ConvergedFit) -> bool:
    """Whether held-out views are predicted worse, in position and in rotation."""
    # Intrinsics with a stated sigma are free to move within that in any case.
    optics = wider.camera_parameters
    freed = [
        problem.scene
        for name, problem in optics.problems.items()
        if np.isin(optics.lens_of(name), np.setdiff1d(wider.moving, fitted.moving)).all()
    ]
    if freed and all(scene.matrix_sigma_px is not None for scene in freed):
        return False
    errors = [
        left_out_residuals(item.problem, item.fit.state, item.fit.noise).reshape(-1, 2, 3)
        for item in (wider, fitted)
    ]
    more, less = (np.mean(error**2, axis=(0, 2)) for error in errors)
    return bool(np.all(more > less))


def _corners(views: Sequence[ViewPoses]) -> dict[int, Corners]:
    return {view.view: view.corners for view in views if view.corners is not None}


def _remade_view(
    view: ViewPoses, compressed: Compressed, columns: IntArray, sigma_px: float, at: int
) -> ViewPoses:
    covariance = floored_sigma_px(sigma_px) ** 2 * covariance_from(compressed.information[at])
    return replace(
        view,
        cam_from_target=compressed.cam_from_target[at][None],
        covariance=covariance[None],
        shared_jacobian=compressed.by_shared[at][None, :, columns],
    )
