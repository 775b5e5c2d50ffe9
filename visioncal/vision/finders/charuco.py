"""Finding ChArUco boards, and recognising which layout was printed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import cv2
import numpy as np
from scipy.spatial import KDTree

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.finders.layout import LAYOUT_MISFIT, layout_misfit
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.targets import charuco_board

# A homography has eight unknowns and a marker gives eight equations: three markers check it.
_LAYOUT_MARKERS = 3

# Places on a marker's side to which distances are taken.
_ALONG = 7
# What a window keeps from a marker's side: its blur, and the pixel beyond that a gradient needs.
_CLEAR_PX = 2.0
# Half the side of the windows in which corners are refined: fewer pixels have too few gradients,
# and in more of them a lens bends the sides of the squares.
_WINDOWS_PX = (2, 10)
_ENDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
# The window in which a quick search compares with the mean: of those from 7 to 31, the one in which
# most markers were seen where squares have 20 to 70 px.
_QUICK_PX = 7

# (4, 2) corners [px] by a marker's id.
_Markers: TypeAlias = Mapping[int, FloatArray]


def find_charuco(
    image: Image, target: Target, *, quick: bool = False
) -> DetectedCorners | NotFound:
    """Finds the chessboard corners of a ChArUco board (Garrido-Jurado et al. 2014; OpenCV).

    OpenCV's check of interpolated corners against neighbouring markers is off, because it drops
    whole boards at steep tilts; the residual of the pose takes its place later.

    Args:
        image: (h, w) grey image.
        target: A ChArUco target.
        quick: Whether to compare with the grey about a pixel once, which shows most markers, where
            OpenCV does it in windows of three sizes.

    Returns:
        The corners, or why there are none.
    """
    board = charuco_board(target)
    parameters = cv2.aruco.CharucoParameters()
    parameters.checkMarkers = False
    by_markers = cv2.aruco.DetectorParameters()
    if quick:
        by_markers.adaptiveThreshWinSizeMin = by_markers.adaptiveThreshWinSizeMax = _QUICK_PX
    detector = cv2.aruco.CharucoDetector(board, parameters, by_markers)
    px, ids, marker_px, marker_ids = detector.detectBoard(image)
    if not marker_px:
        return NotFound(f"no board: no marker of {target.dictionary} is seen")
    if len(marker_px) - len(np.unique(marker_ids)) >= _LAYOUT_MARKERS:
        # Of two copies, the corners would be of either, or of both.
        return NotFound(
            "markers are seen twice: another board with the same markers is in the image"
        )
    if _misfit(_by_id(marker_px, marker_ids), target) > LAYOUT_MISFIT:
        return NotFound("the markers do not lie as the target describes them", misfit=True)
    if np.size(ids) == 0 or px is None:
        return NotFound(f"no board: {len(marker_px)} markers are seen, but no corner")
    order = np.argsort(ids.ravel())
    rough = px.reshape(-1, 2)[order].astype(np.float64)
    return DetectedCorners(ids.ravel()[order].astype(np.int64), _refined(image, rough, marker_px))


def _refined(image: Image, px: FloatArray, marker_px: Sequence[Any]) -> FloatArray:
    """Refines (n, 2) corners [px] in windows that no marker reaches into."""
    # OpenCV's windows go by the distance of a marker's corner alone: where squares are small,
    # slanted or bent by a lens, a marker's sides lie in them and draw the corner by up to half a
    # pixel.
    corners = np.reshape(np.array(marker_px, dtype=float), (-1, 4, 2))
    sides = np.roll(corners, -1, axis=1) - corners
    along = corners[:, :, None] + np.linspace(0.0, 1.0, _ALONG)[:, None] * sides[:, :, None]
    away, _ = KDTree(along.reshape(-1, 2)).query(px, p=np.inf)
    windows = np.clip(away - _CLEAR_PX, *_WINDOWS_PX).astype(int)
    refined = px.astype(np.float32)
    for window in np.unique(windows).tolist():
        these = windows == window
        start = refined[these].reshape(-1, 1, 2).copy()
        found = cv2.cornerSubPix(image, start, (window, window), (-1, -1), _ENDS)
        refined[these] = found.reshape(-1, 2)
    return refined.astype(np.float64)


def fitting_layouts(image: Image, target: Target) -> tuple[Target, ...]:
    """Finds which variants of a ChArUco description fit the markers in an image.

    Args:
        image: (h, w) grey image.
        target: A ChArUco target as declared.

    Returns:
        The variants that fit: other corner layout, columns and rows exchanged, or both.
    """
    turned = replace(target, columns=target.rows, rows=target.columns)
    variants = [
        replace(target, legacy=not target.legacy),
        turned,
        replace(turned, legacy=not target.legacy),
    ]
    dictionary = charuco_board(target).getDictionary()
    marker_px, marker_ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    if not marker_px:
        return ()
    markers = _by_id(marker_px, marker_ids)
    enough = [
        variant for variant in variants if len(_matches(markers, variant)[0]) >= 4 * _LAYOUT_MARKERS
    ]
    return tuple(item for item in enough if _misfit(markers, item) <= LAYOUT_MISFIT)


def _by_id(marker_px: Sequence[Any], marker_ids: Any) -> _Markers:  # noqa: ANN401 - OpenCV's
    return {
        int(marker): np.asarray(px, dtype=float).reshape(4, 2)
        for marker, px in zip(np.ravel(marker_ids), marker_px, strict=True)
    }


def _matches(markers: _Markers, target: Target) -> tuple[FloatArray, FloatArray]:
    """Pairs the corners of the seen markers on the board [m] with those in the image [px]."""
    board = charuco_board(target)
    ids = np.ravel(np.asarray(board.getIds()))
    places = dict(zip(ids.tolist(), board.getObjPoints(), strict=True))
    known = [marker for marker in markers if marker in places]
    if not known:
        return np.empty((0, 2)), np.empty((0, 2))
    on_board = np.concatenate([places[marker][:, :2] for marker in known])
    return on_board.astype(np.float64), np.concatenate([markers[marker] for marker in known])


def _misfit(markers: _Markers, target: Target) -> float:
    """How far the markers are from their places; see `layout_misfit`."""
    on_board, in_image = (match.reshape(-1, 4, 2) for match in _matches(markers, target))
    return layout_misfit(on_board, in_image) if len(on_board) >= _LAYOUT_MARKERS else 0.0
