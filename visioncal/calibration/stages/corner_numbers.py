"""Checks of corners from another detector against the target's numbering and the image size.

A view of a flat board is a homography, apart from noise, the lens and single outliers, which stay
under a tenth of the corners' spread. Numbers of another board leave nearly all of it.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from visioncal.calibration.stages.image_size import Size
from visioncal.core.errors import DataError
from visioncal.core.types import Corners, FloatArray, Rejection, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.poses import determines_pose
from visioncal.session import Session, View
from visioncal.vision.targets import corner_positions, point_numbers

# Largest homography residual as a share of the corners' spread. Wrong numbers leave 0.7 to 1.1;
# fisheyes and views with single outliers 0.1 at most.
_MOST_LEFT = 0.3
# Fewest corners of a view, and of one whose numbers are checked: a homography takes four.
_FEWEST, _FEWEST_CHECKED = 4, 6
# Distance outside the image at which detectors place corners of its edge [px], and share of its
# size from which on single corners are no corners.
_BORDER_PX, _OUTSIDE = 2.0, 0.1
# Share of the views from which on targets count as seen from behind, and from which on their
# corners are numbered so in all views: single ones may be wrong.
MOST_FROM_BEHIND, _ALL_FROM_BEHIND = 0.5, 0.9
# Largest number of corners in a row that is tried; a sheet of paper holds fewer.
_MOST_A_ROW = 100
# Columns of a drawing minus corners in a row, by the kinds whose numbers go row by row.
_EXTRA_COLUMNS = {"charuco": 1, "checkerboard": 0}
# Why a single misnumbered view is left out.
OTHER_NUMBERS = "its corners in corners.csv do not lie as the target's drawing numbers them"


def usable_corners(
    session: Session, views: Sequence[View], resolution: Size
) -> dict[int, Corners | Rejection]:
    """The corners of corners.csv by view, or why they are not usable.

    Args:
        session: The session.
        views: Views of one camera that have such corners.
        resolution: Stated (width, height) of its images [px].

    Raises:
        DataError: Columns u and v, or the image's width and height, are exchanged; the stated image
            is smaller than that of the corners; or most views of a target contradict its numbering.
    """
    seen = {view.number: (session.corners[view.number], session.board_of(view)) for view in views}
    sizes = [camera.size for camera in session.cameras.values() if camera.size is not None]
    _check_image([(px, session.boards[name]) for px, name in seen.values()], resolution, sizes)
    usable = {
        view: _usable(corners, session.boards[name], np.array(resolution))
        for view, (corners, name) in seen.items()
    }
    for name, target in session.boards.items():
        mine = [px for view, px in usable.items() if seen[view][1] == name]
        numbered = [corners for corners in mine if isinstance(corners, Corners)]
        several = name if len(session.boards) > 1 else ""
        for view in _misnumbered(numbered, target, several):
            usable[view] = Rejection(view, OTHER_NUMBERS)
    return usable


def _usable(corners: Corners, target: Target, size: FloatArray) -> Corners | Rejection:
    positions = corner_positions(target)
    outside = np.any((corners.px < -_OUTSIDE * size) | (corners.px > (1 + _OUTSIDE) * size), axis=1)
    if outside.any():
        at = int(np.argmax(outside))
        u_px, v_px = corners.px[at].tolist()
        reason = (
            f"corners.csv: point {point_numbers(target)[corners.ids[at]]} at ({u_px:g}, "
            f"{v_px:g}) px lies far outside the image of {size[0]} x {size[1]} px"
        )
    elif len(corners.ids) < _FEWEST:
        reason = (
            f"too few corners: corners.csv has {len(corners.ids)} of {len(positions)}, needs "
            f"{_FEWEST}"
        )
    elif not determines_pose(positions[corners.ids]):
        reason = f"corners on one line: all {len(corners.ids)} of corners.csv, or all but one"
    else:
        return corners
    return Rejection(corners.view, reason)


def _check_image(
    views: Sequence[tuple[Corners, Target]], resolution: Size, cameras: Sequence[Size]
) -> None:
    """Refuses axes of corners or sides of images that are exchanged, and smaller images."""
    (width, height), size = resolution, np.array(resolution, dtype=float)
    all_px = [corners.px for corners, _ in views]
    outside = [corners.view for corners, _ in views if _is_beyond(corners.px, size)]
    if not outside:
        return
    culprits = [f"view {view}" for view in outside]
    if not any(_is_beyond(px, size[::-1]) for px in all_px):
        # Exchanged columns turn a board over; the z axis of a rig may point either way.
        boards = [pair for pair in views if not pair[1].is_rig]
        is_behind = bool(boards) and share_from_behind(boards) > MOST_FROM_BEHIND
        ways = {
            "columns u_px and v_px of corners.csv": "exchange the headings u_px and v_px in the "
            "first line of corners.csv",
            "width and height in resolution of session.toml": "write resolution = "
            f"[{height}, {width}] in [camera] of session.toml",
        }
        if boards:
            ways.pop([*ways][1 if is_behind else 0])
        step = ", or ".join(ways.values())
        raise DataError(
            f"{' or '.join(ways)} are exchanged: corners of {len(outside)} of {len(views)} views "
            f"lie outside the image of {width} x {height} px, and none outside one of {height} x "
            f"{width} px.",
            culprits=["corners.csv: u_px, v_px", "session.toml: resolution", *culprits],
            next_step=f"{step[0].upper()}{step[1:]}.",
        )
    extent = np.max([px.max(axis=0) for px in all_px], axis=0)
    # Another camera's images, with which this one's may be exchanged.
    fits_other = any((extent <= np.array(other) - 1.0 + _BORDER_PX).all() for other in cameras)
    larger = [px for px in all_px if (px > size - 1.0 + _BORDER_PX).any()]
    if 2 * len(larger) > len(views) and not fits_other:
        u_px, v_px = extent.tolist()
        raise DataError(
            f"session.toml: resolution = [{width}, {height}] is smaller than the images in which "
            f"the corners of corners.csv were found: they reach u = {u_px:.1f} and v = {v_px:.1f} "
            f"px, and those of {len(larger)} of {len(views)} views lie outside the stated image.",
            culprits=["session.toml: resolution", *culprits],
            next_step="In [camera] of session.toml, write resolution = "
            f"[{math.ceil(u_px + 0.5)}, {math.ceil(v_px + 0.5)}] or more, the size of the images "
            "in which the corners were found; matrix and distortion, where stated, must be of "
            "that size.",
        )


def _is_beyond(px: FloatArray, size: FloatArray) -> bool:
    return bool(((px < -_BORDER_PX) | (px > size - 1.0 + _BORDER_PX)).any())


def _misnumbered(views: Sequence[Corners], target: Target, name: str) -> list[int]:
    """Views whose corners contradict the numbering of the target's drawing."""
    points = corner_positions(target)
    if np.ptp(points[:, 2]) > 0.0:
        return []
    many = [corners for corners in views if len(corners.ids) >= _FEWEST_CHECKED]
    wrong = [view for view in many if _residual(points[view.ids, :2], view.px) > _MOST_LEFT]
    if 2 * len(wrong) <= len(views):
        return [corners.view for corners in wrong]
    most = max(int(corners.ids.max()) for corners in wrong)
    widths = range(2, min(most, _MOST_A_ROW) + 1) if target.kind in _EXTRA_COLUMNS else ()
    fitting = (
        width
        for width in widths
        if all(
            _residual(np.stack([view.ids % width, view.ids // width], axis=1), view.px) < _MOST_LEFT
            for view in wrong
        )
    )
    why = ": the drawing is of another board, or the numbers are of another order"
    step = "Compare columns, rows and the order of the points with the detector's."
    if width := next(fitting, 0):
        columns, rows = (at + _EXTRA_COLUMNS[target.kind] for at in (width, most // width + 1))
        why = f"; they do with columns = {columns}"
        step = f"Set columns = {columns} and rows = {rows} in the target's .toml."
    size = "" if not target.columns else f", {target.columns} columns and {target.rows} rows,"
    raise DataError(
        f"target {name or target.name!r}: in {len(wrong)} of {len(views)} views the corners of "
        f"corners.csv do not lie as its drawing{size} numbers them{why}.",
        culprits=[f"view {corners.view}" for corners in wrong],
        next_step=step,
    )


def _residual(points: FloatArray, px: FloatArray) -> float:
    """Rms residual of a homography of (n, 2) points, as a share of their spread."""
    centred = [item - item.mean(axis=0) for item in (points, px)]
    spreads = [np.sqrt(np.mean(np.sum(item**2, axis=1))) for item in centred]
    if not (np.isfinite(spreads).all() and min(spreads) > 0.0):
        return 0.0
    plane, image = (item / spread for item, spread in zip(centred, spreads, strict=True))
    # Without any homography OpenCV returns None, whatever its types say.
    homography = np.asarray(cv2.findHomography(plane, image)[0], dtype=float)
    if homography.shape != (3, 3):
        return 1.0
    mapped = cv2.perspectiveTransform(plane[None], homography)[0]
    return float(np.sqrt(np.mean(np.sum((mapped - image) ** 2, axis=1))))


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
    whose = f"target {name}" if name else "the board"
    return Finding(
        "corner_numbers",
        f"corners.csv numbers the corners of {whose} as if it was seen from behind: rows from "
        "the bottom up, column by column, or counterclockwise. The camera's pose holds, but the "
        "board's frame is turned over: its z axis points at the camera.",
        Remedy(
            "Number them as they are printed, row by row from corner 0, at the upper left; those "
            "of a marker clockwise from there. Calibrate again.",
            CALIBRATE,
        ),
        tuple(corners.view for corners in views),
    )


def share_from_behind(views: Sequence[tuple[Corners, Target]]) -> float:
    """Share of the views whose corners have the orientation of a board seen from behind."""

    def turn(corners: Corners, target: Target) -> float:
        points = corner_positions(target)[corners.ids, :2]
        from_plane = np.linalg.lstsq(points - points.mean(axis=0), corners.px)[0]
        return float(np.linalg.det(from_plane))

    return float(np.mean([turn(*view) < 0.0 for view in views]))
