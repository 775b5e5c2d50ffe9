"""A flat board seen through a bending lens: a homography and one coefficient of distortion.

The division model (Fitzgibbon 2001) needs no focal length: a pixel at distance r from the image's
middle belongs at r / (1 + bend r^2). It follows wide and fisheye lenses far enough for counting.

On it, a chessboard's corners, where dark and light squares meet, are told from what lies near.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from visioncal.core.types import FloatArray, Image, Mask

# In units of half the image's diagonal: from none to a fisheye lens of 150 degrees.
BENDS = (0.0, -0.1, -0.25, -0.45)
_LEAST_BEND, _MOST_BEND = -0.8, 0.3
# A homography takes four points; fewer than eight say nothing of a bend.
_LEAST_POINTS, _LEAST_FOR_BEND = 4, 8
# So near the image's edge nothing can be concluded [px].
_BORDER_PX = 3.0
# The weaker pair of opposite squares must differ from the other by this share of the contrast that
# a board's corners have.
_LEAST_CONTRAST = 0.4


@dataclass(frozen=True)
class Lens:
    """The image's distortion.

    Attributes:
        middle: The image's middle (x, y) [px].
        radius: Half its diagonal [px].
        bend: The coefficient; negative where straight lines bulge outwards.
    """

    middle: tuple[float, float]
    radius: float
    bend: float

    def straighten(self, px: FloatArray) -> FloatArray:
        """Carries (n, 2) pixels to where a lens without distortion would show them."""
        offset = (px - np.array(self.middle)) / self.radius
        return np.asarray(offset / (1.0 + self.bend * (offset**2).sum(axis=1, keepdims=True)))

    def distort(self, straight: FloatArray) -> FloatArray:
        """Carries (n, 2) straightened points back to pixels."""
        square = np.maximum(1.0 - 4.0 * self.bend * (straight**2).sum(axis=1, keepdims=True), 0.0)
        offset = 2.0 * straight / (1.0 + np.sqrt(square))
        return np.asarray(np.array(self.middle) + self.radius * offset)


@dataclass(frozen=True, eq=False)
class Plane:
    """How a board lies in an image.

    Attributes:
        lens: The distortion.
        straight_from_board: (3, 3) homography from the board, in squares, to straightened points.
    """

    lens: Lens
    straight_from_board: FloatArray

    def to_px(self, places: FloatArray) -> FloatArray:
        """Carries (n, 2) places on the board, in squares, to pixels."""
        straight = cv2.perspectiveTransform(places.reshape(-1, 1, 2), self.straight_from_board)
        return self.lens.distort(np.asarray(straight, dtype=float)[:, 0])

    def to_board(self, px: FloatArray) -> FloatArray:
        """Carries (n, 2) pixels to the board, in squares."""
        straight = self.lens.straighten(px)
        board_from_straight = np.linalg.inv(self.straight_from_board)
        places = cv2.perspectiveTransform(straight[:, None], board_from_straight)
        return np.asarray(places, dtype=float)[:, 0]

    def shows(self, image: Image, places: FloatArray) -> Mask:
        """Tells which (n, 2) places on the board, in squares, are in the image."""
        # Behind the camera the homography's denominator has another sign than at the origin.
        depth = places @ self.straight_from_board[2, :2] + self.straight_from_board[2, 2]
        px = self.to_px(places)
        size = np.array(image.shape[::-1])
        seen = ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all(axis=1)
        return np.asarray(seen & (depth * self.straight_from_board[2, 2] > 0))

    def levels(self, image: Image, places: FloatArray) -> FloatArray:
        """Grey levels of the image at (m, n, 2) places on the board, in squares; (m, n)."""
        px = self.to_px(places.reshape(-1, 2)).reshape(places.shape).astype(np.float32)
        levels = cv2.remap(
            image, px[..., 0], px[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(levels, dtype=float)


def lens_of(image: Image, bend: float) -> Lens:
    """A lens whose middle is that of the image."""
    height, width = image.shape
    return Lens(((width - 1) / 2, (height - 1) / 2), float(np.hypot(width, height)) / 2, bend)


def robust_plane(
    lens: Lens, board: FloatArray, px: FloatArray, tolerance_px: float
) -> tuple[Plane, Mask] | None:
    """Fits a plane to points of which some are wrong (RANSAC; Fischler and Bolles 1981).

    Args:
        lens: The distortion.
        board: (n, 2) places on the board, in squares.
        px: (n, 2) pixels.
        tolerance_px: How far a right point may be off [px].

    Returns:
        The plane, and which points agree with it; None where there is none.
    """
    if len(board) < _LEAST_POINTS:
        return None
    found, mask = cv2.findHomography(
        board,
        lens.straighten(px),
        cv2.RANSAC,
        tolerance_px / lens.radius,
        maxIters=200,
        confidence=0.99,
    )
    if found is None or np.shape(found) != (3, 3) or np.linalg.matrix_rank(found) < 3:
        return None
    return Plane(lens, np.asarray(found, dtype=float)), np.ravel(mask) > 0


def bent_plane(plane: Plane, board: FloatArray, px: FloatArray) -> Plane:
    """Fits the distortion too, to (n, 2) points that are right."""
    if len(board) < _LEAST_FOR_BEND:
        return plane

    def fitted(bend: float) -> Plane:
        lens = Lens(plane.lens.middle, plane.lens.radius, bend)
        found, _ = cv2.findHomography(board, lens.straighten(px))
        usable = found is not None and np.linalg.matrix_rank(found) == len(found)
        return Plane(lens, np.asarray(found, dtype=float)) if usable else plane

    def misfit(bend: float) -> float:
        return float(np.sum((fitted(bend).to_px(board) - px) ** 2))

    best = minimize_scalar(misfit, bounds=(_LEAST_BEND, _MOST_BEND), method="bounded")
    return fitted(float(best.x))


def contrasts(image: Image, plane: Plane, corners: FloatArray, reach: float) -> FloatArray:
    """Measures how much corners of squares look like corners of a chessboard.

    Args:
        image: (h, w) grey image.
        plane: How the board lies.
        corners: (n, 2) whole numbers: corners on the board.
        reach: How far from the corner, along both axes, its four squares are looked at.

    Returns:
        (n,) the least light less the greatest dark of the four squares [grey levels], positive
        where the squares up left and down right of the corner are light; negative by as much where
        they are dark; 0 where they do not alternate.
    """
    steps = reach * np.array([[-1.0, -1], [1, 1], [1, -1], [-1, 1]])
    levels = plane.levels(image, corners[:, None] + steps)
    first, second = levels[:, :2], levels[:, 2:]
    light = first.min(axis=1) - second.max(axis=1)
    dark = second.min(axis=1) - first.max(axis=1)
    return np.asarray(np.where(light > 0, light, np.where(dark > 0, -dark, 0.0)))


def typical_contrast(values: FloatArray, corners: FloatArray) -> float:
    """The contrast of a board's (n, 2) corners, as it would be at corner (0, 0): signed."""
    return float(np.median(values * _signs(corners)))


def alternating(values: FloatArray, corners: FloatArray, typical: float) -> Mask:
    """Tells which corners alternate as those of the board do.

    Args:
        values: (n,) what `contrasts` gave.
        corners: (n, 2) the corners.
        typical: What `typical_contrast` gave for corners of the board.
    """
    signed = values * _signs(corners) * np.sign(typical)
    return np.asarray(signed > _LEAST_CONTRAST * abs(typical))


def _signs(corners: FloatArray) -> FloatArray:
    """The colours alternate from corner to corner."""
    return np.where(corners.sum(axis=1) % 2 == 0, 1.0, -1.0)
