"""Detection of ChArUco boards, and of which layout was printed."""

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

# A homography has eight unknowns and a marker gives eight equations: three are a check.
_LAYOUT_MARKERS = 3

# Points on a marker's side to which distances are measured.
_ALONG = 7
# Distance of a window from a marker's side: its blur, and a pixel for gradients.
_CLEAR_PX = 2.0
# Half-widths of the windows of corner refinement: smaller ones have too few gradients, and in
# larger ones lens distortion bends the squares' sides.
_WINDOWS_PX = (2, 10)
_ENDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
# Thresholding window of a quick search: of 7 to 31, it detected most markers at squares of 20 to 70
# px.
_QUICK_PX = 7

# (4, 2) corners [px] by marker id.
_Markers: TypeAlias = Mapping[int, FloatArray]


def find_charuco(
    image: Image, target: Target, *, quick: bool = False
) -> DetectedCorners | NotFound:
    """Detects the chessboard corners of a ChArUco board (Garrido-Jurado et al. 2014; OpenCV).

    OpenCV's check of interpolated corners against neighbouring markers is off, as it drops whole
    boards at steep tilts; the residual of the pose replaces it later.

    Args:
        image: (h, w) grey image.
        target: A ChArUco target.
        quick: Whether to threshold with one window size, which finds most markers, instead of
            OpenCV's three.

    Returns:
        The corners, or why there are none.
    """
    board = charuco_board(target)
    parameters = cv2.aruco.CharucoParameters()
    parameters.checkMarkers = False
    marker_parameters = cv2.aruco.DetectorParameters()
    if quick:
        marker_parameters.adaptiveThreshWinSizeMin = marker_parameters.adaptiveThreshWinSizeMax = (
            _QUICK_PX
        )
    detector = cv2.aruco.CharucoDetector(board, parameters, marker_parameters)
    px, ids, marker_px, marker_ids = detector.detectBoard(image)
    if not marker_px:
        return NotFound(f"no board: no marker of {target.dictionary} is seen")
    if len(marker_px) - len(np.unique(marker_ids)) >= _LAYOUT_MARKERS:
        # The corners could be of either board, or of both.
        return NotFound(
            "markers are seen twice: another board with the same markers is in the image"
        )
    if _misfit(_by_id(marker_px, marker_ids), target) > LAYOUT_MISFIT:
        return NotFound("the markers do not lie as the target describes them", misfit=True)
    if np.size(ids) == 0 or px is None:
        return NotFound(f"no board: {len(marker_px)} markers are seen, but no corner")
    order = np.argsort(ids.ravel())
    detected = px.reshape(-1, 2)[order].astype(np.float64)
    return DetectedCorners(
        ids.ravel()[order].astype(np.int64), _refined(image, detected, marker_px)
    )


def _refined(image: Image, px: FloatArray, marker_px: Sequence[Any]) -> FloatArray:
    """Refines (n, 2) corners [px] in windows that exclude the markers."""
    # OpenCV's windows depend on the distance of a marker's corner only: in small, slanted or bent
    # squares they include a marker's sides, which bias the corner by up to half a pixel.
    corners = np.reshape(np.array(marker_px, dtype=float), (-1, 4, 2))
    sides = np.roll(corners, -1, axis=1) - corners
    side_points = corners[:, :, None] + np.linspace(0.0, 1.0, _ALONG)[:, None] * sides[:, :, None]
    distances, _ = KDTree(side_points.reshape(-1, 2)).query(px, p=np.inf)
    windows = np.clip(distances - _CLEAR_PX, *_WINDOWS_PX).astype(int)
    refined = px.astype(np.float32)
    for window in np.unique(windows).tolist():
        mask = windows == window
        start = refined[mask].reshape(-1, 1, 2).copy()
        refined_px = cv2.cornerSubPix(image, start, (window, window), (-1, -1), _ENDS)
        refined[mask] = refined_px.reshape(-1, 2)
    return refined.astype(np.float64)


def fitting_layouts(image: Image, target: Target) -> tuple[Target, ...]:
    """Variants of a ChArUco description that fit the markers in a (h, w) grey image.

    They have the other corner layout, columns and rows exchanged, or both.
    """
    transposed = replace(target, columns=target.rows, rows=target.columns)
    variants = [
        replace(target, legacy=not target.legacy),
        transposed,
        replace(transposed, legacy=not target.legacy),
    ]
    dictionary = charuco_board(target).getDictionary()
    marker_px, marker_ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    if not marker_px:
        return ()
    markers = _by_id(marker_px, marker_ids)
    candidates = [
        variant for variant in variants if len(_matches(markers, variant)[0]) >= 4 * _LAYOUT_MARKERS
    ]
    return tuple(variant for variant in candidates if _misfit(markers, variant) <= LAYOUT_MISFIT)


def _by_id(marker_px: Sequence[Any], marker_ids: Any) -> _Markers:  # noqa: ANN401 - OpenCV's
    return {
        int(marker): np.asarray(px, dtype=float).reshape(4, 2)
        for marker, px in zip(np.ravel(marker_ids), marker_px, strict=True)
    }


def _matches(markers: _Markers, target: Target) -> tuple[FloatArray, FloatArray]:
    """Corners of the detected markers on the board [m], and in the image [px]."""
    board = charuco_board(target)
    ids = np.ravel(np.asarray(board.getIds()))
    places = dict(zip(ids.tolist(), board.getObjPoints(), strict=True))
    on_target = [marker for marker in markers if marker in places]
    if not on_target:
        return np.empty((0, 2)), np.empty((0, 2))
    on_board = np.concatenate([places[marker][:, :2] for marker in on_target])
    return on_board.astype(np.float64), np.concatenate([markers[marker] for marker in on_target])


def _misfit(markers: _Markers, target: Target) -> float:
    on_board, in_image = (match.reshape(-1, 4, 2) for match in _matches(markers, target))
    return layout_misfit(on_board, in_image) if len(on_board) >= _LAYOUT_MARKERS else 0.0
