"""Refinement: what all views share besides the edges, the lens and the board as it really is."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.priors import loosened
from visioncal.calibration.stages.side import FramesSide
from visioncal.core.errors import ConvergenceError
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Corners, FloatArray, IntArray
from visioncal.estimation.appearance import Appearance, Compressed, LensBoardParameters, compress
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.effects.lenses import CameraParameters, LinearisedCorners
from visioncal.estimation.joint import (
    ConvergedFit,
    MeasuredScale,
    Scores,
    Side,
    again,
    chance_limit,
    contradicted_lens,
    diverging,
    measured_scale,
    moved_mahalanobis_sq,
    settle,
)
from visioncal.estimation.lens_field import LensLevels
from visioncal.estimation.lens_levels import are_beyond, estimate_levels
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.parts import State
from visioncal.estimation.scene import lens_prior
from visioncal.estimation.solve import covariance_of, equations_and_cost, left_out_residuals
from visioncal.estimation.variance import likely_sigma

# A board that is off by so much is beyond what is linear.
_FAR = 2e-3
# Robots that err by more [m] may do so because of a board that is far off: it is looked for by fits
# with other sizes, so far apart, and taken where the robots then err by much less.
_ROUGH_M, _TRIED, _MUCH_LESS = 1e-3, 5e-3, 0.5
# No board is off by more.
_FARTHEST = 0.15


def free_of(seen: LinearisedCorners) -> LensBoardParameters:
    """Lens and boards of the only camera, and their covariance."""
    looks, known = seen.looks, seen.known
    ((name, problem),) = looks.problems.items()
    return LensBoardParameters(
        Appearance(looks.camera(name), looks.values[looks.boards]),
        problem.basis,
        problem.positions,
        seen.free,
        seen.held,
        known.information,
        known.gradient,
    )


def refined(
    side: FramesSide, looks: CameraParameters, frames: Mapping[str, FloatArray]
) -> tuple[ConvergedFit, FramesSide]:
    """Fits lenses, boards and frames to all corners together; see `chosen`.

    Once these are as the corners ask for, the residuals determine the noise of each view, and all
    is fitted once more by it.

    Args:
        side: The frames' side.
        looks: The corners, and lenses and boards as they are stated.
        frames: Where the unknown frames are thought to be.

    Returns:
        The fit, and the side with the errors of its arms.
    """
    try:
        with diverging():
            fitted, found = _refined(side, looks, frames, is_plain=False)
        levels = fitted.looks.levels
        sizes = zip(fitted.looks.problems, fitted.seen.sigmas_px, strict=True)
        if not any(name in levels and are_beyond(levels[name], value) for name, value in sizes):
            return _doubted(found, fitted), found
    except ConvergenceError:
        pass
    # A field of many pixels is none: poses run away with it. Lenses are then what they say.
    plain = dict.fromkeys(looks.problems, LensLevels())
    with diverging():
        return _refined(side, looks.with_levels(plain), frames, is_plain=True)


def _refined(
    side: FramesSide,
    looks: CameraParameters,
    frames: Mapping[str, FloatArray],
    *,
    is_plain: bool,
) -> tuple[ConvergedFit, FramesSide]:
    levels = looks.levels
    answer, side = _equally_weighed(side, looks, frames)
    looks = answer.looks.weighed(answer.seen)
    if any(
        problem.stack is not answer.looks.problems[name].stack
        for name, problem in looks.problems.items()
    ):
        answer = again(answer, side, answer.moving, looks)
    elif np.array_equal(answer.moving, looks.first) and not (levels or side.has_errors):
        return answer, side
    if is_plain:
        return answer, side
    looks = answer.looks.with_levels(lens_levels(side, answer))
    return again(answer, side, answer.moving, looks), side


def _equally_weighed(
    side: FramesSide, looks: CameraParameters, frames: Mapping[str, FloatArray]
) -> tuple[ConvergedFit, FramesSide]:
    """Fits all with the weights that the corners have."""
    # Errors of an arm are sought once lenses and boards are as the corners ask for. They may have
    # passed for another lens or board: all is then chosen once more with them free. Errors of any
    # arm's shape decide which values are free, but are not estimated. Their size is that under the
    # stated lenses and boards: a board that changes its size with the arm hides a part of it.
    stated = settle(looks, side, looks.first, frames)
    if not looks.levels:
        levels = lens_levels(side, _sized(side, stated))
        stated = again(stated, side, stated.moving, stated.looks.with_levels(levels))
    answer = chosen(side, stated)
    found = side.with_errors(answer)
    if not any(error.is_significant for error in found.errors):
        return answer, found
    under_stated = side.with_errors(stated)
    erring = (under_stated if under_stated.errors else found).freed(freely=True)
    answer = chosen(erring, _still_asked_for(erring, stated, answer))
    estimating = erring.freed(freely=False)
    if all(error.is_estimated for error in erring.errors):
        return answer, estimating
    fitted = settle(answer.looks, estimating, answer.moving, answer.frames, before=answer.seen)
    found = estimating.with_errors(fitted)
    # Errors that were less than significant under the stated lenses may be it under these.
    if [error.is_estimated for error in found.errors] != [
        error.is_estimated for error in estimating.errors
    ]:
        fitted = settle(fitted.looks, found, fitted.moving, fitted.frames, before=fitted.seen)
    return fitted, found


def _sized(side: Side, fitted: ConvergedFit) -> ConvergedFit:
    """The fit with boards as large as the motion says, where that is far from what is stated."""
    looks = fitted.looks
    away = np.array([_measured(side, fitted, index).scale for index in looks.printed])
    if not np.any(np.abs(away) > _FAR):
        return fitted
    sizes = np.concatenate([looks.scale_of(index) for index in looks.printed])
    looks = looks.without_prior(sizes.tolist()).with_values(sizes, away)
    return again(fitted, side, np.union1d(fitted.moving, sizes), looks)


def lens_levels(side: Side, fitted: ConvergedFit) -> dict[str, LensLevels]:
    """Estimates the sizes of what lenses do beyond their models, near a fit.

    Lenses and boards are free for that, so that what they have wrong is not taken for it.
    """
    levels = fitted.looks.levels
    if any(level.breathing for level in levels.values()):
        # Linearised far from where there is none, that would be underrated.
        still = {name: replace(level, breathing=0.0) for name, level in levels.items()}
        fitted = again(fitted, side, fitted.moving, fitted.looks.with_levels(still))
    looks = fitted.seen.looks
    # A size of the board is left to the motion: a wrong one would pass for breathing. So would a
    # focal length.
    looks = looks.doubting(
        {
            name: (lens_prior(problem.scene), problem.doubted[:0])
            for name, problem in looks.problems.items()
            if len(problem.doubted)
        }
    )
    sizes = [looks.scale_of(index) for index in looks.printed]
    unsized = looks.without_prior(np.concatenate([np.zeros(0), *sizes]).tolist())
    seen = fitted.seen.freed(np.arange(len(looks.values)), unsized)
    # What was measured by hand may be wrong, which is looked at later; all may hang on it.
    problem = side.problem(seen)
    problem = replace(problem, priors=loosened(problem.priors))
    first = np.append(looks.values, np.zeros(seen.by_field.shape[2]))
    state = State(fitted.fit.state.edges, np.concatenate([first, fitted.others]))
    return {
        name: estimate_levels(seen, problem, side.rows(seen), state, fitted.fit.noise, name)
        for name in looks.problems
    }


def _doubted(side: Side, fitted: ConvergedFit) -> ConvergedFit:
    """Fits given lenses that were held once more, as well known as corners and motion have them.

    A lens that is given may be off by less than shows beyond chance. Where its focal length follows
    from the motion alone, that moves a camera by many of its sigmas. The focal length and the
    centre get a prior each, whose size is found by restricted likelihood. They move where the data
    know them better than that, and count where they do not.
    """
    looks, moving = fitted.looks, [fitted.moving]
    # A board that is larger by less than it is known to looks like another focal length.
    scales = np.array(
        [value for board in looks.printed for value in looks.scale_of(board)], dtype=int
    )
    held = [
        name
        for name, problem in looks.problems.items()
        if not problem.scene.estimated
        and problem.scene.matrix_sigma_px is None
        and problem.scene.mode == "auto"
        and problem.has_spare_corners
        and not np.isin(looks.lens_of(name), fitted.moving).any()
    ]
    if not held:
        return fitted
    scores = Scores.of(side, fitted)
    doubts = {}
    for name in held:
        problem, lens = looks.problems[name], looks.lens_of(name)
        focal_px, sigma = looks.values[lens[:2]], lens_prior(problem.scene)
        step, covariance = scores.asked_for(np.append(lens[:4], scales), fitted.moving)
        step, covariance = step[:4], covariance[:4, :4]
        # Both focal lengths have one factor: what parts them shows, and is not in doubt.
        factors = np.zeros((4, 3))
        factors[:2, 0], factors[2, 1], factors[3, 2] = focal_px, 1.0, 1.0
        information = covariance_from(covariance)
        open_ = covariance_from(factors.T @ information @ factors)
        asked = open_ @ (factors.T @ information @ step)
        counting = [lens[:0]]
        for of, places, unit in ((slice(1), slice(2), focal_px), (slice(1, 3), slice(2, 4), 1.0)):
            known = likely_sigma(asked[of], open_[of, of])
            if known > 0.0:
                sigma[places] = unit * known
                counting.append(problem.lens[places])
            if known**2 > np.diag(open_)[of].mean():
                moving += [lens[places], scales]
        doubts[name] = sigma, np.concatenate(counting)
    if not any(len(places) for _, places in doubts.values()):
        return fitted
    together = np.unique(np.concatenate(moving))
    return _contesting(side, again(fitted, side, together, looks.doubting(doubts)))


def _still_asked_for(erring: Side, stated: ConvergedFit, answer: ConvergedFit) -> ConvergedFit:
    """The fit with errors of arms free, and of what was set free before what is still asked for."""
    # Before, noise was as large as these errors: what they had passed for is as stated again, and
    # what really is another is clear now.
    wide = settle(answer.looks, erring, answer.moving, answer.frames, before=answer.seen)
    looks = answer.looks
    freed = [looks.shape_of(index) for index in looks.printed] + [
        looks.lens_of(problem) for problem in looks.problems
    ]
    kept = [
        array
        for array in freed
        if np.isin(array, answer.moving).all()
        and not np.isin(array, stated.moving).any()
        and moved_mahalanobis_sq(wide, array) > chance_limit(len(array))
    ]
    sizes, wide = _still_other_sizes(erring, wide)
    places = np.concatenate([stated.moving, *kept, *sizes])
    unstated = places[np.isinf(looks.prior_sigma[places])]
    restated = stated.looks.without_prior(unstated.tolist())
    restated = restated.with_values(places, wide.looks.values[places])
    return settle(restated, erring, np.unique(places), answer.frames)


def _still_other_sizes(erring: Side, wide: ConvergedFit) -> tuple[list[IntArray], ConvergedFit]:
    """The scales of boards that are others than stated, and the fit with these alone free."""
    # What all boards have in common, links of arms may have, too, and free together none is clear:
    # the least clear one is as stated, and the rest are measured anew beside it.
    looks = wide.looks
    free = [index for index in looks.printed if np.isin(looks.scale_of(index), wide.moving).all()]
    while free:
        measured = [measured_scale(erring, wide, board) for board in free]
        least = min(measured, key=lambda value: abs(value.scale) / value.sigma)
        if least.is_another:
            break
        free.remove(least.board)
        place = looks.scale_of(least.board)
        held = wide.looks.with_values(place, looks.stated[place])
        wide = again(wide, erring, np.setdiff1d(wide.moving, place), held)
    return [looks.scale_of(index) for index in free], wide


def _measured(side: Side, fitted: ConvergedFit, board: int) -> MeasuredScale:
    """Measures a board's size by the robots' motion, also where the fit is not linear in it."""
    # A view's line of sight is known much better than its distance. Where views and chain disagree
    # by millimetres, because a board is far off, their lines of sight do, too, and a size that is
    # linear about the views' poses is held by that. The costs of fits with other sizes say more.
    found, looks = measured_scale(side, fitted, board), fitted.looks
    noise, place = fitted.fit.noise, looks.scale_of(board)
    if found.is_another or not any(robot[1] > _ROUGH_M for robot in noise.robots):
        return found

    def held(scale: float) -> ConvergedFit:
        value = looks.values[place] + scale
        return again(fitted, side, fitted.moving, looks.with_values(place, value))

    below, here, above = (
        equations_and_cost(item.problem, item.fit.state, noise)[2]
        for item in (held(-_TRIED), fitted, held(_TRIED))
    )
    bend = below + above - 2.0 * here
    if bend <= 0.0:
        return found
    least = 0.5 * _TRIED * (below - above) / bend
    tried = held(float(np.clip(least, -_FARTHEST, _FARTHEST)))
    less = tried.fit.noise.robots[:, 1] < _MUCH_LESS * noise.robots[:, 1]
    return measured_scale(side, tried, board) if less.any() else found


def chosen(side: FramesSide, fitted: ConvergedFit) -> ConvergedFit:
    """Sets free what the data speak for.

    The boards' bends, given intrinsics together with them, and the boards' scales are set free
    where corners and chains speak for it with more than noise can say, the frames stay determined,
    and views that are left out do not speak against it. What is held although the corners speak
    against it, and a scale that is held, count by their priors in the covariance.

    Args:
        side: The frames' side.
        fitted: The fit with what is free from the start.
    """
    answer = fitted
    for moving in _shapes(side, fitted):
        wider = _freed(side, moving, fitted)
        if _is_determined(wider, fitted) and not _predicts_worse(wider, fitted):
            answer = wider
            break
    resized = _resized(side, _contesting(side, answer))
    if np.array_equal(resized.moving, answer.moving):
        return resized
    # A board of another size speaks against lenses, too.
    return _contesting(side, resized)


def _contesting(side: Side, answer: ConvergedFit) -> ConvergedFit:
    """The fit with the uncertainty of intrinsics that are held although corners contradict them."""
    contested = _contested(side, answer)
    if contested == [name for name, problem in answer.looks.problems.items() if problem.contested]:
        return answer
    return again(answer, side, answer.moving, answer.looks.contesting(contested))


def _freed(side: Side, moving: IntArray, fitted: ConvergedFit) -> ConvergedFit:
    """Fits with more values free; a confident wrong prior is worse than none."""
    wider = again(fitted, side, moving)
    looks = wider.looks
    wrong = [
        looks.lens_of(problem)
        for problem in looks.problems
        if np.isin(looks.lens_of(problem), moving).all() and contradicted_lens(wider, problem)
    ]
    if not wrong:
        return wider
    return again(wider, side, moving, looks.without_prior(np.concatenate(wrong).tolist()))


def _resized(side: FramesSide, fitted: ConvergedFit) -> ConvergedFit:
    """Sets the boards' scales free where the robot measures others than are stated."""
    # One after the other: a board that is off misleads about the others, too, and about the arm's
    # errors, beside which a size is clear or not.
    answer, others = fitted, list[MeasuredScale]()
    for _ in fitted.looks.printed:
        other = _wrongly_sized(side, answer)
        if other is None:
            break
        resized = _sized_as(side, answer, other)
        if not _is_determined(resized, answer):
            break
        answer = resized
        others.append(other)
    if not (others and side.poses_alone):
        return answer
    covariance = side.covariance_by_posture(answer)
    clear = [other for other in others if _is_clear(side, answer, other, covariance)]
    if len(clear) < len(others):
        answer = fitted
        for other in clear:
            answer = _sized_as(side, answer, other)
    return answer


def _sized_as(side: FramesSide, answer: ConvergedFit, other: MeasuredScale) -> ConvergedFit:
    """The fit with the scale of a board free, from where it was measured."""
    place = answer.looks.scale_of(other.board)
    looks = answer.looks.with_values(place, np.array([other.scale]))
    if other.contradicts:
        looks = looks.without_prior(place.tolist())
    return again(answer, side, np.union1d(answer.moving, place), looks)


def _wrongly_sized(side: FramesSide, answer: ConvergedFit) -> MeasuredScale | None:
    """The board whose size is held and farthest from what the robot measures, if any is beyond."""
    looks = answer.looks
    held = [index for index in looks.printed if looks.scale_of(index)[0] not in answer.moving]
    measured = [_measured(side, answer, board) for board in held]
    other = [scale for scale in measured if _is_wrong(side, scale)]
    return max(other, key=lambda value: abs(value.scale) / value.sigma, default=None)


def _is_wrong(side: FramesSide, scale: MeasuredScale) -> bool:
    # An arm whose links may all be too long is hard to distinguish from a board that is too large.
    return scale.contradicts if side.has_errors else scale.is_another


def _is_clear(
    side: FramesSide, resized: ConvergedFit, other: MeasuredScale, covariance: FloatArray
) -> bool:
    """Whether a board is still of another size beside errors of arms without joint angles.

    Such errors follow the posture and pass for a size, whose sigma by white noise is a small part
    of what it is.
    """
    looks = resized.looks
    (place,) = looks.scale_of(other.board)
    at = resized.columns.start + int(np.searchsorted(resized.seen.free, place))
    # What was stated is taken away again.
    known = looks.prior_sigma[place] ** -2.0
    measured = 1.0 / covariance[at, at] - known
    if measured <= 0.0:
        return False
    scale, sigma = looks.values[place] * (1.0 + known / measured), measured**-0.5
    beside = replace(other, scale=float(scale), sigma=max(float(sigma), other.sigma))
    return _is_wrong(side, beside)


def _is_determined(wider: ConvergedFit, fitted: ConvergedFit) -> bool:
    """Whether the views still determine all frames to what is accepted, errors of arms aside."""
    after, before = _worst(wider), _worst(fitted)
    limits = np.tile([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], len(after) // 2)
    # What was not determined before is no fault of lens and board.
    return bool(np.all((after < limits) | (before >= limits)))


def _worst(fitted: ConvergedFit) -> FloatArray:
    """(2 e,) the largest sigma of each unknown frame's rotation [rad] and place [m]."""
    looks, fit = [effect.determined for effect in fitted.problem.effects[:1]], fitted.fit
    problem = fitted.problem.with_effects(looks)
    values = fit.state.values[: sum(map(len, looks))]
    covariance = covariance_of(problem, replace(fit, state=State(fit.state.edges, values)))
    places = np.arange(6 * len(problem.unknown)).reshape(-1, 3)
    return np.sqrt([np.linalg.eigvalsh(covariance[np.ix_(place, place)])[-1] for place in places])


def _contested(side: Side, answer: ConvergedFit) -> list[str]:
    """Cameras whose intrinsics are held, and explain the corners worse than chance does."""
    looks, moving = answer.looks, answer.moving
    held = [
        problem for problem in looks.problems if not np.isin(looks.lens_of(problem), moving).all()
    ]
    if not held or not looks.has_spare_corners:
        return []
    bent = np.union1d(moving, looks.shape)
    lenses = {name: looks.lens_of(name) for name in held}
    scores = Scores.of(side, answer)
    least = scores.gain(bent)
    return [
        name
        for name, lens in lenses.items()
        if scores.gain(np.union1d(bent, lens)) - least > chance_limit(len(lens))
    ]


def remade(
    views: Sequence[ViewPoses], free: LensBoardParameters, sigma_px: float
) -> tuple[ViewPoses, ...]:
    """Makes the poses of views anew that had no part in the fit.

    Args:
        views: The views, each with its one pose and its corners.
        free: Lens and board.
        sigma_px: Noise of a corner's coordinate [px].
    """
    if not views:
        return ()
    stack = CornerStack.of(_corners(views), free.positions)
    starts = np.array([view.cam_from_target[0] for view in views])
    with one_blas_thread():
        compressed = compress(stack, free.basis, free.appearance, starts)
    return tuple(
        _remade(view, compressed, free.columns, sigma_px, at) for at, view in enumerate(views)
    )


def _shapes(side: Side, fitted: ConvergedFit) -> Iterator[IntArray]:
    """The bends, with given intrinsics or without, where they explain significantly more."""
    looks, now = fitted.looks, fitted.moving
    if not looks.has_spare_corners:
        return
    bent = np.union1d(now, looks.shape)
    stated = {
        name: np.setdiff1d(looks.lens_of(name), bent)
        for name, problem in looks.problems.items()
        if problem.scene.mode != "hold"
    }
    scores = Scores.of(side, fitted)
    gain_bent = scores.gain(bent)
    gains = {
        name: scores.gain(np.union1d(bent, lens)) - gain_bent - chance_limit(len(lens))
        for name, lens in stated.items()
        if len(lens)
    }
    # The one that is asked for least is done without first.
    asked = sorted(
        (name for name, gain in gains.items() if gain > 0.0), key=lambda index: -gains[index]
    )
    while asked:
        yield np.unique(np.concatenate([bent, *(stated[name] for name in asked)]))
        asked.pop()
    if len(bent) > len(now) and gain_bent > chance_limit(len(bent) - len(now)):
        yield bent


def _predicts_worse(wider: ConvergedFit, fitted: ConvergedFit) -> bool:
    """Whether views that are left out are predicted worse, in position and in rotation."""
    # Intrinsics whose sigma is stated are free to move within that, whatever they predict.
    looks = wider.looks
    freed = [
        problem.scene
        for name, problem in looks.problems.items()
        if np.isin(looks.lens_of(name), np.setdiff1d(wider.moving, fitted.moving)).all()
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


def _remade(
    view: ViewPoses, compressed: Compressed, columns: IntArray, sigma_px: float, at: int
) -> ViewPoses:
    covariance = floored_sigma_px(sigma_px) ** 2 * covariance_from(compressed.information[at])
    return replace(
        view,
        cam_from_target=compressed.cam_from_target[at][None],
        covariance=covariance[None],
        by_shared=compressed.by_shared[at][None, :, columns],
    )
