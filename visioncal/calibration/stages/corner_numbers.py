"""Checks of corners from another detector against the target's numbering and the image size.

A view of a flat board is a homography, apart from noise, the lens and single outliers, which stay
under a tenth of the corners' spread. Numbers of another board leave nearly all of it.
"""

import math
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.vision.targets import corner_positions

# Largest homography residual as a share of the corners' spread. Wrong numbers leave 0.7 to 1.1;
# fisheyes and views with single outliers 0.1 at most.
_MOST_LEFT = 0.3
# Fewest corners to be checked: a homography takes four.
_FEWEST = 6
# Largest distance outside the image at which detectors place corners of its edge [px].
_BORDER_PX = 2.0
# Share of the views from which on targets count as seen from behind.
MOST_FROM_BEHIND = 0.5
# Share from which on their corners are numbered so in all views: single ones may be wrong.
_ALL_FROM_BEHIND = 0.9
# Largest number of corners in a row that is tried; a sheet of paper holds fewer.
_MOST_A_ROW = 100
# Columns of a drawing minus corners in a row, by the kinds whose numbers go row by row.
_EXTRA_COLUMNS = {"charuco": 1, "checkerboard": 0}
# Why a single misnumbered view is left out.
OTHER_NUMBERS = "its corners in corners.csv do not lie as the target's drawing numbers them"


def _is_misnumbered(corners: Corners, target: Target) -> bool:
    points = corner_positions(target)[corners.ids]
    if np.ptp(points[:, 2]) > 0.0 or len(points) < _FEWEST:
        return False
    return _homography_residual(points[:, :2], corners.px) > _MOST_LEFT


def check_numbers(views: Sequence[Corners], target: Target, name: str = "") -> list[int]:
    """Finds views whose corners contradict the numbering of the target's drawing.

    Args:
        views: The corners of each view of the target.
        target: The target.
        name: Name of the target in the session, where it has several.

    Returns:
        The numbers of these views.

    Raises:
        DataError: Most views do; another number of columns is named where it fits.
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
    width = _fitting_width(wrong) if target.kind in _EXTRA_COLUMNS else None
    if width is None:
        raise DataError(
            f"{seen}: the drawing is of another board, or the numbers are of another order.",
            culprits=culprits,
            next_step="Compare columns, rows and the order of the points with the detector's.",
        )
    most = max(int(corners.ids.max()) for corners in wrong)
    columns, rows = (count + _EXTRA_COLUMNS[target.kind] for count in (width, most // width + 1))
    raise DataError(
        f"{seen}; they do with columns = {columns}.",
        culprits=culprits,
        next_step=f"Set columns = {columns} and rows = {rows} in the target's .toml.",
    )


def check_axes(views: Sequence[tuple[Corners, Target]], resolution: tuple[int, int]) -> None:
    """Refuses corners whose columns u and v, or the image's width and height, are exchanged.

    Args:
        views: The corners of each view, with its target.
        resolution: Stated width and height of the image [px].

    Raises:
        DataError: Corners lie outside the image, and none would with the other order.
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
    # The z axis of a rig may point either way.
    boards = [(corners, target) for corners, target in views if not target.is_rig]
    if not boards:
        raise DataError(
            f"Either {columns} of corners.csv or {sides} of session.toml are exchanged: {seen}, "
            "with either exchanged none.",
            culprits=["corners.csv: u_px", "corners.csv: v_px", "session.toml: resolution"],
            next_step=f"If images are {width} x {height} px, exchange the headings u_px and v_px "
            f"in corners.csv; else write resolution = [{height}, {width}] in session.toml.",
        )
    if share_from_behind(boards) > MOST_FROM_BEHIND:
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


def check_extent(
    views: Sequence[Corners],
    resolution: tuple[int, int],
    image: tuple[int, int] | None,
    cameras: Iterable[tuple[int, int]] = (),
) -> None:
    """Refuses a stated resolution that is smaller than the images in which corners were found.

    Args:
        views: The corners of each view.
        resolution: Stated width and height of the image [px].
        image: Width and height of one of these images [px]; None without.
        cameras: Stated width and height of the images of all cameras [px].

    Raises:
        DataError: In most views, corners lie to the right of the image or below it, and they do not
            fit another camera's images, with which this one's may be exchanged.
    """
    last = np.array(resolution) - 1.0 + _BORDER_PX
    outside = [corners for corners in views if (corners.px > last).any()]
    if 2 * len(outside) <= len(views):
        return
    extent = np.max([corners.px.max(axis=0) for corners in views], axis=0)
    if any((extent <= np.array(size) - 1.0 + _BORDER_PX).all() for size in cameras):
        return
    (width, height), (u_px, v_px) = resolution, extent.tolist()
    least = [math.ceil(u_px + 0.5), math.ceil(v_px + 0.5)]
    size = f"{least} or more, the size of the images in which the corners were found"
    if image is not None:
        size = str(list(image))
    step = (
        f"In [camera] of session.toml, write resolution = {size}; matrix and distortion, where "
        "stated, must be of that size."
    )
    if image == resolution:
        step = "The images have the stated size: find the corners anew, in these images."
    raise DataError(
        f"session.toml: resolution = [{width}, {height}] is smaller than the images in which the "
        f"corners of corners.csv were found: they reach u = {u_px:.1f} and v = {v_px:.1f} px, and "
        f"those of {len(outside)} of {len(views)} views lie outside the stated image.",
        culprits=["session.toml: resolution", *(f"view {corners.view}" for corners in outside)],
        next_step=step,
    )


def numbering_finding(views: Sequence[Corners], target: Target, name: str = "") -> Finding | None:
    """Finding that a board's corners are numbered as if it was seen from behind.

    Corners of mirrored images look the same; only the robot's motion tells them apart.

    Args:
        views: The corners of each view of the target.
        target: The target.
        name: Name of the target in the session, where it has several.
    """
    # The z axis of a rig may point either way.
    if target.is_rig or not views:
        return None
    if share_from_behind([(corners, target) for corners in views]) < _ALL_FROM_BEHIND:
        return None
    order, step = ": counterclockwise", "Number them clockwise from the marker's upper left"
    if target.kind in _EXTRA_COLUMNS:
        extra = _EXTRA_COLUMNS[target.kind]
        columns, rows = target.columns - extra, target.rows - extra
        order = ": rows from the bottom up, or column by column"
        step = (
            "Number them row by row from corner 0, which is at the upper left of the print (where "
            f"rows were counted from the bottom, point p becomes {columns} * ({rows - 1} - p // "
            f"{columns}) + p % {columns}"
        )
        # Column by column, the corners of other boards do not lie as drawn.
        by_column = f"; where column by column, {columns} * (p % {rows}) + p // {rows}"
        step = f"{step}{by_column if columns == rows else ''})"
    elif target.columns * target.rows > 1:
        order, step = "", "Number them as they are printed"
    whose = f"target {name}" if name else "the board"
    return Finding(
        "corner_numbers",
        f"corners.csv numbers the corners of {whose} as if it was seen from behind{order}. The "
        "camera's pose holds, but the board's frame is turned over: its z axis points at the "
        "camera.",
        Remedy(f"{step}, and calibrate again.", CALIBRATE),
        tuple(corners.view for corners in views),
    )


def _is_beyond(px: FloatArray, size: FloatArray) -> bool:
    return bool(((px < -_BORDER_PX) | (px > size - 1.0 + _BORDER_PX)).any())


def share_from_behind(views: Sequence[tuple[Corners, Target]]) -> float:
    """Share of the views whose corners have the orientation of a board seen from behind."""
    return float(np.mean([_is_from_behind(*view) for view in views]))


def _is_from_behind(corners: Corners, target: Target) -> bool:
    """Whether the corners of a board have the orientation of a view from behind."""
    points = corner_positions(target)[corners.ids, :2]
    centred = points - points.mean(axis=0)
    px_from_plane = np.linalg.lstsq(centred, corners.px - corners.px.mean(axis=0))[0]
    return bool(np.linalg.det(px_from_plane) < 0.0)


def _fitting_width(views: Iterable[Corners]) -> int | None:
    """Number of corners in a row by which all views fit a grid; None without one."""
    views = list(views)
    for width in range(2, min(max(int(view.ids.max()) for view in views), _MOST_A_ROW) + 1):
        grids = [np.stack([view.ids % width, view.ids // width], axis=1) for view in views]
        if all(
            _homography_residual(grid.astype(float), view.px) < _MOST_LEFT
            for grid, view in zip(grids, views, strict=True)
        ):
            return width
    return None


def _homography_residual(points: FloatArray, px: FloatArray) -> float:
    """Rms residual of a homography of (n, 2) points, as a share of their spread."""
    plane, image = _normalised(points), _normalised(px)
    if not (np.isfinite(plane).all() and np.isfinite(image).all()):
        return 0.0
    # Without any homography OpenCV returns None, whatever its types say.
    homography = np.asarray(cv2.findHomography(plane, image)[0], dtype=float)
    if homography.shape != (3, 3):
        return 1.0
    mapped = cv2.perspectiveTransform(plane[None], homography)[0]
    return float(np.sqrt(np.mean(np.sum((mapped - image) ** 2, axis=1))))


def _normalised(points: FloatArray) -> FloatArray:
    centred = points - points.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(centred**2, axis=1)))
    return np.asarray(centred / spread if spread > 0.0 else centred * np.nan)
