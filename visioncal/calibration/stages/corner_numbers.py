"""Whether corners that another detector has found lie as the drawing numbers them, in the image.

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
# Detectors place corners at the image's edge, or this far outside of it [px].
_BORDER_PX = 2.0
# Share of the views from which on targets are taken to be seen from behind.
_MOST_FROM_BEHIND = 0.5
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


def check_axes(views: Sequence[tuple[Corners, Target]], resolution: tuple[int, int]) -> None:
    """Refuses corners whose columns, or those of the image's size, are exchanged.

    Args:
        views: The corners of each view, with its target.
        resolution: Width and height of the image, as stated [px].

    Raises:
        DataError: Corners lie beyond the image, and none of all would with the other order.
    """
    size = np.array(resolution, dtype=float)
    outside = [corners for corners, _ in views if _is_beyond(corners.px, size)]
    if not outside or any(_is_beyond(corners.px, size[::-1]) for corners, _ in views):
        return
    width, height = resolution
    seen = (
        f"corners of {len(outside)} of {len(views)} views lie outside the image of {width} x "
        f"{height} px"
    )
    columns, sides = "the columns u_px and v_px", "width and height in resolution"
    # A rig's z may point either way.
    boards = [(corners, target) for corners, target in views if target.kind != "points"]
    if not boards:
        raise DataError(
            f"Either {columns} of corners.csv or {sides} of session.toml are exchanged: {seen}, "
            "with either exchanged none.",
            culprits=["corners.csv: u_px", "corners.csv: v_px", "session.toml: resolution"],
            next_step=f"If images are {width} x {height} px, exchange the headings u_px and v_px "
            f"in corners.csv; else write resolution = [{height}, {width}] in session.toml.",
        )
    if np.mean([_is_from_behind(*view) for view in boards]) > _MOST_FROM_BEHIND:
        raise DataError(
            f"corners.csv: {columns} are exchanged: {seen}, with the columns exchanged none, and "
            "as they are, the target would be seen from behind.",
            culprits=["corners.csv: u_px", "corners.csv: v_px"],
            next_step="Exchange the headings u_px and v_px in the first line of corners.csv.",
        )
    raise DataError(
        f"session.toml: {sides} are exchanged: {seen}, and none outside one of {height} x {width} "
        "px.",
        culprits=["session.toml: resolution", *(f"view {corners.view}" for corners in outside)],
        next_step=f"In [camera] of session.toml, write resolution = [{height}, {width}].",
    )


def _is_beyond(px: FloatArray, size: FloatArray) -> bool:
    return bool(((px < -_BORDER_PX) | (px > size - 1.0 + _BORDER_PX)).any())


def _is_from_behind(corners: Corners, target: Target) -> bool:
    """Whether the corners of a board turn the other way round than as seen from before it."""
    points = corner_positions(target)[corners.ids, :2]
    away = points - points.mean(axis=0)
    px_from_plane = np.linalg.lstsq(away, corners.px - corners.px.mean(axis=0))[0]
    return bool(np.linalg.det(px_from_plane) < 0.0)


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
