"""Joint fit of lenses, boards and frames, with the sizes of their errors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.priors import with_loose_positions
from visioncal.core.errors import ConvergenceError
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.threads import one_blas_thread
from visioncal.estimation.appearance import Appearance, LensBoardParameters, compress
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.fit import Fit
from visioncal.estimation.joint import (
    FOLLOWS,
    UNEVEN_LINKS,
    FrameModel,
    diverging,
    fit_jointly,
    moved_mahalanobis_sq,
    others_of,
)
from visioncal.estimation.lens_field import LensLevels, LensSizes
from visioncal.estimation.lens_levels import estimate_sizes
from visioncal.estimation.problem_parts import State

# Prior sigma of a printed board's scale, as a share: prints are scaled to fit a page.
PRINTED_SCALE = 0.03
# Largest error of a board's size, as a share.
_FARTHEST = 0.2


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
    cell_fit: CellFit, optics: CameraParameters, *, is_sized: bool = False
) -> CellFit:
    """Fits lenses, boards and frames to all corners together, with the sizes of their errors.

    A given lens and a printed board have errors of unknown size, a priori zero, in one likelihood
    with those of the robots (`lens_levels`). With these fitted, the residuals determine the noise
    of each view, and all is fitted once more with that.

    Args:
        cell_fit: The fit from which the frames start.
        optics: Lenses and boards, stated or of a fit with other inliers or effects.
        is_sized: Whether they are of such a fit, whose sizes are the start.

    Returns:
        The fit, with the errors of its arms.
    """
    frames, stated = cell_fit.fit.frames, None
    with diverging():
        if not is_sized:
            # Sizes are estimated from above: near a wrong size, lines of sight restrain another.
            wide = tuple(
                replace(item, scale=max(item.scale, PRINTED_SCALE)) for item in optics.board_sizes
            )
            stated = fit_jointly(optics.with_sizes({}, {}, wide), cell_fit, frames)
        if stated is None or _is_shrunk(stated):
            stated = fit_jointly(optics, cell_fit, frames)
        fitted, posture = with_sizes(cell_fit, stated)
        after, sized = cell_fit.with_errors(fitted), fitted
        if after.has_links:
            fitted, after = _beside_arms(cell_fit, after, stated)
        weighed = fitted.camera_parameters.weighed(fitted.linearised)
        stacks = zip(weighed.problems.values(), optics.problems.values(), strict=True)
        if any(problem.stack is not before.stack for problem, before in stacks):
            fitted = _follows(after, fitted, weighed) or fitted
        if fitted is not sized:
            fitted, _ = with_sizes(after, fitted, posture)
        return after.with_joint_fit(fitted)


def _beside_arms(before: CellFit, after: CellFit, stated: Fit) -> tuple[Fit, CellFit]:
    """The fit with errors of the arms, which may have passed for those of lenses and boards.

    Their sigma is that under the stated lenses and boards, where these show any: a board whose size
    changes with the arm hides a part of it.
    """
    under_stated = before.with_errors(stated)
    estimating = under_stated if under_stated.has_links else after
    fitted = fit_jointly(stated.camera_parameters, estimating, stated.frames)
    return with_sizes(estimating, fitted)[0], estimating


def with_sizes(
    cell_fit: CellFit, fitted: Fit, posture: Mapping[str, ArmErrors] = MappingProxyType({})
) -> tuple[Fit, Mapping[str, ArmErrors]]:
    """The fit with estimated sizes of the errors of lenses and boards; itself if that diverges.

    Args:
        cell_fit: The frames' side of the fit.
        fitted: The fit.
        posture: Errors of arms without joint angles beside which sizes are estimated; where there
            are none, they are estimated if they matter.

    Returns:
        The fit, and these errors.
    """
    follows = _follows(cell_fit, fitted, _estimated(cell_fit, fitted, posture))
    if follows is None or posture or not cell_fit.arms_without_joints:
        return follows or fitted, posture
    sized = follows.camera_parameters
    zooms = (problem.lens_sizes.focal for problem in sized.problems.values())
    if not any((*(item.scale for item in sized.board_sizes), *zooms)):
        return follows, posture
    # Errors of arms without joint angles depend on the posture and look like a size, or a zoom.
    posture = cell_fit.pose_errors(follows)
    again = _follows(cell_fit, follows, _estimated(cell_fit, follows, posture))
    return again or follows, posture


def _follows(model: FrameModel, fitted: Fit, sized: CameraParameters) -> Fit | None:
    """A refit with other sizes; None where it diverges."""

    # Cameras that disagree about a stop agree once the board has shrunk to nothing, or the lenses
    # image nothing: such a fit may converge, but no corner is where it was seen.
    def refitted(optics: CameraParameters) -> Fit:
        return fit_jointly(optics, model, fitted.frames, others_of(fitted))

    try:
        refit = refitted(sized)
        if _is_shrunk(refit):
            stated = tuple(replace(item, scale=0.0) for item in sized.board_sizes)
            refit = refitted(sized.with_sizes({}, {}, stated))
    except ConvergenceError:
        return None
    sigmas = zip(refit.linearised.sigmas_px, fitted.linearised.sigmas_px, strict=True)
    is_followed = all(sigma <= FOLLOWS * floored_sigma_px(before) for sigma, before in sigmas)
    return refit if is_followed else None


def _is_shrunk(fitted: Fit) -> bool:
    """Whether a board's size is farther from the stated one than any board's."""
    optics = fitted.camera_parameters
    return bool(np.any(np.abs(optics.values[optics.scales]) > _FARTHEST))


def _estimated(
    cell_fit: CellFit, fitted: Fit, posture: Mapping[str, ArmErrors]
) -> CameraParameters:
    """Lenses and boards with the sizes of their errors, near a fit.

    `posture` are errors of arms without joint angles, by robot, beside which they are estimated.
    """
    optics = fitted.linearised.camera_parameters
    seen, noise = replace(fitted.linearised, is_flat=True), fitted.noise
    # Priors may be wrong, which is tested later; without them, frames may be undetermined.
    problem = cell_fit.problem(seen)
    problem = replace(problem, priors=with_loose_positions(problem.priors))
    values = {
        effect.name: fitted.problem.values_of(effect.name, fitted.state)
        for effect in problem.effects[1:]
    } | {LENSES: np.append(optics.values, np.zeros(sum(seen.field_sizes)))}
    for robot, errors in posture.items():
        effect = errors.effect(robot)
        others = [other for other in problem.effects if other.name != effect.name]
        problem = problem.with_effects([*others, effect])
        values[effect.name] = np.zeros(len(effect))
        if errors.white is not None:
            noise = noise.with_robot(problem.robots.index(robot), errors.white)
    in_order = [values[effect.name] for effect in problem.effects]
    state = State(fitted.state.edges, np.concatenate(in_order))
    problem = problem.sized_at(state)
    levels, lenses, boards = dict[str, LensLevels](), dict[str, LensSizes](), optics.board_sizes
    for name in optics.problems:
        rows, uneven = cell_fit.rows(seen), UNEVEN_LINKS if cell_fit.has_links else 1.0
        # What other cameras tell of the boards is known to each.
        levels[name], lenses[name], boards = estimate_sizes(
            seen, problem, rows, state, noise, name, uneven
        )
    # Errors of an arm look like a scale, too: beside them, boards are sized where that is clear.
    is_doubtful = bool(cell_fit.arms_without_joints) or cell_fit.has_links
    holds = is_doubtful and not _have_other_sizes(fitted)
    return fitted.camera_parameters.with_sizes(levels, lenses, boards, holds_scales=holds)


def _have_other_sizes(fitted: Fit) -> bool:
    """Whether all boards have free scales, which differ from the stated ones beside arm errors."""
    seen = fitted.linearised
    scales = seen.camera_parameters.scales
    if not len(scales) or not np.isin(scales, seen.free).all():
        return False
    limit = UNEVEN_LINKS**2 * chi2_limit(FALSE_ALARM, len(scales))
    columns = fitted.lens_columns.start + np.searchsorted(seen.free, scales)
    return bool(moved_mahalanobis_sq(fitted, columns) > limit)


def recompute_poses(
    views: Sequence[ViewPoses], free: LensBoardParameters, sigma_px: float
) -> tuple[ViewPoses, ...]:
    """Recomputes the poses of views that are not in the fit, with the fitted lens and board.

    Each view has its one pose and its corners; `sigma_px` is the noise of a corner's coordinate.
    """
    if not views:
        return ()
    corners = {view.view: view.corners for view in views if view.corners is not None}
    starts = np.array([view.cam_from_target[0] for view in views])
    with one_blas_thread():
        stack = CornerStack.of(corners, free.positions)
        compressed = compress(stack, free.basis, free.appearance, starts)
    covariances = floored_sigma_px(sigma_px) ** 2 * compressed.covariance
    return tuple(
        replace(
            view,
            cam_from_target=compressed.cam_from_target[at][None],
            covariance=covariances[at][None],
            shared_jacobian=compressed.by_shared[at][None, :, free.columns],
        )
        for at, view in enumerate(views)
    )
