"""Boards whose corners a template refines, found by quick searches where these suffice."""

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import cv2
import numpy as np

from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.imaging import blur_at_corners, resized, shrunk
from visioncal.vision.boards.kind import BoardKind, DetectedCorners, NotFound
from visioncal.vision.boards.prints import Print
from visioncal.vision.boards.template import Refined, refine
from visioncal.vision.poses import FEWEST_CORNERS

# Corners that the template does not fit are dropped, as detectors err there by up to a pixel. If
# too few fit, all corners of the detector are used, with a tenth of the weight: their accuracy
# relative to the template's in the median.
DETECTED_WEIGHT = 0.1
# Squares up to this side may have markers that are read in a larger copy alone: of three pixels a
# module and less [px].
_SMALL_PX = 30.0
# From a corner through the squares around it [sides].
_DIAGONALS = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])


class Board(BoardKind):
    """A kind of board, refined by the template."""

    # Images with longer sides are searched at half size first, and above twice that at a quarter:
    # detection time is proportional to pixels [px].
    long_side_px: ClassVar[int] = 2000
    # Whether there is a search that takes a third of the time and detects less.
    has_quick_search: ClassVar[bool] = False
    # Whether a small board is searched in an enlarged image, too, as its markers have to be read.
    is_enlarged: ClassVar[bool] = False

    @abstractmethod
    def search(
        self, image: Image, target: Target, *, quick: bool = False
    ) -> DetectedCorners | NotFound:
        """Detects corners in a (h, w) grey image, to about a pixel, or says why there are none."""

    @abstractmethod
    def around(self, target: Target, ids: IntArray, squares: FloatArray) -> Print:
        """The print around corners at (n, 2) `squares`, in units of `unit_m`."""

    def unit_m(self, target: Target) -> float:
        """Length that is one in the template [m]."""
        return target.square_m

    def refine(self, image: Image, target: Target, ids: IntArray, px: FloatArray) -> Refined:
        """Refines (n, 2) detected corners [px] with these (n,) ids by the template."""
        squares = self.corners(target)[ids, :2] / self.unit_m(target)
        return refine(image, self.around(target, ids, squares), squares, px)

    def find(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Corners by a quick search, or in a reduced copy if that finds all that are shown."""
        sides = max(image.shape), min(image.shape)
        factors = [by for by in (4, 2) if sides[0] > by // 2 * self.long_side_px and sides[1] >= by]
        for factor in [*factors, 1] if self.has_quick_search else factors:
            small = image if factor == 1 else shrunk(image, factor)
            seen = self.search(small, target, quick=self.has_quick_search)
            if isinstance(seen, DetectedCorners) and self._is_all(small, target, seen):
                # From pixel centres of the small image to those of the large one.
                px = factor * seen.px + (factor - 1) / 2
                refined = self._refined(image, target, DetectedCorners(seen.ids, px))
                if refined.weights is None:
                    return refined
        seen = self.search(image, target)
        if self.is_enlarged and sides[0] <= self.long_side_px and sides[1] > 1:
            seen = self._larger(image, target, seen)
        return seen if isinstance(seen, NotFound) else self._refined(image, target, seen)

    def _larger(
        self, image: Image, target: Target, seen: DetectedCorners | NotFound
    ) -> DetectedCorners | NotFound:
        """Corners of an enlarged image, where these are more than were seen of a small board.

        Most markers with modules of two pixels are read so, and fewer than half as they are.
        """
        count = 0
        if isinstance(seen, DetectedCorners):
            count = len(seen.ids)
            away = np.linalg.norm(seen.px[:, None] - seen.px, axis=2) + np.diag([np.inf] * count)
            is_large = count > 1 and np.median(away.min(axis=1)) > _SMALL_PX
            if is_large or self._is_all(image, target, seen):
                return seen
        elif seen.misfit:
            return seen
        by = min(3.0, 2.0 * self.long_side_px / max(image.shape))
        larger = self.search(resized(image, by), target)
        if isinstance(larger, NotFound) or len(larger.ids) <= count:
            return seen
        return DetectedCorners(larger.ids, (larger.px + 0.5) / by - 0.5)

    def _is_all(self, image: Image, target: Target, seen: DetectedCorners) -> bool:
        """Whether these are all corners that the (h, w) image shows, of a board that it may cut."""
        board = self.corners(target)[:, :2]
        missing = np.delete(np.arange(len(board)), seen.ids)
        if not missing.size or len(seen.ids) < max(FEWEST_CORNERS, len(missing)):
            return not missing.size
        px_from_board = np.asarray(cv2.findHomography(board[seen.ids], seen.px)[0], float)
        if px_from_board.shape != (3, 3):
            return False
        # One that is not shown has a part of the squares around it outside.
        around = board[missing, None] + self.unit_m(target) * _DIAGONALS
        px = cv2.perspectiveTransform(around.reshape(1, -1, 2), px_from_board)
        inside = ((px > 0) & (px < np.array(image.shape[::-1]) - 1.0)).all(axis=2)
        return not inside.reshape(-1, len(_DIAGONALS)).all(axis=1).any()

    def _refined(self, image: Image, target: Target, seen: DetectedCorners) -> DetectedCorners:
        refined = self.refine(image, target, seen.ids, seen.px)
        fitted = refined.fitted
        if fitted.sum() < max(min(6, len(fitted)), 0.5 * len(fitted)):
            return replace(seen, weights=np.full(len(fitted), DETECTED_WEIGHT))
        px, blur_px = refined.px[fitted], float(refined.blur_px.max())
        if refined.blur_px.min() > MAX_BLUR_PX:
            # A print of another size passes for blur; motion widens one direction only.
            sharp_px = blur_at_corners(image, px, reaches=0.5)
            blur_px = sharp_px if sharp_px < 0.5 * blur_px else blur_px
        drawn_m = target.diameter_m + 2.0 * refined.grown * self.unit_m(target)
        drawn = drawn_m if target.diameter_m else None
        return DetectedCorners(seen.ids[fitted], px, blur_px=blur_px, drawn_m=drawn)
