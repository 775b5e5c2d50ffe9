"""A flat board seen through a distorting lens: a homography and one distortion coefficient.

The division model (Fitzgibbon 2001) needs no focal length: a pixel at distance r from the image's
centre is undistorted to r / (1 + bend r^2). It is accurate enough for counting with wide-angle and
fisheye lenses.

A chessboard's corners, where dark and light squares meet, are recognised by the grey levels around
them.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from visioncal.core.types import FloatArray, Image, Mask

# In units of half the image's diagonal: from no distortion to a fisheye lens of 150 degrees.
BENDS = (0.0, -0.1, -0.25, -0.45)
_LEAST_BEND, _MOST_BEND = -0.8, 0.3
# A homography takes four points; fewer than eight do not determine distortion.
_LEAST_POINTS, _LEAST_FOR_BEND = 4, 8
# Margin at the image's edge that is not evaluated [px].
_BORDER_PX = 3.0
# Minimum contrast of a corner, as a share of the board's typical contrast.
_LEAST_CONTRAST = 0.4


@dataclass(frozen=True)
class Lens:
    """Distortion of the image."""

    middle: tuple[float, float]  # Centre of the image (x, y) [px].
    radius: float  # Half its diagonal [px].
    bend: float  # Distortion coefficient; negative for barrel distortion.

    def straighten(self, px: FloatArray) -> FloatArray:
        """Undistorts (n, 2) pixels."""
        offset = (px - np.array(self.middle)) / self.radius
        return np.asarray(offset / (1.0 + self.bend * (offset**2).sum(axis=1, keepdims=True)))

    def distort(self, straight: FloatArray) -> FloatArray:
        """Distorts (n, 2) undistorted points to pixels."""
        square = np.maximum(1.0 - 4.0 * self.bend * (straight**2).sum(axis=1, keepdims=True), 0.0)
        offset = 2.0 * straight / (1.0 + np.sqrt(square))
        return np.asarray(np.array(self.middle) + self.radius * offset)


@dataclass(frozen=True, eq=False)
class Plane:
    """Pose of a board in an image."""

    lens: Lens  # Distortion.
    # (3, 3) homography from the board [squares] to undistorted points.
    straight_from_board: FloatArray

    def to_px(self, places: FloatArray) -> FloatArray:
        """Maps (n, 2) positions on the board [squares] to pixels."""
        straight = cv2.perspectiveTransform(places.reshape(-1, 1, 2), self.straight_from_board)
        return self.lens.distort(np.asarray(straight, dtype=float)[:, 0])

    def to_board(self, px: FloatArray) -> FloatArray:
        """Maps (n, 2) pixels to the board [squares]."""
        straight = self.lens.straighten(px)
        board_from_straight = np.linalg.inv(self.straight_from_board)
        places = cv2.perspectiveTransform(straight[:, None], board_from_straight)
        return np.asarray(places, dtype=float)[:, 0]

    def shows(self, image: Image, places: FloatArray) -> Mask:
        """Mask of (n, 2) positions on the board [squares] that are in the image."""
        # Behind the camera the homography's denominator has the opposite sign of the origin's.
        depth = places @ self.straight_from_board[2, :2] + self.straight_from_board[2, 2]
        px = self.to_px(places)
        size = np.array(image.shape[::-1])
        seen = ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all(axis=1)
        return np.asarray(seen & (depth * self.straight_from_board[2, 2] > 0))

    def levels(self, image: Image, places: FloatArray) -> FloatArray:
        """Grey levels (m, n) of the image at (m, n, 2) positions on the board [squares]."""
        px = self.to_px(places.reshape(-1, 2)).reshape(places.shape).astype(np.float32)
        levels = cv2.remap(
            image, px[..., 0], px[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(levels, dtype=float)


def lens_of(image: Image, bend: float) -> Lens:
    """A lens centred in the image."""
    height, width = image.shape
    return Lens(((width - 1) / 2, (height - 1) / 2), float(np.hypot(width, height)) / 2, bend)


def robust_plane(
    lens: Lens, board: FloatArray, px: FloatArray, tolerance_px: float
) -> tuple[Plane, Mask] | None:
    """A plane and its inliers, fitted to points with outliers, or None.

    RANSAC (Fischler and Bolles 1981) on (n, 2) positions on the board [squares] and pixels.
    """
    if len(board) < _LEAST_POINTS:
        return None
    homography, mask = cv2.findHomography(
        board,
        lens.straighten(px),
        cv2.RANSAC,
        tolerance_px / lens.radius,
        maxIters=200,
        confidence=0.99,
    )
    if (
        homography is None
        or np.shape(homography) != (3, 3)
        or np.linalg.matrix_rank(homography) < 3
    ):
        return None
    return Plane(lens, np.asarray(homography, dtype=float)), np.ravel(mask) > 0


def distorted_plane(plane: Plane, board: FloatArray, px: FloatArray) -> Plane:
    """Fits the plane with its distortion to (n, 2) inliers."""
    if len(board) < _LEAST_FOR_BEND:
        return plane

    def fit(bend: float) -> Plane:
        lens = Lens(plane.lens.middle, plane.lens.radius, bend)
        homography, _ = cv2.findHomography(board, lens.straighten(px))
        usable = homography is not None and np.linalg.matrix_rank(homography) == len(homography)
        return Plane(lens, np.asarray(homography, dtype=float)) if usable else plane

    def misfit(bend: float) -> float:
        return float(np.sum((fit(bend).to_px(board) - px) ** 2))

    best = minimize_scalar(misfit, bounds=(_LEAST_BEND, _MOST_BEND), method="bounded")
    return fit(float(best.x))


def contrasts(image: Image, plane: Plane, corners: FloatArray, reach: float) -> FloatArray:
    """Chessboard contrast at corners of squares.

    Args:
        image: (h, w) grey image.
        plane: Pose of the board.
        corners: (n, 2) integer corners on the board.
        reach: Distance from the corner, along both axes, at which its four squares are sampled.

    Returns:
        (n,) lightest minus darkest level that separates the two pairs of opposite squares [grey
        levels]: positive if the squares up left and down right of the corner are light, negative if
        they are dark, 0 if they do not alternate.
    """
    steps = reach * np.array([[-1.0, -1], [1, 1], [1, -1], [-1, 1]])
    levels = plane.levels(image, corners[:, None] + steps)
    first, second = levels[:, :2], levels[:, 2:]
    light = first.min(axis=1) - second.max(axis=1)
    dark = second.min(axis=1) - first.max(axis=1)
    return np.asarray(np.where(light > 0, light, np.where(dark > 0, -dark, 0.0)))


def typical_contrast(values: FloatArray, corners: FloatArray) -> float:
    """Signed median contrast of a board's (n, 2) corners, relative to corner (0, 0)."""
    return float(np.median(values * _signs(corners)))


def alternating(values: FloatArray, corners: FloatArray, typical: float) -> Mask:
    """Mask of (n, 2) corners whose `contrasts` alternate as the board's typical one does."""
    signed = values * _signs(corners) * np.sign(typical)
    return np.asarray(signed > _LEAST_CONTRAST * abs(typical))


def _signs(corners: FloatArray) -> FloatArray:
    """Sign of each corner: the colours alternate from corner to corner."""
    return np.where(corners.sum(axis=1) % 2 == 0, 1.0, -1.0)
