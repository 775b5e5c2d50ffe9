"""Corners of some views that another program found in pictures of another size."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from visioncal.calibration.stages.other_board import MADE_ALIKE
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CLEAR_RATIO, FEWEST_COMPARED, CalibrationLimits
from visioncal.core.number_format import figure, ranges
from visioncal.core.types import Camera, CameraKind, Corners, FloatArray, Target
from visioncal.core.verdict import Finding
from visioncal.vision.corners import CornerStack, floored_sigma_px, mean_square_by_view
from visioncal.vision.intrinsics import estimate_intrinsics
from visioncal.vision.poses import fit_poses, planar_poses
from visioncal.vision.targets import numbered_positions

# Sizes of pictures, previews and scaled copies, as shares of the camera's.
_SHARES = (1 / 5, 1 / 4, 1 / 3, 2 / 5, 1 / 2, 3 / 5, 2 / 3, 3 / 4, 4 / 5)
# Difference of squared errors over the noise from which on a size is clearly another one: 6 sigma.
_CLEAR_CHI2 = 36.0
# Views of one lens and one board scatter by less than so many times those that fit best.
_UNEVEN = 2.0


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
    lens: Camera | CameraKind,
    fitted: Camera | None = None,
) -> ScaledViews | None:
    """Finds views whose corners are those of smaller pictures than the others'.

    Such corners all lie in the upper left part of the picture. By the lens of the other views they
    fit a pose of the board only once they are scaled, about the outer corner of the first pixel.

    Args:
        corners: The corners by view.
        targets: The targets; the corners of several are numbered through.
        resolution: (width, height) of the camera's pictures [px].
        lens: The stated intrinsics, or the model by which they are estimated.
        fitted: Intrinsics by all views, under which unequal noise of views makes the search due;
            None to search anyway.

    Returns:
        The views that the likeliest share explains; None where no share explains any.
    """
    by_all = lens if isinstance(lens, Camera) else fitted
    if by_all is not None:
        levels_px = _rms_px(corners, targets, by_all)
        least_px = float(np.quantile(levels_px, 0.25))
        if fitted is not None and levels_px.max() < _UNEVEN * least_px:
            return None

    @cache
    def lens_of(views: frozenset[int]) -> tuple[Camera, float] | None:
        if isinstance(lens, Camera):
            return lens, floored_sigma_px(least_px)
        some = {view: at for view, at in corners.items() if view in views}
        return _lens_of(some, targets, resolution, lens)

    every, found = [*corners], list[ScaledViews]()
    ends = {frozenset(every[: len(every) // 2]), frozenset(every[len(every) // 2 :])}
    for share in _SHARES:
        box = share * np.array(resolution)
        small = {view: at for view, at in corners.items() if (at.px < box).all()}
        # Where all are small, the views of one end may be of one size.
        beyond = frozenset(every).difference(small)
        for views in {beyond} if len(beyond) >= FEWEST_COMPARED else ends:
            if small and (known := lens_of(views)) is not None:
                found += _scaled_by(*known, small, targets, share)
    return max(found, key=lambda each: len(each.views), default=None)


def _scaled_by(
    lens: Camera,
    sigma_px: float,
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    share: float,
) -> Iterator[ScaledViews]:
    """The views whose corners fit a lens of some noise once their pictures are the camera's."""
    given, scaled = (_rms_px(corners, targets, lens, by) for by in (1.0, 1.0 / share))
    # By the noise of a corner in its own picture.
    own, counts = share * scaled, np.array([len(at.ids) for at in corners.values()])
    fits = (own < CLEAR_RATIO * sigma_px) & (
        2.0 * counts * (given**2 - own**2) > _CLEAR_CHI2 * sigma_px**2
    )
    if fits.any():
        views, size = tuple(np.array([*corners])[fits].tolist()), lens.resolution
        width, height = (round(share * side) for side in size)
        words = (
            f"In view {ranges(views)} the corners of corners.csv are those of pictures of {width} "
            f"x {height} px, where the camera's are {size[0]} x {size[1]}: scaled to these, they "
            f"fit a pose of the board to {figure(float(np.median(scaled[fits])))} px, and to "
            f"{figure(float(np.median(given[fits])))} px as they are. They were left out."
        )
        yield ScaledViews(views, share, Finding("image_sizes", words, MADE_ALIKE, views))


def scaled_px(px: FloatArray, factor: float) -> FloatArray:
    """(n, 2) pixels of a picture that is so many times as large, counted from centres of pixels."""
    return factor * (px + 0.5) - 0.5


def _lens_of(
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    resolution: tuple[int, int],
    model: CameraKind,
) -> tuple[Camera, float] | None:
    """The lens of some views, and their noise [px]; None where they determine none."""
    with suppress(VisioncalError):
        fit = estimate_intrinsics(corners, targets, resolution, model)
        if fit.sigma_px < CalibrationLimits().pixel_px[0]:
            return fit.camera, floored_sigma_px(fit.sigma_px)
    return None


def _rms_px(
    corners: Mapping[int, Corners], targets: Sequence[Target], lens: Camera, factor: float = 1.0
) -> FloatArray:
    """(v,) rms residuals of a coordinate [px] of views whose corners are scaled."""
    stack = CornerStack.of(corners, numbered_positions(targets))
    stack = replace(stack, px=scaled_px(stack.px, factor))
    start = planar_poses(stack, lens)
    squares = mean_square_by_view(stack, fit_poses(stack, lens, start.first).residuals)
    return np.sqrt(np.where(start.solved, squares, np.inf))
