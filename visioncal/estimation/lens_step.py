"""Step of a lens during the session (zoomed, refocused or hit), found from corners alone.

The poses are eliminated view by view, and a step of the focal length and of the principal point is
tested at each view (Rao's score test), beside the lens common to all.
"""

import numpy as np

from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.quantiles import FALSE_ALARM, f_limit
from visioncal.core.types import Camera, FloatArray, IntArray
from visioncal.estimation.corners import CornerStack, WithoutPoses, reproject
from visioncal.estimation.linalg import covariance_from

# With an autofocus, or residual errors of the lens model, which are alike in successive views, some
# cyclic part of the session with another start differs as much. Starts within this many views of
# the step are the same; most starts tried.
_SAME_WITHIN, _MOST_STARTS = 2, 300


def lens_step(
    stack: CornerStack,
    camera: Camera,
    cam_from_target: FloatArray,
    beyond: FloatArray,
    order: IntArray,
) -> tuple[int, FloatArray, FloatArray, float] | None:
    """The most significant step of a lens.

    Args:
        stack: The corners of v views.
        camera: The lens common to all.
        cam_from_target: (v, 4, 4) the views' poses.
        beyond: (n, 2) displacements of the corners beyond the lens's model [px].
        order: (v,) the views by their time.

    Returns:
        Index in `order` of the first view after the step, (3,) relative increase of the focal
        length and displacement of the principal point [px], their (3,) standard deviations, and
        twice the gain in log-likelihood; None if noise or other parts of the session show more.
    """
    count, tried = len(order), len(order) + 1 - 2 * FEWEST_VIEWS
    if tried < 1:
        return None
    seen = reproject(stack, camera, cam_from_target)
    beyond = beyond.copy()
    stack.weigh(beyond)
    residuals = seen.residuals + beyond
    columns = np.concatenate([seen.by_intrinsics, residuals[:, :, None]], axis=2)
    eliminated = WithoutPoses.of(stack, seen.by_pose, columns, None).left
    products = stack.products_by_view(eliminated, eliminated)[order]
    steps = np.zeros((products.shape[1] - 1, 3))
    steps[:2, 0], steps[2, 1], steps[3, 2] = camera.matrix[:2], 1.0, 1.0
    total = products.sum(axis=0)
    by_lens = float(total[:-1, -1] @ covariance_from(total[:-1, :-1]) @ total[:-1, -1])
    squares, freedom = float(total[-1, -1]) - by_lens, 2 * len(stack.px) - 6 * count - len(total)
    gains, changes, covariance = _tested(products[None], steps)
    index = int(gains[0].argmax())
    gain = float(gains[0, index])
    noise = (squares - gain) / max(freedom - 3, 1)
    limit = 3.0 * float(f_limit(FALSE_ALARM / tried, 3, max(freedom - 3, 1)))
    if freedom <= 3 or gain < limit * noise:
        return None
    first = index + FEWEST_VIEWS
    starts = np.unique(np.linspace(0, count - 1, min(count, _MOST_STARTS)).round().astype(int))
    distance = np.abs((starts[:, None] - [0, first] + count // 2) % count - count // 2).min(axis=1)
    rotations = (np.arange(count) + starts[distance > _SAME_WITHIN, None]) % count
    if len(rotations) and _tested(products[rotations], steps)[0].max() > gain:
        return None
    # Residuals are predicted minus observed: the step has the opposite sign.
    sigmas = np.sqrt(noise * np.diag(covariance[0, index]))
    return first, -changes[0, index], sigmas, freedom * float(np.log(squares / (squares - gain)))


def _tested(products: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Score tests of a step at each view, in some orders of the views.

    Args:
        products: (o, v, k + 1, k + 1) of lens and residuals of each view, its pose eliminated.
        steps: (k, 3) directions of the step among the lens parameters.

    Returns:
        (o, p) reductions of the squared residuals at the p possible places, (o, p, 3) the steps,
        and (o, p, 3, 3) their covariance, at a noise of one.
    """
    total = products.sum(axis=1)[:, None]
    after = np.cumsum(products[:, ::-1], axis=1)[:, ::-1][:, FEWEST_VIEWS : 1 - FEWEST_VIEWS]
    lens_covariance = covariance_from(total[:, :, :-1, :-1])
    across = after[:, :, :-1, :-1] @ steps
    projection = np.swapaxes(across, 2, 3) @ lens_covariance
    information = np.swapaxes(steps, 0, 1) @ across - projection @ across
    gradient = np.swapaxes(steps, 0, 1) @ after[:, :, :-1, -1:] - projection @ total[:, :, :-1, -1:]
    covariance = covariance_from(information)
    changes = covariance @ gradient
    return np.sum(gradient * changes, axis=(2, 3)), changes[..., 0], covariance
