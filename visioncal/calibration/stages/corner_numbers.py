"""Checks of corners from another detector against the target's numbering and the image size.

A view of a flat board is a homography, apart from noise, the lens and single outliers, which stay
under a tenth of the corners' spread. Numbers of another board leave nearly all of it.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import tomli_w

from visioncal.calibration.stages.other_board import MEND_IMAGES, OtherBoardError, board_correction
from visioncal.core.errors import DataError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.types import Corners, FloatArray, Mask, Rejection, Target
from visioncal.core.verdict import Finding, Remedy, calibrating
from visioncal.session import Session, View
from visioncal.vision.corners import far_outside
from visioncal.vision.detection import lack_of_corners
from visioncal.vision.poses import FEWEST_CORNERS
from visioncal.vision.targets import corner_positions, otherwise, point_numbers

EXCHANGE_COLUMNS = calibrating(
    "Write a copy of the session in which u_px is counted to the right and v_px down, and",
    "it.",
    MEND_IMAGES,
)
# Largest homography residual with the right counts, as a share of the corners' spread.
_LIKE = 0.05


def usable_corners(
    session: Session, views: Sequence[View], resolution: tuple[int, int]
) -> dict[int, Corners | Rejection]:
    """The corners of corners.csv by view, or why they are not usable.

    Args:
        session: The session.
        views: Views of one camera that have such corners.
        resolution: Stated (width, height) of its images [px].

    Raises:
        DataError: Most views have corners outside the image, or contradict the target's numbering.
    """
    corners = {view.number: session.corners[view.number] for view in views}
    outside = {view: far_outside(at.px, resolution) for view, at in corners.items()}
    pairs = [(corners[view.number], session.boards[session.board_of(view)]) for view in views]
    if are_exchanged(pairs, resolution):
        raise OtherBoardError.of(
            Finding(
                "corner_numbers",
                "In corners.csv, u_px and v_px are exchanged: as they are, the board is seen from "
                f"behind and beyond the image of {resolution[0]} x {resolution[1]} px, and "
                "exchanged it is not.",
                EXCHANGE_COLUMNS,
                (*corners,),
            )
        )
    lost = [f"view {view}" for view, mask in outside.items() if mask.any()]
    if 2 * len(lost) > len(views):
        px = np.concatenate([at.px for at in corners.values()])
        (left, top), (right, bottom) = px.min(axis=0).tolist(), px.max(axis=0).tolist()
        raise DataError(
            f"corners.csv: corners of {len(lost)} of {len(views)} views lie outside the image of "
            f"{resolution[0]} x {resolution[1]} px: u_px is {left:.1f} to {right:.1f}, and v_px "
            f"{top:.1f} to {bottom:.1f}.",
            culprits=["corners.csv: u_px, v_px", "session.toml: resolution", *lost],
            next_step="Correct resolution = [width, height] in [camera] of session.toml; or, in "
            "corners.csv, exchange u_px and v_px, or count both from the centre of the upper left "
            "pixel of the whole image, u_px to the right and v_px down.",
        )
    usable = dict[int, Corners | Rejection]()
    for name, target in session.boards.items():
        board_corners = [corners[view.number] for view in views if session.board_of(view) == name]
        usable |= {
            at.view: _usable(at, target, outside[at.view], resolution) for at in board_corners
        }
        numbered = [at for at in board_corners if isinstance(usable[at.view], Corners)]
        for view in _misnumbered(session, name, numbered):
            usable[view] = Rejection(
                view, "its corners in corners.csv do not lie as the target's drawing numbers them"
            )
    return usable


def are_exchanged(
    views: Sequence[tuple[Corners, Target]],
    resolution: tuple[int, int],
    centre_px: FloatArray | None = None,
) -> bool:
    """Whether u and v of corners are exchanged.

    Boards are seen from behind, and in most views well beyond the (width, height) of the picture
    unless exchanged; or the (2,) centre of the lens is in the picture's middle when exchanged.
    """
    size = np.array(resolution, dtype=float)
    px = np.concatenate([np.zeros((0, 2)), *(at.px for at, _ in views)])
    if (px[:, ::-1] > size).any() or not are_from_behind(views):
        return False
    # Distance outside the image that neither noise nor the half pixel of another origin explains
    # [px], and the least share of a view's corners so far out.
    outside = [(at.px > size + 5.0).any(axis=1).mean() for at, _ in views]
    if np.median(outside) > 0.05:
        # Width and height that are exchanged themselves are an upright picture's, and look alike.
        return bool(size[0] > size[1])
    if centre_px is None:
        return False
    given_px, exchanged_px = (np.linalg.norm(at - size / 2) for at in (centre_px, centre_px[::-1]))
    return bool(CLEAR_RATIO * exchanged_px < given_px)


def _usable(
    corners: Corners, target: Target, outside: Mask, resolution: tuple[int, int]
) -> Corners | Rejection:
    reason = lack_of_corners(corners, target, FEWEST_CORNERS)
    if outside.any():
        at = int(np.argmax(outside))
        u_px, v_px = corners.px[at].tolist()
        reason = (
            f"corners.csv: point {point_numbers(target)[corners.ids[at]]} at ({u_px:g}, "
            f"{v_px:g}) px lies far outside the image of {resolution[0]} x {resolution[1]} px"
        )
    return Rejection(corners.view, reason) if reason else corners


def _misnumbered(session: Session, name: str, views: Sequence[Corners]) -> list[int]:
    """Views whose corners contradict the numbering of the target's drawing."""
    target = session.boards[name]
    points = corner_positions(target)
    if np.ptp(points[:, 2]) > 0.0 or not views:
        return []
    # Largest homography residual as a share of the corners' spread.
    wrong = [at.view for at in views if _residual(points[at.ids, :2], at.px) > 0.3]
    is_other = 2 * len(wrong) > len(views)
    if figures := _counts(target, views) if is_other else otherwise(target, views):
        named = " and ".join(tomli_w.dumps(figures).splitlines())
        words, command = board_correction(session, name, named)
        step = Remedy(f"{words[0].upper()}{words[1:]}, or name another target.", command)
        of_inner = target.kind == "checkerboard" and "columns" in figures
        stated = " and ".join(f"{key} = {getattr(target, key):g}" for key in figures)
        raise OtherBoardError.of(
            Finding(
                "other_board",
                f"The corners of corners.csv lie as on a board with {named}, and {target.name} has "
                f"{stated}{', which count inner corners, not squares' * of_inner}.",
                step,
                tuple(at.view for at in views),
            )
        )
    if is_other:
        by_columns = points[np.lexsort((points[:, 1], points[:, 0])), :2]
        likely = "the drawing is of another board, or the numbers are of another order"
        next_step = "Compare columns, rows and the order of the points with the detector's."
        if all(_residual(by_columns[at.ids], at.px) < _LIKE for at in views):
            likely = "they are numbered column by column"
            next_step = "Number them row by row, from corner 0 at the upper left."
        raise DataError(
            f"target {target.name!r}: in {len(wrong)} of {len(views)} views the corners of "
            f"corners.csv do not lie as its drawing numbers them: {likely}.",
            culprits=[f"view {view}" for view in wrong],
            next_step=next_step,
        )
    return wrong


def _counts(target: Target, views: Sequence[Corners]) -> dict[str, object]:
    """Columns and rows by which corners lie as they are numbered row by row; empty without any."""
    if target.is_rig or not target.columns:
        return {}
    largest, some = max(int(at.ids.max()) for at in views), views[:: len(views) // 3 + 1]
    # Columns and rows that are tried.
    for columns, rows in product(range(2, 41), repeat=2):
        other = replace(target, columns=columns, rows=rows)
        points = corner_positions(other)[:, :2]
        enough = largest < len(points) <= largest + len(points) // rows
        if not enough or any(_residual(points[at.ids], at.px) >= _LIKE for at in some):
            continue
        is_transposed = (columns, rows) == (target.rows, target.columns)
        # Numbers that run column by column are those of no board that is seen from the front.
        if not is_transposed or not are_from_behind([(at, other) for at in some]):
            return {"columns": columns, "rows": rows}
    return {}


def _residual(points: FloatArray, px: FloatArray) -> float:
    """Rms residual of a homography of (n, 2) points, as a share of the corners' spread."""
    # Without any homography OpenCV returns None, whatever its types say.
    homography = np.asarray(cv2.findHomography(points, px)[0], dtype=float)
    if homography.shape != (3, 3):
        return 1.0
    away = cv2.perspectiveTransform(points[None], homography)[0] - px
    return float(np.linalg.norm(away) / np.linalg.norm(px - px.mean(axis=0)))


def are_from_behind(views: Sequence[tuple[Corners, Target]]) -> bool:
    """Whether most corners have the orientation of printed boards that are seen from behind."""

    def turn(corners: Corners, target: Target) -> float:
        points = corner_positions(target)[corners.ids, :2]
        from_plane = np.linalg.lstsq(points - points.mean(axis=0), corners.px)[0]
        return float(np.linalg.det(from_plane))

    # The z axis of a rig may point either way.
    if not views or any(target.is_rig for _, target in views):
        return False
    return bool(np.median([turn(*view) for view in views]) < 0.0)
