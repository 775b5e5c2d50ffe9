"""AprilGrids: Kalibr's grids of tags with small dark squares at their corners."""

from collections.abc import Iterator, Sequence
from typing import ClassVar

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.gridboard import GridBoard, foreign, marker_grid
from visioncal.vision.boards.kind import COUNTS, MM, Cells, DetectedCorners, NotFound, marker_cells
from visioncal.vision.boards.layout import LAYOUT_MISFIT, layout_misfit, once, read_markers
from visioncal.vision.boards.marker import APRILGRID_DICTIONARY
from visioncal.vision.boards.prints import Print

# OpenCV detects only tags surrounded by white, but squares touch a tag's corners. The image is grey
# where two dark corners meet: it counts as white if dark has to be darker than its surroundings by
# this many levels, and if the enlarged image has enough grey pixels. The last copy also suits
# images of little contrast.
DARKER, _LITTLE, ENLARGED = 25.0, 7.0, 2.0
# Half-widths of the windows of corner refinement, as a share of the gap between tags, and bounds
# [px].
_WINDOW, _WINDOWS_PX = 0.35, (2, 6)


class AprilGrid(GridBoard, Board):
    """An AprilGrid. Its origin is the outer corner of the tag at the upper left."""

    name: ClassVar[str] = "aprilgrid"
    noun = "AprilGrid"
    in_a_word = rf"{COUNTS}_(?P<size_m>{MM})mm_(?P<spacing>0\.[0-9]{{1,9}}|1)"
    side, sides = "side of a tag", "tags"
    usual_dictionary = APRILGRID_DICTIONARY
    usual_place, usual_border = " at the lower left", 2  # Of Kalibr's pages.
    located = Board.find
    has_lone_tags = False

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print, with small squares around the outermost tags, too."""
        side, count = target.square_m, np.array([target.columns, target.rows])
        return np.full(2, -side * target.spacing), side * (count * (1.0 + target.spacing))

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Tags, rotated by a half turn as on Kalibr's pages, and a square at each corner."""
        side, gap = target.square_m, target.square_m * target.spacing
        grids = []
        for number, corner_m in enumerate(self.corners(target)[::4, :2], target.marker_id):
            cells = np.rot90(marker_cells(target.dictionary, number, target.border), 2)
            grids.append(Cells(corner_m, side / len(cells), cells))
        x, y = np.meshgrid(np.arange(target.columns + 1), np.arange(target.rows + 1))
        squares = (side + gap) * np.stack([x, y], axis=-1).reshape(-1, 2) - gap
        return (*grids, *(Cells(square, gap, np.ones((1, 1), bool)) for square in squares))

    def page_places(self, target: Target, numbers: IntArray) -> FloatArray:
        """(t, 2) columns and rows of tags on the page; those outside the grid continue its rows."""
        columns, rows = marker_grid(numbers, target.columns).T
        return np.stack([columns, target.rows - 1 - rows], axis=1)

    def marker_places(self, numbers: IntArray, columns: int) -> Sequence[FloatArray]:
        """Row by row from the lower left, by tags that are upside down or turned otherwise."""
        places = marker_grid(numbers, columns) * np.array([-1.0, 1.0])
        across = places[:, ::-1] * np.array([1.0, -1.0])
        return [places, -places, across, -across]

    def unit_m(self, target: Target) -> float:
        """The gap between tags, within which are a corner's own lines and the next ones."""
        return target.spacing * target.square_m

    def around(self, target: Target, ids: IntArray, squares: FloatArray) -> Print:
        """The print around corners; a tag lies in turn below right, below left, ... of its own."""
        del squares
        modules = len(marker_cells(target.dictionary, target.marker_id, target.border))
        return Print(np.where(ids % 2, -1.0, 1.0), target.border / (modules * target.spacing))

    def search(
        self, image: Image, target: Target, *, quick: bool = False
    ) -> DetectedCorners | NotFound:
        """Corners of the tags in a (h, w) grey image, or why there are none."""
        del quick
        # Share of read tags at which no other copy is searched.
        enough = 0.5 * target.columns * target.rows
        ids, px = _grid_tags(image, target.dictionary, target.border, enough)
        if not len(ids):
            return NotFound(
                f"no board: no tag of {target.dictionary} with a border of {target.border} modules "
                "is seen"
            )
        numbers = ids - target.marker_id
        is_on_grid = (numbers >= 0) & (numbers < target.columns * target.rows)
        if is_on_grid.sum() <= 0.5 * len(is_on_grid):
            return foreign(ids[~is_on_grid].tolist())
        px, misfit = self._ordered(target, numbers, px, is_on_grid)
        if misfit > LAYOUT_MISFIT:
            return NotFound("the tags do not lie as the target describes them", misfit=True)
        size = f"the target's {target.columns} x {target.rows}"
        if (
            not is_on_grid.all()
            and layout_misfit(self.tag_corners(target, numbers), px) <= LAYOUT_MISFIT
        ):
            return NotFound(f"the grid has tag {ids[~is_on_grid][0]} besides {size}", misfit=True)
        numbers, px = numbers[is_on_grid], px[is_on_grid]
        refined = _refined_tags(image, px, target.spacing)
        if why := self.other_spacing(target, self.page_places(target, numbers), refined, image):
            return NotFound(why, misfit=True)
        if not _has_squares(image, px, target.spacing):
            return NotFound(
                "the tags lack the small dark squares at their corners that an AprilGrid has",
                misfit=True,
            )
        ids = (4 * numbers[:, None] + np.arange(4)).ravel()
        return DetectedCorners(ids, refined.reshape(-1, 2))

    def _ordered(
        self, target: Target, numbers: IntArray, px: FloatArray, is_on_grid: Mask
    ) -> tuple[FloatArray, float]:
        """Orders the corners (t, 4, 2) of tags as on the page, and measures the layout's misfit."""
        # Kalibr's pages have the tags upside down; other orientations are recognised by the layout.
        rotated = [np.roll(px, turn, axis=1) for turn in (2, 0, 1, 3)]
        if is_on_grid.sum() < 2:
            return rotated[0], 0.0
        places = self.tag_corners(target, numbers[is_on_grid])
        misfits = [layout_misfit(places, array[is_on_grid]) for array in rotated]
        return rotated[int(np.argmin(misfits))], min(misfits)


def _grid_tags(
    image: Image, dictionary: str, border: int, enough: float
) -> tuple[IntArray, FloatArray]:
    """Ids (t,), ascending, and corners (t, 4, 2) [px] of tags whose corners touch dark squares."""
    corners: dict[int, FloatArray] = {}
    for copy, scale, darker in _copies(image):
        found = read_markers(copy, dictionary, border, darker=darker, scale=scale)
        corners = once(*found) | corners
        if len(corners) >= enough:
            break
    numbers = sorted(corners)
    found_px = np.reshape([corners[number] for number in numbers], (-1, 4, 2))
    return np.array(numbers, dtype=np.int64), found_px


def _copies(image: Image) -> Iterator[tuple[Image, float, float]]:
    """Copies: enlarged; smoothed, against motion; dilated, against spreading ink."""
    yield image, ENLARGED, DARKER
    yield np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8), 1.0, DARKER
    yield np.asarray(cv2.dilate(image, np.ones((3, 3), np.uint8)), np.uint8), 1.0, _LITTLE


def _has_squares(image: Image, px: FloatArray, spacing: float) -> bool:
    """Whether it is dark beyond the corners of tags (t, 4, 2) [px], and white beyond the sides."""
    centre = px.mean(axis=1, keepdims=True)
    sides = (px + np.roll(px, -1, axis=1)) / 2
    inside, outside = 0.9, 1.0 + spacing
    places = [
        centre + inside * (px - centre),
        *(centre + outside * (array - centre) for array in (px, sides)),
    ]
    last_pixel = np.array(image.shape[::-1]) - 1
    pixels = (np.clip(np.rint(place), 0, last_pixel).astype(int) for place in places)
    dark, squares, white = (
        float(np.median(image[pixel[..., 1], pixel[..., 0]])) for pixel in pixels
    )
    return squares < (dark + white) / 2


def _refined_tags(image: Image, px: FloatArray, spacing: float) -> FloatArray:
    """Refines the (t, 4, 2) corners of tags [px], each a saddle point between two dark squares."""
    sides = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)
    window = int(np.clip(_WINDOW * spacing * sides.min(), *_WINDOWS_PX))
    start = px.reshape(-1, 1, 2).astype(np.float32)
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-2)
    refined = cv2.cornerSubPix(image, start.copy(), (window, window), (-1, -1), ends)
    # Without a saddle point the refinement diverges.
    strays = np.linalg.norm(refined - start, axis=2, keepdims=True) > 2 * window
    return np.where(strays, start, refined).reshape(px.shape).astype(float)
