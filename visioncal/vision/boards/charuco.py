"""ChArUco boards: a checkerboard with markers in its light squares."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any, ClassVar

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.number_format import listed
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.checkerboard import measure_squares, square_corners
from visioncal.vision.boards.identity import LEAST_MARKERS, Identity, Marker, holding
from visioncal.vision.boards.kind import (
    COUNTS,
    DEFAULT_RELATIVE_SIGMA,
    MM,
    BoardRequest,
    Cells,
    DetectedCorners,
    NotFound,
    aruco_dictionary,
    counts_of,
    dictionary_size,
    marker_cells,
    side_metres,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.layout import LAYOUT_MISFIT, layout_misfit
from visioncal.vision.boards.template import Print

# A homography has eight unknowns and a marker gives eight equations: three are a check.
_LAYOUT_MARKERS = 3


_USUAL = ("DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000")
# Steps between markers up to this length, and this close to whole squares, are counted [squares].
_NEAR, _OFF = 2.5, 0.3
_SHARES = (0.25, 0.98)
# A marker's corners around its centre [sides].
_AROUND = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


class Charuco(Board):
    """A ChArUco board. Its origin is the outer corner of square 0."""

    name: ClassVar[str] = "charuco"
    noun = "ChArUco board"
    options = "--columns --rows --square-mm --marker-mm --dictionary --legacy --name"
    in_a_word = (
        rf"{COUNTS}_(?P<square_m>{MM})mm_(?P<marker_m>{MM})mm_(?P<dictionary>DICT_\w+?)"
        "(?P<legacy>_legacy)?"
    )
    keys = "columns rows square_m square_sigma_m marker_m dictionary legacy"
    is_seen_in_part = is_dense = has_quick_search = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, square_m, square_sigma_m, marker_m, dictionary and legacy."""
        columns, rows = counts_of(table)
        square_m = size_of(table, "square_m")
        sigma_m = sigma_of(table, square_m)
        marker_m = table.number("marker_m", positive=True)
        # OpenCV compares the sides in single precision.
        low_m = 0.1 * square_m
        if not low_m < marker_m < square_m or np.float32(marker_m) >= np.float32(square_m):
            allowed = f"less than square_m = {square_m!r}, above {low_m:g}, in the same unit,"
            raise table.refuse("marker_m", marker_m, allowed)
        dictionary = table.text("dictionary")
        markers, needed = dictionary_size(table, dictionary), columns * rows // 2
        if markers < needed:
            raise DataError(
                f"{table.label}: dictionary {dictionary} has {markers} markers; a board of "
                f"{columns} x {rows} squares needs {needed}.",
                culprits=[f"{table.label}: dictionary"],
            )
        legacy = table.flag("legacy", default=False)
        return Target(
            name, self.name, columns, rows, square_m, sigma_m, marker_m, dictionary, legacy
        )

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) inner corners [m], row by row."""
        return square_corners(target, 1)

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        layout = ", legacy layout" if target.legacy else ""
        return f"ChArUco board of {size} squares, {target.dictionary}{layout}"

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print [m]."""
        return np.zeros(2), target.square_m * np.array([target.columns, target.rows], dtype=float)

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Its dark squares, and the markers in the light ones."""
        light = marked_squares(target)
        dark = np.ones((target.rows, target.columns), dtype=bool)
        dark[light[:, 1], light[:, 0]] = False
        grids = [Cells(np.zeros(2), target.square_m, dark)]
        inset = (target.square_m - target.marker_m) / 2
        for marker_id, square in enumerate(light):
            cells = marker_cells(target.dictionary, marker_id)
            corner_m = target.square_m * square + inset
            grids.append(Cells(corner_m, target.marker_m / len(cells), cells))
        return tuple(grids)

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """What a printed sheet says of it."""
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
        needed = (request.columns or 0) * (request.rows or 0) // 2
        large = (name for name in _USUAL if len(aruco_dictionary(name).bytesList) >= needed)
        return document | {
            "marker_m": side_metres("--marker-mm", marker_mm),
            "dictionary": request.dictionary or next(large, _USUAL[-1]),
            "legacy": request.legacy,
        }

    def file_name(self, target: Target, side: str) -> str:
        """Name of a target with sides of `side`."""
        return super().file_name(target, side) + ("_legacy" if target.legacy else "")

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
        if len(marker_px) - len(np.unique(marker_ids)) >= _LAYOUT_MARKERS:
            # The corners could be of either board, or of both.
            return NotFound(
                "markers are seen twice: another board with the same markers is in the image"
            )
        places = dict(zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True))
        by_id = dict(zip(np.ravel(marker_ids).tolist(), marker_px, strict=True))
        known = [marker for marker in by_id if marker in places]
        if len(known) >= _LAYOUT_MARKERS:
            on_board = np.array([places[marker][:, :2] for marker in known], dtype=float)
            in_image = np.array([by_id[marker] for marker in known], dtype=float)
            if layout_misfit(on_board, in_image.reshape(-1, 4, 2)) > LAYOUT_MISFIT:
                return NotFound("the markers do not lie as the target describes them", misfit=True)
        if np.size(ids) == 0 or px is None:
            return NotFound(f"no board: {len(marker_px)} markers are seen, but no corner")
        order = np.argsort(ids.ravel())
        detected = px.reshape(-1, 2)[order].astype(np.float64)
        return DetectedCorners(ids.ravel()[order].astype(np.int64), detected)

    def identify(self, image: Image, markers: Sequence[Marker]) -> list[Identity]:
        """Boards by the markers of each family."""
        families = sorted({marker.family for marker in markers})
        boards = (
            _identified(image, [marker for marker in markers if marker.family == family])
            for family in families
        )
        return [board for board in boards if board is not None]


CHARUCO = Charuco()


def marked_squares(target: Target) -> IntArray:
    """(m, 2) light squares of a ChArUco board as column and row, by marker id."""
    # Markers are on the light squares.
    places = np.asarray(charuco_board(target).getObjPoints(), dtype=float)[..., :2]
    return np.asarray(np.floor(places.mean(axis=1) / target.square_m), dtype=np.int64)


# Cached, as OpenCV warns of a narrow rim around the markers whenever it builds the board.
@lru_cache(maxsize=64)
def charuco_board(target: Target) -> cv2.aruco.CharucoBoard:
    """OpenCV's board for a ChArUco target."""
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows),
        target.square_m,
        target.marker_m,
        aruco_dictionary(target.dictionary),
    )
    board.setLegacyPattern(target.legacy)
    return board


def _identified(image: Image, markers: Sequence[Marker]) -> Identity | None:
    """Identifies a ChArUco board from the markers of one family, with false positives.

    The ids count the white squares row by row: columns and layout predict the step from each marker
    to its neighbours. Steps are measured in the frame of the marker itself, where perspective and
    lens hardly count. Where too few rows are seen to determine the columns, several layouts predict
    them; corners decide, or a note names the others.
    """
    if len(markers) < LEAST_MARKERS:
        return None
    ids = np.array([marker.number for marker in markers])
    px = np.array([marker.px for marker in markers])
    centres = np.array([marker.centre for marker in markers])
    sides = np.stack(
        [px[:, 1] + px[:, 2] - px[:, 0] - px[:, 3], px[:, 2:].sum(1) - px[:, :2].sum(1)]
    )
    own_from_px = 2.0 * np.linalg.pinv(np.moveaxis(sides, 0, -1))
    # (n, n, 2) steps [marker sides].
    steps = np.einsum("iab,ijb->ija", own_from_px, centres - centres[:, None])
    lengths = np.abs(steps).max(axis=2) + np.diag(np.full(len(ids), np.inf))
    sides_away = max(float(np.median(lengths.min(axis=1))), 1e-9)
    agreeing = {}
    # The nearest marker is one square away along both axes, or two where some are not read.
    for share in (1.0 / sides_away, 2.0 / sides_away):
        whole = np.rint(share * steps)
        near = whole.any(axis=2) & (share * lengths < _NEAR)
        near &= (np.abs(share * steps - whole) < _OFF).all(axis=2)
        # Printable boards have fewer columns.
        for columns, legacy in product(range(3, 41), (False, True)):
            places = _places(ids, columns, legacy=legacy)
            pairs = near & (places - places[:, None] == whole).all(axis=2)
            agreeing[share, columns, legacy] = pairs
    most = max(int(pairs.sum()) for pairs in agreeing.values())
    tied = [layout for layout, pairs in agreeing.items() if pairs.sum() == most]
    boards = []
    for share, columns, legacy in tied[:4]:
        fits = agreeing[share, columns, legacy].any(axis=1)
        # At most half of the markers may be false positives.
        if fits.sum() >= max(LEAST_MARKERS, len(ids) / 2):
            fitting = [markers[index] for index in np.flatnonzero(fits).tolist()]
            boards.append(_charuco_of(image, fitting, columns, share, legacy=legacy))
    found = sorted(filter(None, boards), key=lambda board: -board.corners_seen)
    rivals = [board for board in found[1:] if board.corners_seen == found[0].corners_seen]
    if not rivals:
        return next(iter(found), None)
    layouts = ", ".join(
        f"{rival.columns} x {rival.rows}{' in the legacy layout' if rival.legacy else ''}"
        for rival in (identity.board for identity in rivals)
    )
    note = f"What is seen of it fits {layouts} as well: show more of the board."
    return replace(found[0], notes=(note, *found[0].notes))


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


def _charuco_of(
    image: Image, markers: Sequence[Marker], columns: int, share: float, *, legacy: bool
) -> Identity | None:
    """The board of a layout that markers fit, with the corners of its detector; None without."""
    ids = np.array([marker.number for marker in markers])
    squares = _places(ids, columns, legacy=legacy)
    rows = int(squares[:, 1].max()) + 1
    quads = np.array([marker.px for marker in markers])
    for _ in range(3):
        places = (squares + 0.5)[:, None] + share * _AROUND
        fit = cv2.findHomography(places.reshape(-1, 2), quads.reshape(-1, 2))[0]
        px_from_board = np.asarray(fit, dtype=float)
        if px_from_board.shape != (3, 3) or np.linalg.matrix_rank(px_from_board) < 3:
            return None
        seen_places = cv2.perspectiveTransform(quads, np.linalg.inv(px_from_board))
        areas = [cv2.contourArea(quad.astype(np.float32)) for quad in seen_places]
        share = float(np.sqrt(np.median(areas)))
    if legacy and rows % 2:
        # A legacy board with an odd number of rows does not start with a marker.
        rows += 1
    names = holding(markers[0].family, max(columns * rows // 2, int(ids.max()) + 1))
    if not _SHARES[0] < share < _SHARES[1] or not names:
        return None
    notes = ["The markers' side is by the image, to about 3 %: measure it to be sure."]
    if len(names) > 1:
        notes.append(f"{listed(names[1:])} hold the same markers: any of them finds this board.")
    sigma, share = DEFAULT_RELATIVE_SIGMA, round(share, 5)
    board = Target("board", "charuco", columns, rows, 1.0, sigma, share, names[0], legacy)
    seen = CHARUCO.search(image, board)
    found = len(seen.ids) if isinstance(seen, DetectedCorners) else 0
    # So many markers in place prove a board without its corners.
    if not found and len(markers) < 8:
        return None
    if isinstance(seen, NotFound):
        notes.insert(0, f"Its corners are not found in this image: {seen.reason}.")
    corners, numbers = (columns - 1) * (rows - 1), tuple(sorted(set(ids.tolist())))
    return Identity(board, found, corners, names[1:], numbers, tuple(notes))
