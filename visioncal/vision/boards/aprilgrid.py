"""AprilGrids: Kalibr's grids of tags with small dark squares at their corners."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.kind import (
    COUNTS,
    MM,
    BoardRequest,
    Cells,
    DetectedCorners,
    NotFound,
    counts_of,
    dictionary_size,
    marker_cells,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.layout import LAYOUT_MISFIT, layout_misfit, read_markers
from visioncal.vision.boards.marker import APRILGRID_DICTIONARY
from visioncal.vision.boards.template import SQUARE, Print

# Kalibr's pages have tags with borders of two modules, and usually gaps of this share of a side.
_MOST_BORDER, _USUAL_SPACING = 2, 0.3
# OpenCV detects only tags surrounded by white, but squares touch a tag's corners. The image is grey
# where two dark corners meet: it counts as white if dark has to be darker than its surroundings by
# this many levels, and if the enlarged image has enough grey pixels. The last copy also suits
# images of little contrast.
_DARKER, _LITTLE, _ENLARGED = 25.0, 7.0, 2
# Half-widths of the windows of corner refinement, as a share of the gap between tags, and bounds
# [px].
_WINDOW, _WINDOWS_PX = 0.35, (2, 6)
_ENDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-2)


class AprilGrid(Board):
    """An AprilGrid. Its origin is the outer corner of the tag at the upper left."""

    name: ClassVar[str] = "aprilgrid"
    noun = "AprilGrid"
    options = "--columns --rows --size-mm --spacing --border --dictionary --id --name"
    in_a_word = rf"{COUNTS}_(?P<size_m>{MM})mm_(?P<spacing>0\.[0-9]{{1,9}}|1)"
    keys = "columns rows size_m square_sigma_m spacing dictionary id border"
    size_key = "size_m"
    side, sides = "side of a tag", "tags"
    unit = "side"
    is_seen_in_part = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, size_m, square_sigma_m, spacing, dictionary, id and border."""
        columns, rows = counts_of(table, 1)
        size_m = size_of(table, "size_m")
        sigma_m = sigma_of(table, size_m)
        spacing = table.number("spacing", positive=True)
        # Kalibr's pages have gaps of at most a tag's side.
        if spacing > 1.0:
            raise table.refuse("spacing", spacing, "a share of size_m, such as 0.3,")
        dictionary = table.text("dictionary", APRILGRID_DICTIONARY)
        markers = dictionary_size(table, dictionary)
        first = table.integer("id", 0, markers - 1, 0)
        if first + columns * rows > markers:
            raise DataError(
                f"{table.label}: dictionary {dictionary} has {markers} tags; {columns} x {rows} "
                f"tags from id {first} on need {first + columns * rows}.",
                culprits=[f"{table.label}: columns"],
            )
        border = table.integer("border", 1, _MOST_BORDER, _MOST_BORDER)
        return Target(
            name,
            self.name,
            columns,
            rows,
            size_m,
            sigma_m,
            dictionary=dictionary,
            marker_id=first,
            spacing=spacing,
            border=border,
        )

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) corners [m], clockwise on the page, tag by tag in the order of their ids."""
        places = _tag_corners(target, np.arange(target.columns * target.rows)).reshape(-1, 2)
        return np.asarray(target.square_m * np.pad(places, ((0, 0), (0, 1))))

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        return f"AprilGrid of {size} tags, {target.dictionary} from id {target.marker_id}"

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

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """What a printed sheet says of it."""
        side_mm, sides = (
            1e3 * target.square_m,
            target.columns + (target.columns - 1) * target.spacing,
        )
        return (
            f"AprilGrid, {target.columns} x {target.rows} tags of {side_mm:g} mm, "
            f"{target.spacing * side_mm:g} mm apart, {target.dictionary} from id "
            f"{target.marker_id} at the lower left",
            "the upper left corner of the tag at the top left",
            f"Measure over all {target.columns} columns of tags, meant to be "
            f"{sides * side_mm:g} mm; divide by {sides:g} and write the result into size_m, in "
            "metres.",
        )

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested board; Kalibr's where it says nothing."""
        optional = {"id": request.marker_id, "border": request.border}
        return super().requested(request, square_mm) | {
            "dictionary": request.dictionary or APRILGRID_DICTIONARY,
            "spacing": _USUAL_SPACING if request.spacing is None else request.spacing,
            **{key: value for key, value in optional.items() if value is not None},
        }

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
        own = (numbers >= 0) & (numbers < target.columns * target.rows)
        if own.sum() <= 0.5 * len(own):
            others = ", ".join(map(str, ids[~own][:5].tolist()))
            return NotFound(f"most tags seen ({others}) are none of the target's", misfit=True)
        px, misfit = _ordered_tags(target, numbers, px, own)
        if misfit > LAYOUT_MISFIT:
            return NotFound("the tags do not lie as the target describes them", misfit=True)
        size = f"the target's {target.columns} x {target.rows}"
        if not own.all() and layout_misfit(_tag_corners(target, numbers), px) <= LAYOUT_MISFIT:
            return NotFound(f"the grid has tag {ids[~own][0]} besides {size}", misfit=True)
        numbers, px = numbers[own], px[own]
        if not _has_squares(image, px, target.spacing):
            return NotFound(
                "the tags lack the small dark squares at their corners that an AprilGrid has "
                "(they are a target of kind points)",
                misfit=True,
            )
        px = _refined_tags(image, px, target.spacing)
        spacing = _measured_spacing(target, numbers, px)
        # Shares of a side.
        if abs(spacing - target.spacing) > 0.02:
            return NotFound(
                f"the tags are {spacing:.2f} of their side apart, and the target says spacing = "
                f"{target.spacing:g}",
                misfit=True,
            )
        return DetectedCorners((4 * numbers[:, None] + np.arange(4)).ravel(), px.reshape(-1, 2))


def _grid_tags(
    image: Image, dictionary: str, border: int, enough: float
) -> tuple[IntArray, FloatArray]:
    """Ids (t,), ascending, and corners (t, 4, 2) [px] of tags whose corners touch dark squares."""
    corners: dict[int, FloatArray] = {}
    for copy in _copies(image):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        parameters.adaptiveThreshConstant = copy.darker
        found_ids, px = read_markers(copy.image, dictionary, parameters)
        # From pixel centres of the copy to those of the image.
        quads = (px + 0.5) / copy.scale - 0.5
        unique = {
            index: quad
            for index, quad in zip(found_ids, quads, strict=True)
            if found_ids.count(index) == 1
        }
        corners = unique | corners
        if len(corners) >= enough:
            break
    numbers = sorted(corners)
    found_px = np.reshape([corners[number] for number in numbers], (-1, 4, 2))
    return np.array(numbers, dtype=np.int64), found_px


@dataclass(frozen=True, eq=False)
class _Copy:
    """A processed copy of an image, its scale, and the threshold below its surroundings."""

    image: Image
    scale: float
    darker: float


def _copies(image: Image) -> Iterator[_Copy]:
    """Copies: enlarged; smoothed, against motion; dilated, against spreading ink."""
    large = cv2.resize(image, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC)
    yield _Copy(np.asarray(large, np.uint8), _ENLARGED, _DARKER)
    yield _Copy(np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8), 1.0, _DARKER)
    yield _Copy(np.asarray(cv2.dilate(image, np.ones((3, 3), np.uint8)), np.uint8), 1.0, _LITTLE)


def _ordered_tags(
    target: Target, numbers: IntArray, px: FloatArray, own: Mask
) -> tuple[FloatArray, float]:
    """Orders the corners (t, 4, 2) of tags as on the page, and measures the layout's misfit."""
    # Kalibr's pages have the tags upside down; other orientations are recognised by the layout.
    rotated = [np.roll(px, turn, axis=1) for turn in (2, 0, 1, 3)]
    if own.sum() < 2:
        return rotated[0], 0.0
    places = _tag_corners(target, numbers[own])
    misfits = [layout_misfit(places, array[own]) for array in rotated]
    return rotated[int(np.argmin(misfits))], min(misfits)


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


def _tag_corners(target: Target, numbers: IntArray) -> FloatArray:
    """(t, 4, 2) corners of tags [sides]; numbers outside the grid continue its rows."""
    rows, columns = np.divmod(numbers, target.columns)
    first = np.stack([columns, target.rows - 1 - rows], axis=1) * (1.0 + target.spacing)
    return np.asarray(first[:, None] + SQUARE)


def _refined_tags(image: Image, px: FloatArray, spacing: float) -> FloatArray:
    """Refines the (t, 4, 2) corners of tags [px], each a saddle point between two dark squares."""
    sides = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)
    window = int(np.clip(_WINDOW * spacing * sides.min(), *_WINDOWS_PX))
    start = px.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, start.copy(), (window, window), (-1, -1), _ENDS)
    # Without a saddle point the refinement diverges.
    strays = np.linalg.norm(refined - start, axis=2, keepdims=True) > 2 * window
    return np.where(strays, start, refined).reshape(px.shape).astype(float)


def _measured_spacing(target: Target, numbers: IntArray, px: FloatArray) -> float:
    """Measured gap between tags [sides]; the stated one if too few tags are adjacent.

    Four corners of two collinear tags lie at 0, 1, 1 + s and 2 + s. Their cross-ratio (AC BD) / (BC
    AD) = (1 + s)^2 / (s (2 + s)) is invariant under projection, and almost under lens distortion.
    """
    index = {number: place for place, number in enumerate(numbers.tolist())}
    lines: list[FloatArray] = []
    for number, place in index.items():
        right = number + 1 if (number + 1) % target.columns else -1
        for neighbour, sides in (
            (right, [[0, 1], [3, 2]]),
            (number + target.columns, [[3, 0], [2, 1]]),
        ):
            if neighbour in index:
                lines += [
                    np.concatenate([px[place][side], px[index[neighbour]][side]]) for side in sides
                ]
    if len(lines) < 4:
        return target.spacing
    a, b, c, d = np.moveaxis(np.array(lines), 1, 0)
    far, near = (
        np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        for first, second in ((c - a, d - b), (c - b, d - a))
    )
    quarter, middle, last = np.percentile(np.sqrt(far / np.maximum(far - near, 1e-9)), [25, 50, 75])
    # Scattered corners, as in blurred images, are inconclusive.
    return target.spacing if last - quarter > 0.05 else float(middle) - 1.0
