"""Joint fit of lenses, boards and frames."""

from contextlib import suppress

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.core.errors import ConvergenceError
from visioncal.estimation.effects.lenses import CameraParameters
from visioncal.estimation.joint import diverging, fit_jointly, others_of

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
