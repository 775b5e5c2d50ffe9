"""Joint fit of lenses, boards and frames."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.core.errors import ConvergenceError
from visioncal.core.threads import one_blas_thread
from visioncal.estimation.appearance import LensBoardParameters, compress
from visioncal.estimation.effects.lenses import CameraParameters
from visioncal.estimation.joint import diverging, fit_jointly, others_of
from visioncal.vision.corners import CornerStack, floored_sigma_px
from visioncal.vision.pnp import ViewPoses

# Prior sigma of a printed board's scale, as a share: prints are scaled to fit a page.
PRINTED_SCALE = 0.03


def refine_jointly(cell_fit: CellFit, optics: CameraParameters) -> CellFit:
    """Fits lenses, boards and frames to all corners together.

    The residuals then determine the noise of each view, and all is fitted once more with that.

    Args:
        cell_fit: The fit from which the frames start.
        optics: Lenses and boards with the sizes of their errors, stated or of a fit with other
            inliers or effects.

    Returns:
        The fit, with the errors of its arms.
    """
    with diverging():
        fitted = fit_jointly(optics, cell_fit, cell_fit.fit.frames)
        after = cell_fit.with_errors(fitted)
        if after.has_links:
            fitted = fit_jointly(fitted.camera_parameters, after, fitted.frames)
        weighed = fitted.camera_parameters.weighed(fitted.linearised)
        stacks = zip(weighed.problems.values(), optics.problems.values(), strict=True)
        if any(problem.stack is not before.stack for problem, before in stacks):
            with suppress(ConvergenceError):
                fitted = fit_jointly(weighed, after, fitted.frames, others_of(fitted))
        return after.with_joint_fit(fitted)


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
