"""Finding checkerboards."""

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.finders.result import DetectedCorners, NotFound

# OpenCV's search takes 170 bytes and a microsecond a pixel, and fails beyond such sides.
MOST_PIXELS, _MOST_SIDES = 48_000_000, 23_000


def find_checkerboard(
    image: Image, target: Target, *, quick: bool = False
) -> DetectedCorners | NotFound:
    """Finds the inner corners of a checkerboard (Duda and Frese 2018, through OpenCV).

    Corner 0 becomes the one whose outward diagonal square is dark. Where the board looks the same
    after a turn by 180 degrees that does not settle it, and the robot's motion has to.

    Args:
        image: (h, w) grey image.
        target: A checkerboard target.
        quick: Whether to search in the image alone: OpenCV also searches in one of twice the size,
            which takes four times as long.

    Returns:
        The corners, or why there are none.
    """
    height, width = image.shape
    if min(image.shape) < 2 or height + width > _MOST_SIDES or height * width > MOST_PIXELS:
        return NotFound(
            f"no board: in an image of {width} x {height} px no checkerboard is looked for (up to "
            f"{MOST_PIXELS / 1e6:.0f} million pixels; a ChArUco board is found in larger ones)"
        )
    size = (target.columns, target.rows)
    flags = 0 if quick else cv2.CALIB_CB_ACCURACY
    found, px = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not found and not quick:
        thorough = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, px = cv2.findChessboardCornersSB(image, size, flags=thorough)
    if not found:
        return NotFound(
            f"no board: no checkerboard of {target.columns} x {target.rows} inner corners is seen"
        )
    grid = px.reshape(target.rows, target.columns, 2).astype(np.float64)
    grid = _dark_corner_first(image, _right_handed(grid))
    return DetectedCorners(np.arange(target.columns * target.rows), grid.reshape(-1, 2))


def _right_handed(grid: FloatArray) -> FloatArray:
    """Mirrors the (rows, columns, 2) grid where x to y does not turn as it does on the board."""
    x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return grid if x[0] * y[1] - x[1] * y[0] > 0 else grid[:, ::-1]


def _dark_corner_first(image: Image, grid: FloatArray) -> FloatArray:
    """Turns the grid by the least turn that makes its first corner's outward square dark."""
    # That square has the colour of the one diagonally inside, and the inner squares alternate.
    # Where no turn changes the colour, the board is symmetric and the grid stays as it is.
    turns = (0, 2, 1, 3) if grid.shape[0] == grid.shape[1] else (0, 2)
    turned = (np.rot90(grid, quarter) for quarter in turns)
    return next((array for array in turned if _starts_dark(image, array)), grid)


def _starts_dark(image: Image, grid: FloatArray) -> bool:
    centres = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    at = np.round(centres).astype(int)
    levels = image[at[..., 1], at[..., 0]].astype(float)
    row, column = np.indices(levels.shape)
    even = (row + column) % 2 == 0
    return bool(levels[even].mean() < levels[~even].mean())
