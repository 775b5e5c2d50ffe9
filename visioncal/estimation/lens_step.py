"""A lens that was zoomed, focused anew or hit midway: before and after, corners have two lenses.

By the corners alone: their poses are eliminated view by view, and a step of the focal length and of
the principal point is tested at each view (Rao's score test), beside the lens that all have.
"""

from dataclasses import dataclass
from math import comb

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.types import Camera, FloatArray, IntArray
from visioncal.estimation.corners import CornerStack, WithoutPoses, reproject
from visioncal.estimation.linalg import covariance_from

# Views on either side.
_FEWEST = 3
_FALSE_ALARM = 1e-4
# An autofocus, or corners that err by where they are, would show as much in some order of the views
# that is as likely as theirs; so many orders are tried, and so few may show more.
_ORDERS, _RARELY = 300, 0.01
# Views that follow each other are alike, and with them what the lens's model leaves: then some part
# of the session that begins otherwhere differs as much. Up to so many views away it is the same.
_SAME = 2


@dataclass(frozen=True)
class LensStep:
    """A step of a lens.

    Attributes:
        first: Place of the first view after it, in the order of the views.
        zoom: By how much the focal length is longer from then on, as a share.
        centre_px: (x, y) how far the principal point is from where it was [px].
        sigmas: Standard deviations of these three.
        gain: Twice what it gains of the log-likelihood.
    """

    first: int
    zoom: float
    centre_px: tuple[float, float]
    sigmas: tuple[float, float, float]
    gain: float


def lens_step(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, order: IntArray
) -> LensStep | None:
    """The most significant step of a lens; None where noise, or no order of the views, explains it.

    Args:
        stack: The corners of v views.
        camera: The lens that all have.
        cam_from_target: (v, 4, 4) the views' poses.
        order: (v,) the views by their time.
    """
    count, tried = len(order), len(order) + 1 - 2 * _FEWEST
    if tried < 1:
        return None
    at = reproject(stack, camera, cam_from_target)
    columns = np.concatenate([at.by_intrinsics, at.residuals[:, :, None]], axis=2)
    left = WithoutPoses.of(stack, at.by_pose, columns, None).left
    products = stack.products_by_view(left, left)[order]
    steps = np.zeros((products.shape[1] - 1, 3))
    steps[:2, 0], steps[2, 1], steps[3, 2] = camera.matrix[:2], 1.0, 1.0
    total = products.sum(axis=0)
    by_lens = float(total[:-1, -1] @ covariance_from(total[:-1, :-1]) @ total[:-1, -1])
    squares, freedom = float(total[-1, -1]) - by_lens, 2 * len(stack.px) - 6 * count - len(total)
    gains, found, covariance = _tested(products[None], steps)
    place = int(gains[0].argmax())
    gain = float(gains[0, place])
    noise = (squares - gain) / max(freedom - 3, 1)
    limit = 3.0 * float(f_limit(_FALSE_ALARM / tried, 3, max(freedom - 3, 1)))
    if freedom <= 3 or gain < limit * noise:
        return None
    first = place + _FEWEST
    rng = np.random.default_rng(0)
    orders = np.array([rng.permutation(count) for _ in range(_ORDERS)])
    others = _tested(products[orders], steps)[0].max(axis=1)
    # Those with the same views before it show the same.
    if np.mean(others > (1.0 + 1e-6) * gain) + 2.0 / comb(count, first) > _RARELY:
        return None
    begins = np.unique(np.linspace(0, count - 1, min(count, _ORDERS)).round().astype(int))
    away = np.abs((begins[:, None] - [0, first] + count // 2) % count - count // 2).min(axis=1)
    parts = (np.arange(count) + begins[away > _SAME, None]) % count
    if len(parts) and _tested(products[parts], steps)[0].max() > gain:
        return None
    # The residual is what is predicted less what was seen: a step undoes it.
    zoom, *centre = (-found[0, place]).tolist()
    sigmas = np.sqrt(noise * np.diag(covariance[0, place])).tolist()
    return LensStep(
        first,
        zoom,
        (centre[0], centre[1]),
        (sigmas[0], sigmas[1], sigmas[2]),
        freedom * float(np.log(squares / (squares - gain))),
    )


def _tested(products: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What steps at each view explain of the squared residuals, in some orders of the views.

    Args:
        products: (o, v, k + 1, k + 1) of lens and residuals of each view, without its pose.
        steps: (k, 3) how the lens steps.

    Returns:
        (o, p) gains at the p places that a step may be at, (o, p, 3) the steps, and (o, p, 3, 3)
        their covariance, at a noise of one.
    """
    total = products.sum(axis=1)[:, None]
    after = np.cumsum(products[:, ::-1], axis=1)[:, ::-1][:, _FEWEST : 1 - _FEWEST]
    known = covariance_from(total[:, :, :-1, :-1])
    across = after[:, :, :-1, :-1] @ steps
    turned = np.swapaxes(across, 2, 3) @ known
    own = np.swapaxes(steps, 0, 1) @ across - turned @ across
    pulls = np.swapaxes(steps, 0, 1) @ after[:, :, :-1, -1:] - turned @ total[:, :, :-1, -1:]
    covariance = covariance_from(own)
    found = covariance @ pulls
    return np.sum(pulls * found, axis=(2, 3)), found[..., 0], covariance
