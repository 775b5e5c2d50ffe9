"""Checkerboards: inner corners of plain squares."""

from dataclasses import replace
from typing import ClassVar, Literal

import cv2
import numpy as np

from visioncal.core.files import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.kind import (
    COUNTS,
    FEWEST_SQUARES,
    MM,
    Cells,
    DetectedCorners,
    NotFound,
    counts_of,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.template import Print

# OpenCV's search takes 170 bytes and a microsecond per pixel, and fails beyond these sides.
_MOST_PIXELS, _MOST_SIDES = 48_000_000, 23_000
# Its searches: a quick one, and two that are tried one after the other.
_FLAGS = (
    0,
    cv2.CALIB_CB_ACCURACY,
    cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE,
)


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
        """Its squares; that diagonally outside corner 0 is dark."""
        row, column = np.indices((target.rows + 1, target.columns + 1))
        side = target.square_m
        return (Cells(np.full(2, -side), side, (row + column) % 2 == 0),)

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """What a printed sheet says of it."""
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
        for flags in _FLAGS[:1] if quick else _FLAGS[1:]:
            found, px = cv2.findChessboardCornersSB(
                image, (target.columns, target.rows), flags=flags
            )
            if not found:
                continue
            grid = px.reshape(target.rows, target.columns, 2).astype(np.float64)
            if _is_checkered(image, grid):
                x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
                grid = grid if x[0] * y[1] - x[1] * y[0] > 0 else grid[:, ::-1]
                grid = _dark_corner_first(image, grid)
                return DetectedCorners(np.arange(target.columns * target.rows), grid.reshape(-1, 2))
        return NotFound(
            f"no board: no checkerboard of {target.columns} x {target.rows} inner corners is seen"
        )

    def miscounted(self, image: Image, target: Target) -> Target | None:
        """The board of one row and column less or more than stated, by a quick search.

        Squares are easily counted in the place of inner corners.
        """
        for more in (-1, 1):
            other = replace(target, columns=target.columns + more, rows=target.rows + more)
            if min(other.columns, other.rows) >= FEWEST_SQUARES and isinstance(
                self.search(image, other, quick=True), DetectedCorners
            ):
                return other
        return None


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
    extended = grid
    for axis in (0, 1):
        first, last = np.take(extended, [0], axis), np.take(extended, [-1], axis)
        before, after = (
            2 * first - np.take(extended, [1], axis),
            2 * last - np.take(extended, [-2], axis),
        )
        extended = np.concatenate([before, extended, after], axis=axis)
    levels = _levels(image, extended)
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


def _dark_corner_first(image: Image, grid: FloatArray) -> FloatArray:
    """Rotates the grid by the least turn that makes its first corner's outward square dark."""
    # That square has the colour of the one diagonally inside, and the inner squares alternate. If
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
    centres = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    pixels = np.clip(np.round(centres).astype(int), 0, np.array(image.shape[::-1]) - 1)
    return np.asarray(image[pixels[..., 1], pixels[..., 0]], float)
