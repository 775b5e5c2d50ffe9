"""Corners of some views that another program found in pictures of another size."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from visioncal.calibration.stages.other_board import MADE_ALIKE
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CLEAR_RATIO, FEWEST_COMPARED, CalibrationLimits
from visioncal.core.number_format import figure, view_words
from visioncal.core.types import Camera, CameraKind, Corners, FloatArray, Target, evenly
from visioncal.core.verdict import Finding
from visioncal.vision.corners import CornerStack, floored_sigma_px, mean_square_by_view
from visioncal.vision.intrinsics import Intrinsics, estimate_intrinsics
from visioncal.vision.poses import fit_poses, planar_poses
from visioncal.vision.targets import numbered_positions

# Sizes of pictures, previews and scaled copies, as shares of the camera's.
_SHARES = (1 / 5, 1 / 4, 1 / 3, 2 / 5, 1 / 2, 3 / 5, 2 / 3, 3 / 4, 4 / 5)
# Views of one lens and one board scatter by less than so many times those that fit best.
_UNEVEN = 2.0
# Views by whose lens a share is tried before all are fitted, which takes as much longer.
_FIRST_VIEWS = 8
# Step by which a share's cost is differentiated.
_STEP = 0.005


@dataclass(frozen=True)
class ScaledViews:
    """Views whose corners fit a board once they are scaled."""

    views: tuple[int, ...]
    share: float  # Size of their pictures as a share of the camera's.
    finding: Finding


def scaled_views(
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    resolution: tuple[int, int],
    fitted: Camera,
    among: Collection[int],
    *,
    is_stated: bool = False,
) -> ScaledViews | None:
    """Finds views whose corners are those of smaller pictures than the others'.

    Such corners all lie in the upper left part of the picture. By a lens that is estimated from
    the other views they fit a pose of the board only once they are scaled, about the outer corner
    of the first pixel. A stated lens may be wrong, which scaling of some views hides.

    Args:
        corners: The corners by view.
        targets: The targets; the corners of several are numbered through.
        resolution: (width, height) of the camera's pictures [px].
        fitted: Intrinsics as stated or by all views, under which unequal noise of views makes the
            search due.
        among: Views that may be of another size.
        is_stated: Whether the intrinsics are stated: no view of another size bent these.

    Returns:
        The views that the likeliest share explains; None where no share clearly explains any.
    """
    if not corners:
        return None
    levels_px = rms_px(corners, targets, fitted)
    uneven = CLEAR_RATIO if is_stated else _UNEVEN
    if levels_px.max() < uneven * float(np.quantile(levels_px, 0.25)):
        return None

    @cache
    def lens_of(views: frozenset[int]) -> Intrinsics | None:
        some = {view: at for view, at in corners.items() if view in views}
        return _lens_of(some, targets, resolution, fitted.model)

    every, found, size = [*corners], list[ScaledViews](), np.array(resolution)
    ends = {frozenset(every[: len(every) // 2]), frozenset(every[len(every) // 2 :])}
    small_by = {
        share: {view: at for view, at in corners.items() if (at.px < share * size).all()}
        for share in _SHARES
    }
    # Views that are small by no share are of the camera's size: one lens of these tries all shares.
    sure = frozenset(every).difference(small_by[_SHARES[-1]])
    for share, small in small_by.items():
        # Where all are small, the views of one end may be of one size.
        beyond = frozenset(every).difference(small)
        tried = {view: at for view, at in small.items() if view in among}
        for views in {beyond} if len(beyond) >= FEWEST_COMPARED else ends:
            if not tried or len(views) < FEWEST_COMPARED:
                continue
            chosen = sorted(sure if len(sure) >= _FIRST_VIEWS else views)
            some = [chosen[at] for at in evenly(len(chosen), _FIRST_VIEWS)]
            first = lens_of(frozenset(some))
            if first is None or not _fit_better(first, tried, targets, share):
                continue
            if (known := lens_of(views)) is not None:
                found += _scaled_by(known, tried, targets, share)
    return max(found, key=lambda each: len(each.views), default=None)


def _fit_better(
    known: Intrinsics, corners: Mapping[int, Corners], targets: Sequence[Target], share: float
) -> bool:
    """Whether any view fits a lens clearly better once it is scaled."""
    given, scaled = (rms_px(corners, targets, known.camera, by) for by in (1.0, 1.0 / share))
    return bool((given > _UNEVEN * scaled).any())


def _scaled_by(
    known: Intrinsics, corners: Mapping[int, Corners], targets: Sequence[Target], share: float
) -> Iterator[ScaledViews]:
    """The views whose corners clearly fit a lens once their pictures are the camera's."""
    lens, sigma_px = known.camera, floored_sigma_px(known.sigma_px)
    given, scaled = (rms_px(corners, targets, lens, by) for by in (1.0, 1.0 / share))
    # By the noise of a corner in its own picture.
    picture_px, counts = share * scaled, np.array([len(at.ids) for at in corners.values()])
    is_known = np.isfinite(given) & np.isfinite(scaled)
    excess = np.subtract(given**2, picture_px**2, out=np.zeros(len(given)), where=is_known)
    fits = is_known & (picture_px < _UNEVEN * sigma_px) & (given > _UNEVEN * scaled)
    # Difference of squared errors over the noise from which on a size is clearly another one: 6
    # sigma.
    fits &= 2.0 * counts * excess > 36.0 * sigma_px**2
    # Clear views determine the share, by which less clear ones are of it, too. A single view is
    # clear from a larger ratio of misfits on.
    clear = fits & (given > (CLEAR_RATIO if fits.sum() > 1 else 5.0) * scaled)
    numbers = np.array([*corners])
    chosen = {view: corners[view] for view in numbers[clear].tolist()}
    if not chosen or not _is_share(known, chosen, targets, share):
        return
    views = tuple(numbers[fits].tolist())
    size = lens.resolution
    width, height = (round(share * side) for side in size)
    words = (
        f"In {view_words(views)}, the corners of corners.csv are those of pictures of {width} x "
        f"{height} px, where the camera's are {size[0]} x {size[1]}: scaled to these, they fit a "
        f"pose of the board to {figure(float(np.median(scaled[fits])))} px, and to "
        f"{figure(float(np.median(given[fits])))} px as they are. They were left out."
    )
    yield ScaledViews(views, share, Finding("image_sizes", words, MADE_ALIKE, views))


def _is_share(
    known: Intrinsics, corners: Mapping[int, Corners], targets: Sequence[Target], share: float
) -> bool:
    """Whether the one share that explains views best is this one, and is known well enough.

    It is by least squares, with the curvature of three costs. The lens adds its own error: corners
    of a share fit a lens of another focal length and centre that are as much smaller.
    """
    counts = np.array([len(at.ids) for at in corners.values()])
    shares = share * (1.0 + _STEP * np.array([-1.0, 0.0, 1.0]))
    costs = [
        2.0 * float(counts @ (each * rms_px(corners, targets, known.camera, 1.0 / each)) ** 2)
        for each in shares
    ]
    curvature = costs[0] - 2.0 * costs[1] + costs[2]
    if not np.isfinite(curvature) or curvature <= 0.0:
        return False
    off = 0.5 * _STEP * (costs[0] - costs[2]) / curvature
    sigma_px = floored_sigma_px(known.sigma_px)
    of_corners = _STEP * sigma_px * np.sqrt(2.0 / curvature)
    of_lens = np.sqrt(np.diag(known.covariance)[:4]) / known.camera.matrix
    most = 3.0 * float(np.hypot(of_corners, of_lens.max()))
    # Most error of a share, 3 sigma of it: usual sizes beside the listed ones (5/8) are 4 % off.
    return bool(abs(off) < most < 0.015)


def smaller_picture(lens: Camera, px: FloatArray) -> tuple[int, int] | None:
    """(width, height) [px] of the pictures that all corners look to be of, else None.

    Nothing scales a lens that is estimated by such corners alone: its centre is that of a smaller
    picture, in whose place, at the upper left, all (n, 2) corners lie.
    """
    size = np.array(lens.resolution)
    shares = 2.0 * (lens.matrix[2:4] + 0.5) / size
    share = min(_SHARES, key=lambda each: float(np.abs(shares - each).max()))
    width, height = np.round(share * size).astype(int).tolist()
    # Most distance of a lens's centre from the middle of its picture, as a share of half the
    # picture.
    is_near = bool(np.all(np.abs(shares - share) < 0.05 * share))
    return (width, height) if is_near and (px < [width, height]).all() else None


def scaled_px(px: FloatArray, factor: float) -> FloatArray:
    """(n, 2) pixels of a picture that is so many times as large, counted from centres of pixels."""
    return factor * (px + 0.5) - 0.5


def _lens_of(
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    resolution: tuple[int, int],
    model: CameraKind,
) -> Intrinsics | None:
    """The lens of some views; None where they determine none."""
    # OpenCV refuses views of nearly one line.
    with suppress(VisioncalError, cv2.error):
        fit = estimate_intrinsics(corners, targets, resolution, model)
        if fit.sigma_px < CalibrationLimits().pixel_px[0]:
            return fit
    return None


def rms_px(
    corners: Mapping[int, Corners], targets: Sequence[Target], lens: Camera, factor: float = 1.0
) -> FloatArray:
    """(v,) rms residuals of a coordinate [px] of views whose corners are scaled."""
    stack = CornerStack.of(corners, numbered_positions(targets))
    stack = replace(stack, px=scaled_px(stack.px, factor))
    start = planar_poses(stack, lens)
    squares = mean_square_by_view(stack, fit_poses(stack, lens, start.first).residuals)
    return np.sqrt(np.where(start.solved, squares, np.inf))
