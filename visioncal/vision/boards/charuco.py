"""ChArUco boards: a checkerboard with markers in its light squares."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.checkerboard import measure_squares, square_corners
from visioncal.vision.boards.kind import (
    COUNTS,
    MM,
    Cells,
    DetectedCorners,
    NotFound,
    aruco_dictionary,
    counts_of,
    first_id,
    marker_cells,
    side_metres,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.layout import LAYOUT_MARKERS, LAYOUT_MISFIT, layout_misfit
from visioncal.vision.boards.prints import Print

_USUAL = ("DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000")


class Charuco(Board):
    """A ChArUco board. Its origin is the outer corner of square 0."""

    name: ClassVar[str] = "charuco"
    noun = "ChArUco board"
    options = "--columns --rows --square-mm --marker-mm --dictionary --id --legacy --name"
    in_a_word = (
        rf"{COUNTS}_(?P<square_m>{MM})mm_(?P<marker_m>{MM})mm_(?P<dictionary>DICT_\w+?)"
        "(?P<legacy>_legacy)?"
    )
    keys = "columns rows square_m square_sigma_m marker_m dictionary legacy"
    is_seen_in_part = is_dense = has_quick_search = is_enlarged = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, square_m, square_sigma_m, marker_m, dictionary, legacy, first_id."""
        columns, rows = counts_of(table)
        square_m = size_of(table, "square_m")
        sigma_m = sigma_of(table, square_m)
        marker_m = table.number("marker_m", positive=True)
        # OpenCV compares the sides in single precision.
        low_m = 0.1 * square_m
        if not low_m < marker_m < square_m or np.float32(marker_m) >= np.float32(square_m):
            allowed = f"less than square_m = {square_m!r}, above {low_m:g}, in the same unit"
            raise table.refuse("marker_m", marker_m, allowed)
        dictionary = table.text("dictionary")
        size = f"{columns} x {rows} squares"
        first = first_id(table, columns * rows // 2, size, dictionary)
        legacy = table.flag("legacy")
        board = Target(
            name, self.name, columns, rows, square_m, sigma_m, marker_m, dictionary, legacy
        )
        return replace(board, marker_id=first) if first else board

    def document(self, target: Target) -> dict[str, Any]:
        """The target as the content of a `.toml`; first_id only where it is another than 0."""
        first = {"first_id": target.marker_id} if target.marker_id > 0 else {}
        return super().document(target) | first

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) inner corners [m], row by row."""
        return square_corners(target, 1)

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        layout = ", legacy layout" if target.legacy else ""
        first = f" from id {target.marker_id}" if target.marker_id > 0 else ""
        return f"ChArUco board of {size} squares, {target.dictionary}{first}{layout}"

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print [m]."""
        return np.zeros(2), target.square_m * np.array([target.columns, target.rows], dtype=float)

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Dark squares, and the markers in the light ones."""
        light = marked_squares(target)
        dark = np.ones((target.rows, target.columns), dtype=bool)
        dark[light[:, 1], light[:, 0]] = False
        grids = [Cells(np.zeros(2), target.square_m, dark)]
        inset = (target.square_m - target.marker_m) / 2
        for marker_id, square in enumerate(light, max(target.marker_id, 0)):
            cells = marker_cells(target.dictionary, marker_id)
            corner_m = target.square_m * square + inset
            grids.append(Cells(corner_m, target.marker_m / len(cells), cells))
        return tuple(grids)

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        layout = "legacy layout" if target.legacy else "layout of OpenCV 4.6 and later"
        return (
            f"ChArUco, {target.columns} x {target.rows} squares of {1e3 * target.square_m:g} mm, "
            f"markers of {1e3 * target.marker_m:g} mm, {target.dictionary}, {layout}",
            "the print's top left corner",
            measure_squares(target, target.columns),
        )

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested board; markers of three quarters of a square."""
        # Refuses sides out of range first.
        document = super().requested(request, square_mm)
        marker_mm = request.marker_mm
        if marker_mm is None:
            # At least one module of white on every side; whole millimetres, but where squares are
            # too small for that: rounded to a nanometre.
            marker_mm = round(0.75 * square_mm, 6)
            marker_mm = float(int(marker_mm)) if square_mm >= 10 else marker_mm
        first = {"first_id": request.marker_id} if request.marker_id else {}
        needed = (request.columns or 0) * (request.rows or 0) // 2 + (request.marker_id or 0)
        large = (name for name in _USUAL if len(aruco_dictionary(name).bytesList) >= needed)
        return document | {
            "marker_m": side_metres("--marker-mm", marker_mm),
            "dictionary": request.dictionary or next(large, _USUAL[-1]),
            "legacy": request.legacy,
            **first,
        }

    def file_name(self, target: Target, side: str) -> str:
        """Name of a target with sides of `side`."""
        first = f"_id{target.marker_id}" if target.marker_id > 0 else ""
        return super().file_name(target, side) + first + ("_legacy" if target.legacy else "")

    def around(self, target: Target, ids: IntArray, squares: FloatArray) -> Print:
        """The print around corners, without the markers."""
        del ids
        odd = np.rint(squares).astype(int).sum(axis=1) % 2
        light = marked_squares(target)[0].sum() % 2
        inset = (1.0 - target.marker_m / target.square_m) / 2
        return Print(np.where(odd == light, 1.0, -1.0), inset)

    def search(
        self, image: Image, target: Target, *, quick: bool = False
    ) -> DetectedCorners | NotFound:
        """Chessboard corners, or why there are none (Garrido-Jurado et al. 2014; OpenCV).

        OpenCV's check of interpolated corners against neighbouring markers is off, as it drops
        whole boards at steep tilts; the residual of the pose replaces it later. With `quick`, one
        window size of thresholding, which finds most markers, takes the place of OpenCV's three.
        """
        board = charuco_board(target)
        parameters = cv2.aruco.CharucoParameters()
        parameters.checkMarkers = False
        marker_parameters = cv2.aruco.DetectorParameters()
        if quick:
            # Of 7 to 31 px, it detected most markers at squares of 20 to 70 px.
            marker_parameters.adaptiveThreshWinSizeMin = 7
            marker_parameters.adaptiveThreshWinSizeMax = 7
        detector = cv2.aruco.CharucoDetector(board, parameters, marker_parameters)
        px, ids, marker_px, marker_ids = detector.detectBoard(image)
        if not marker_px:
            return NotFound(f"no board: no marker of {target.dictionary} is seen")
        if len(marker_px) - len(np.unique(marker_ids)) >= LAYOUT_MARKERS:
            # The corners could be of either board, or of both.
            return NotFound(
                "markers are seen twice: another board with the same markers is in the image"
            )
        places = dict(zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True))
        by_id = dict(zip(np.ravel(marker_ids).tolist(), marker_px, strict=True))
        known = [marker for marker in by_id if marker in places]
        if len(known) >= LAYOUT_MARKERS:
            on_board = np.array([places[marker][:, :2] for marker in known], dtype=float)
            in_image = np.array([by_id[marker] for marker in known], dtype=float)
            if layout_misfit(on_board, in_image.reshape(-1, 4, 2)) > LAYOUT_MISFIT:
                return NotFound("the markers do not lie as the target describes them", misfit=True)
        if np.size(ids) == 0 or px is None:
            return NotFound(f"no board: {len(marker_px)} markers are seen, but no corner")
        order = np.argsort(ids.ravel())
        detected = px.reshape(-1, 2)[order].astype(np.float64)
        return DetectedCorners(ids.ravel()[order].astype(np.int64), detected)

    def marker_places(self, numbers: IntArray, columns: int) -> Sequence[FloatArray]:
        """Row by row in the light squares, from the upper left; the legacy layout is the second."""
        return [_places(numbers, columns, legacy=legacy) for legacy in (False, True)]


def marked_squares(target: Target) -> IntArray:
    """(m, 2) light squares of a ChArUco board as column and row, by marker id."""
    # Markers are on the light squares.
    places = np.asarray(charuco_board(target).getObjPoints(), dtype=float)[..., :2]
    return np.asarray(np.floor(places.mean(axis=1) / target.square_m), dtype=np.int64)


# Cached, as OpenCV warns of a narrow rim around the markers whenever it builds the board.
@lru_cache(maxsize=64)
def charuco_board(target: Target) -> "cv2.aruco.CharucoBoard":
    """OpenCV's board for a ChArUco target."""
    # It warns of markers that nearly fill their squares, once for each image.
    logged = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        board = cv2.aruco.CharucoBoard(
            (target.columns, target.rows),
            target.square_m,
            target.marker_m,
            aruco_dictionary(target.dictionary),
            np.arange(target.columns * target.rows // 2, dtype=np.int32) + max(target.marker_id, 0),
        )
    finally:
        cv2.utils.logging.setLogLevel(logged)
    board.setLegacyPattern(target.legacy)
    return board


def _places(ids: IntArray, columns: int, *, legacy: bool) -> FloatArray:
    """Squares (x, y) of the markers with these ids, (n, 2)."""
    # Two rows together have one marker per column, the first row the smaller half unless legacy.
    first = (columns + legacy) // 2
    pair, within = np.divmod(ids, columns)
    lower = within >= first
    place = np.where(lower, within - first, within)
    # In the upper row of a pair the markers are in the odd columns, or the even ones if legacy.
    start = np.where(lower == legacy, 1, 0)
    return np.stack([2 * place + start, 2 * pair + lower], axis=1).astype(float)
