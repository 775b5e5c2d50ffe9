"""Whether corners that another detector has found lie as the drawing numbers them.

A view of a flat board is a homography, but for noise, the lens and single wild corners: these stay
under a tenth of the corners' spread. Numbers of another board leave nearly all of it.
"""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.vision.targets import corner_positions

# Share of the corners' spread that is left of a view whose numbers are another board's: 0.7 to 1.1
# were seen, and 0.1 at most of fisheyes and of views with wild corners.
_MOST_LEFT = 0.3
# A homography takes four points; with two more there is something left.
_FEWEST = 6
# Corners of one row of a grid that are tried; a sheet of paper holds fewer.
_MOST_A_ROW = 100
# What a drawing's columns have beyond the corners of a row, by its kind: those whose numbers go row
# by row.
_BEYOND = {"charuco": 1, "checkerboard": 0}


# Why a single view of that kind is left out.
OTHER_NUMBERS = "its corners in corners.csv do not lie as the target's drawing numbers them"


def _is_misnumbered(corners: Corners, target: Target) -> bool:
    points = corner_positions(target)[corners.ids]
    if np.ptp(points[:, 2]) > 0.0 or len(points) < _FEWEST:
        return False
    return _left(points[:, :2], corners.px) > _MOST_LEFT


def check_numbers(views: Sequence[Corners], target: Target, name: str = "") -> list[int]:
    """Finds corners that lie otherwise than the target's drawing numbers them; refuses most.

    Args:
        views: The corners of each view of the target.
        target: The target.
        name: What the session calls it, where it has several.

    Returns:
        The views whose corners do.

    Raises:
        DataError: So do those of most views; another number of columns is named where it fits.
    """
    wrong = [view for view in views if _is_misnumbered(view, target)]
    if 2 * len(wrong) <= len(views):
        return [corners.view for corners in wrong]
    size = "" if not target.columns else f", {target.columns} columns and {target.rows} rows,"
    seen = (
        f"target {name or target.name!r}: in {len(wrong)} of {len(views)} views the corners of "
        f"corners.csv do not lie as its drawing{size} numbers them"
    )
    culprits = [f"view {corners.view}" for corners in wrong]
    width = _fitting_width(wrong) if target.kind in _BEYOND else None
    if width is None:
        raise DataError(
            f"{seen}: the drawing is of another board, or the numbers are of another order.",
            culprits=culprits,
            next_step="Compare columns, rows and the order of the points with the detector's.",
        )
    most = max(int(corners.ids.max()) for corners in wrong)
    columns, rows = (index + _BEYOND[target.kind] for index in (width, most // width + 1))
    raise DataError(
        f"{seen}; they do with columns = {columns}.",
        culprits=culprits,
        next_step=f"Set columns = {columns} and rows = {rows} in the target's .toml.",
    )


def _fitting_width(views: Iterable[Corners]) -> int | None:
    """The number of corners a row with which all views are of a grid; None where there is none."""
    views = list(views)
    for width in range(2, min(max(int(view.ids.max()) for view in views), _MOST_A_ROW) + 1):
        grids = [np.stack([view.ids % width, view.ids // width], axis=1) for view in views]
        if all(
            _left(grid.astype(float), view.px) < _MOST_LEFT
            for grid, view in zip(grids, views, strict=True)
        ):
            return width
    return None


def _left(points: FloatArray, px: FloatArray) -> float:
    """What a homography leaves of (n, 2) places, as a share of their spread."""
    plane, image = _normalised(points), _normalised(px)
    if not (np.isfinite(plane).all() and np.isfinite(image).all()):
        return 0.0
    # Of corners that no homography maps there is none, whatever OpenCV's types say.
    homography = np.asarray(cv2.findHomography(plane, image)[0], dtype=float)
    if homography.shape != (3, 3):
        return 1.0
    there = cv2.perspectiveTransform(plane[None], homography)[0]
    return float(np.sqrt(np.mean(np.sum((there - image) ** 2, axis=1))))


def _normalised(places: FloatArray) -> FloatArray:
    away = places - places.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    return np.asarray(away / spread if spread > 0.0 else away * np.nan)
