"""Checkerboards: inner corners of plain squares."""

from collections.abc import Iterator
from itertools import product
from typing import ClassVar, Literal

import cv2
import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.imaging import shrunk
from visioncal.vision.boards.kind import (
    COUNTS,
    DEFAULT_RELATIVE_SIGMA,
    MM,
    Cells,
    DetectedCorners,
    NotFound,
    counts_of,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.prints import Print

# OpenCV's search takes 170 bytes and a microsecond per pixel, and fails beyond these sides.
_MOST_PIXELS, _MOST_SIDES = 48_000_000, 23_000
# Counts that the search for any count begins at: a smaller one finds more small boards, and more
# parts of larger ones.
_FEWEST = ((4, 4), (3, 3))
# Shares of a square at which its grey levels are compared, and their range in units of contrast
# from which on it is not plain: light and noise leave a tenth. The part that is averaged.
_INSIDE, _MARKS, _DOTS = (0.25, 0.4, 0.6, 0.75), 0.4, 0.25
# Distance from the outermost squares at which it shows whether others follow [squares].
RIM = 0.3
# Share of a square around a corner within which edges refine it, and until when: by 0.01 px.
_AROUND, _UNTIL = 0.25, (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
# About the longer side of the image in which outlines of squares are looked for: among the noise of
# more pixels their search takes most of a minute. A smaller copy loses small squares, so that up to
# half as many more pixels a side are kept and smoothed by some [px].
_OUTLINES_PX, _SMOOTHED_PX = 1500, 1.0


class Checkerboard(Board):
    """A checkerboard. Its origin is inner corner 0; it has no markers."""

    name: ClassVar[str] = "checkerboard"
    noun = "checkerboard"
    options = "--columns --rows --square-mm --name"
    in_a_word = rf"{COUNTS}_(?P<square_m>{MM})mm"
    symmetric: ClassVar[Literal["", "squares", "places"]] = "squares"
    is_dense = True
    # A checkerboard has no markers that get lost in a reduced copy.
    long_side_px = 1000
    has_quick_search = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, square_m and square_sigma_m."""
        columns, rows = counts_of(table)
        square_m = size_of(table, "square_m")
        return Target(name, self.name, columns, rows, square_m, sigma_of(table, square_m))

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) inner corners [m], row by row."""
        return square_corners(target, 0)

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        del target
        return f"checkerboard of {size} inner corners"

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print: its origin is one square inside."""
        side = target.square_m
        return np.full(2, -side), side * np.array([target.columns, target.rows], dtype=float)

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Squares of the board; the one diagonally outside corner 0 is dark."""
        row, column = np.indices((target.rows + 1, target.columns + 1))
        side = target.square_m
        return (Cells(np.full(2, -side), side, (row + column) % 2 == 0),)

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        return (
            f"checkerboard, {target.columns} x {target.rows} inner corners, squares of "
            f"{1e3 * target.square_m:g} mm",
            "the inner corner at the top left",
            measure_squares(target, target.columns + 1),
        )

    def around(self, target: Target, ids: IntArray, squares: FloatArray) -> Print:
        """The print around corners; it may be described rotated, so that either sign is light."""
        del target, ids
        odd = np.rint(squares).astype(int).sum(axis=1) % 2
        return Print(1.0 - 2.0 * odd, np.inf)

    def search(
        self, image: Image, target: Target, *, quick: bool = False
    ) -> DetectedCorners | NotFound:
        """Inner corners, or why there are none.

        Duda and Frese (2018), through OpenCV. Corner 0 is the one whose outward diagonal square is
        dark. For a board with a symmetry by 180 degrees this is ambiguous, and the robot's motion
        has to decide. With `quick`, only the image's size is searched; OpenCV also searches at
        twice the size, which takes four times as long.
        """
        height, width = image.shape
        # Fewer it does not find; the squares of a small ChArUco board have two.
        if min(target.columns, target.rows) < 3:
            return NotFound("no board: so few inner corners are not looked for")
        if min(image.shape) < 2 or height + width > _MOST_SIDES or height * width > _MOST_PIXELS:
            return NotFound(
                f"no board: in an image of {width} x {height} px no checkerboard is looked for "
                f"(up to {_MOST_PIXELS / 1e6:.0f} million pixels; a ChArUco board is found in "
                "larger ones)"
            )
        for grid in _grids(image, (target.columns, target.rows), quick=quick):
            if _is_checkered(image, grid):
                x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
                turned = grid if x[0] * y[1] - x[1] * y[0] > 0 else grid[:, ::-1]
                px = _dark_corner_first(image, turned).reshape(-1, 2)
                return DetectedCorners(np.arange(target.columns * target.rows), px)
        return NotFound(
            f"no board: no checkerboard of {target.columns} x {target.rows} inner corners is seen"
        )

    def seen_in(self, image: Image) -> tuple[Target, bool] | None:
        """The checkerboard of any count in a (h, w) grey image, the wider way; see `BoardKind`."""
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        for size in _FEWEST:
            found, px, meta = cv2.findChessboardCornersSBWithMeta(image, size, flags=flags)
            grid = px.reshape(*meta.shape, 2).astype(float) if found else np.zeros((0, 0, 2))
            for part in _parts(grid) if found else ():
                # Checked before the second look, which takes long where it finds nothing.
                if not _is_checkered(image, part) or _ends(image, part) is False:
                    continue
                columns, rows = sorted(part.shape[:2], reverse=True)
                board = Target("board", self.name, columns, rows, 1.0, DEFAULT_RELATIVE_SIGMA)
                # A second look, as this search takes parts of some boards for the whole.
                seen = self.search(image, board, quick=True)
                if isinstance(seen, NotFound):
                    seen = self.search(image, board)
                if isinstance(seen, DetectedCorners):
                    grid = seen.px.reshape(rows, columns, 2)
                    is_plain = _has_tips(image, grid) and not _has_marks(image, grid)
                    return (board, _ends(image, grid) is True) if is_plain else None
        return None

    def without(self, image: Image, target: Target) -> Image:
        """A (h, w) grey image in which a board is painted over, where it is seen."""
        seen = self.search(image, target, quick=True)
        if isinstance(seen, NotFound):
            return image
        grid = _extended(seen.px.reshape(target.rows, target.columns, 2), 1.0 + RIM)
        hull = cv2.convexHull(grid.reshape(-1, 2).astype(np.float32)).astype(np.int32)
        return np.asarray(cv2.fillConvexPoly(image.copy(), hull, int(np.median(image))))


def _grids(image: Image, size: tuple[int, int], *, quick: bool) -> Iterator[FloatArray]:
    """(rows, columns, 2) grids of corners that one search after the other takes for the board.

    The quickest comes first: that by outlines takes a tenth of the thorough ones, and also finds
    boards whose corners these lose.
    """
    if quick:
        yield from _by_corners(image, size, 0)
        return
    yield from _by_outlines(image, size)
    fine = cv2.CALIB_CB_ACCURACY
    yield from _by_corners(image, size, fine)
    yield from _by_corners(
        image, size, fine | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    )


def _by_corners(image: Image, size: tuple[int, int], flags: int) -> Iterator[FloatArray]:
    """The (rows, columns, 2) grid that OpenCV's search for corners finds, if it does."""
    found, px = cv2.findChessboardCornersSB(image, size, flags=flags)
    if found:
        yield px.reshape(*size[::-1], 2).astype(np.float64)


def _by_outlines(image: Image, size: tuple[int, int]) -> Iterator[FloatArray]:
    """The (rows, columns, 2) grid that OpenCV's search for outlines of squares finds, if any."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    by = max(1, round(max(image.shape) / _OUTLINES_PX))
    if by > 1:
        image = shrunk(image, by)
    elif max(image.shape) > _OUTLINES_PX:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTHED_PX), np.uint8)
    found, px = cv2.findChessboardCorners(image, size, flags=flags)
    if found:
        # Outlines meet within a pixel of the corner.
        steps = np.linalg.norm(np.diff(px.reshape(*size[::-1], 2), axis=1), axis=2)
        reach = max(round(_AROUND * float(steps.min())), 1)
        px = cv2.cornerSubPix(image, px, (reach, reach), (-1, -1), _UNTIL)
        # From pixel centres of the small image to those of the large one.
        yield by * px.reshape(*size[::-1], 2).astype(np.float64) + (by - 1) / 2


def _parts(grid: FloatArray) -> Iterator[FloatArray]:
    """A (rows, columns, 2) grid, then it without some of its outermost lines, fewest first.

    Where a board is printed to its edge, OpenCV's search for any count takes that for a line.
    """
    height, width, _ = grid.shape
    cuts = sorted(product((0, 1), repeat=4), key=sum)
    for top, bottom, left, right in cuts:
        part = grid[top : height - bottom, left : width - right]
        if min(part.shape[:2]) >= _FEWEST[-1][0]:
            yield part


def square_corners(target: Target, inset: int) -> FloatArray:
    """(n, 3) corners [m] of a board's squares, row by row, from `inset` squares inside on."""
    rows, columns = np.mgrid[inset : target.rows, inset : target.columns]
    flat = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
    return np.asarray(target.square_m * flat, dtype=float)


def measure_squares(target: Target, count: int) -> str:
    """How to measure the side of a board's squares, over `count` columns."""
    return (
        f"Measure over all {count} columns, meant to be {1e3 * count * target.square_m:g} mm; "
        f"divide by {count} and write the result into square_m, in metres."
    )


def _is_checkered(image: Image, grid: FloatArray) -> bool:
    """Whether dark and light squares meet at the corners of a (rows, columns, 2) grid.

    For small boards OpenCV sometimes skips a row and takes the board's edge as the last one.
    """
    # Prints are often cut within their outermost squares.
    levels = _levels(image, _extended(grid, 0.5))
    diagonal = np.stack([levels[:-1, :-1], levels[1:, 1:]])
    antidiagonal = np.stack([levels[:-1, 1:], levels[1:, :-1]])
    gap = np.maximum(
        antidiagonal.min(axis=0) - diagonal.max(axis=0),
        diagonal.min(axis=0) - antidiagonal.max(axis=0),
    )
    # A share of the local contrast.
    meet = gap > 0.25 * np.ptp(np.concatenate([diagonal, antidiagonal]), axis=0)
    # Glare hides some.
    return all(bool(np.all(meet.mean(axis=axis) >= 0.5)) for axis in (0, 1))


def _extended(grid: FloatArray, share: float = 1.0) -> FloatArray:
    """A (rows, columns, 2) grid with points a share of a square outside of its outermost ones."""
    for axis in (0, 1):
        first, last = np.take(grid, [0], axis), np.take(grid, [-1], axis)
        before = first + share * (first - np.take(grid, [1], axis))
        after = last + share * (last - np.take(grid, [-2], axis))
        grid = np.concatenate([before, grid, after], axis=axis)
    return grid


def _ends(image: Image, grid: FloatArray) -> bool | None:
    """Whether no squares follow beyond the outermost ones of a (rows, columns, 2) grid of corners.

    None where the image does not show it of some side.
    """
    limits, outermost, shown_sides = np.array(image.shape[::-1]) - 1, _extended(grid), 0
    for side in (np.rot90(grid, quarter) for quarter in range(4)):
        first, second, third = _extended(side)[1:4]
        # By three rows, as perspective and lens change the steps from row to row.
        last, beyond = (
            first + by * (first - second) + by * (by + 1) / 2 * (first - 2 * second + third)
            for by in (0.5, 1.0 + RIM)
        )
        middles = np.stack([last[1:] + last[:-1], beyond[1:] + beyond[:-1]]) / 2
        inside = (middles >= 0) & (middles <= limits)
        shown = np.all(inside, axis=(0, 2))
        steps = np.diff(_at(image, middles), axis=1) * (shown[1:] & shown[:-1])
        # The next squares' levels change the other way.
        if -np.sum(steps[0] * steps[1]) > 0.5 * np.sum(steps[0] ** 2):
            return False
        shown_sides += bool(steps.any())
    is_inside = bool(np.all((outermost >= 0) & (outermost <= limits)))
    return True if is_inside or shown_sides == 4 else None


def _has_tips(image: Image, grid: FloatArray) -> bool:
    """Whether squares meet at the corners of a (rows, columns, 2) grid, as circles do not.

    Near its corner a dark square is still dark, where overexposed light blooms over the corner.
    """
    middles = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    levels = _at(image, middles)
    dark, light = np.percentile(levels, [25, 75])
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]])
    # Share of the way from a corner to the middle of a dark square; usual circles end before.
    near = _at(image, corners + 0.2 * (middles - corners))[:, levels < (dark + light) / 2]
    return bool(near.size and np.median(near) < (dark + light) / 2)


def _has_marks(image: Image, grid: FloatArray) -> bool:
    """Whether the squares of a (rows, columns, 2) grid are no plain ones, as those of markers."""
    # Dots that a projector throws on it are smaller than the marks of any marker.
    side = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=2)))
    image = np.asarray(cv2.blur(image, (max(round(_DOTS * side), 1),) * 2), np.uint8)
    corners = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    shares = [(x, y) for x in _INSIDE for y in _INSIDE]
    places = [
        (1 - x) * (1 - y) * corners[0] + x * (1 - y) * corners[1] + (1 - x) * y * corners[2]
        + x * y * corners[3]
        for x, y in shares
    ]  # fmt: skip
    levels = np.stack([_at(image, place) for place in places])
    ranges = np.ptp(levels, axis=0) / max(np.ptp(np.median(levels, axis=0)), 1.0)
    odd = np.indices(ranges.shape).sum(axis=0) % 2 == 1
    return max(float(np.median(ranges[odd])), float(np.median(ranges[~odd]))) > _MARKS


def _dark_corner_first(image: Image, grid: FloatArray) -> FloatArray:
    """Rotates the grid by the least turn that makes its first corner's outward square dark."""
    # Its colour is that of the square diagonally inside, and the inner squares alternate. If
    # no turn changes the colour, the board is symmetric and the grid remains.
    for quarter in (0, 2, 1, 3) if grid.shape[0] == grid.shape[1] else (0, 2):
        rotated = np.rot90(grid, quarter)
        levels = _levels(image, rotated)
        even = np.indices(levels.shape).sum(axis=0) % 2 == 0
        if levels[even].mean() < levels[~even].mean():
            return rotated
    return grid


def _levels(image: Image, grid: FloatArray) -> FloatArray:
    """Grey levels (rows - 1, columns - 1) at the centres of a grid's squares."""
    return _at(image, (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4)


def _at(image: Image, places: FloatArray) -> FloatArray:
    """Grey levels at (..., 2) places [px]."""
    pixels = np.clip(np.round(places).astype(int), 0, np.array(image.shape[::-1]) - 1)
    return np.asarray(image[pixels[..., 1], pixels[..., 0]], float)
