"""AprilGrids: Kalibr's grids of tags with small dark squares at their corners."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target, TargetKind
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.identity import LEAST_MARKERS, Identity, Marker
from visioncal.vision.boards.kind import (
    DEFAULT_RELATIVE_SIGMA,
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
from visioncal.vision.boards.template import Print

# One tag's four corners suffice. Kalibr's pages have tags with borders of two modules, and gaps of
# at most a tag's side, usually this share of it.
_MIN_TAGS, _MOST_SPACING, _MOST_BORDER, _USUAL_SPACING = 1, 1.0, 2, 0.3
# Number of columns that are tried for an unknown board.
_MOST_COLUMNS = 24
# OpenCV detects only tags surrounded by white, but squares touch a tag's corners. The image is grey
# where two dark corners meet: it counts as white if dark has to be darker than its surroundings by
# this many levels, and if the enlarged image has enough grey pixels. The last copy also suits
# images of little contrast.
_DARKER, _LITTLE, _ENLARGED = 25.0, 7.0, 2
# Share of read tags at which their border is as stated.
_MANY = 0.5
# Factor of tags read by which another border is the right one.
_MORE = 1.25
# Minimum number of tags to check a homography.
_LEAST_TAGS = 2
# Half-widths of the windows of corner refinement, as a share of the gap between tags, and bounds
# [px].
_WINDOW, _WINDOWS_PX = 0.35, (2, 6)
_ENDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-2)
# Tolerance of the gap between tags [sides]; minimum number of collinear pairs of sides, and largest
# interquartile range of their gaps.
_SPACING, _LEAST_SPACINGS, _SCATTER = 0.02, 4, 0.05
# Positions along a tag's side, and distance inside it, in its dark border [sides].
_ALONG, _INSIDE = (0.06, 0.35, 0.65, 0.94), 0.06
# An outer line of tags is missing if this share of positions on its near side is light; number of
# lines beside it that predict its position.
_MOST_OF, _NEAR_LINES = 0.8, 2


class AprilGrid(Board):
    """An AprilGrid. Its origin is the outer corner of the tag at the upper left."""

    name: ClassVar[TargetKind] = "aprilgrid"
    keys = "columns rows size_m square_sigma_m spacing dictionary id border"
    size_key = "size_m"
    side, sides = "side of a tag", "tags"
    unit = "side"
    is_seen_in_part = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, size_m, square_sigma_m, spacing, dictionary, id and border."""
        columns, rows = counts_of(table, _MIN_TAGS)
        size_m = size_of(table, "size_m")
        sigma_m = sigma_of(table, size_m)
        spacing = table.number("spacing", positive=True)
        if spacing > _MOST_SPACING:
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
        expected = _MANY * target.columns * target.rows
        ids, px = grid_tags(image, target.dictionary, target.border, expected)
        border = NotFound(
            f"the tags have a border of {3 - target.border} modules, and the target says border = "
            f"{target.border}",
            misfit=True,
        )
        if len(ids) < expected and _has_other_border(image, target, ids):
            return border
        if not len(ids):
            return NotFound(f"no board: no tag of {target.dictionary} is seen")
        numbers = ids - target.marker_id
        own = (numbers >= 0) & (numbers < target.columns * target.rows)
        if own.sum() <= 0.5 * len(own):
            others = ", ".join(map(str, ids[~own][:5].tolist()))
            return NotFound(f"most tags seen ({others}) are none of the target's", misfit=True)
        px, misfit = ordered_tags(target, numbers, px, own)
        if misfit > LAYOUT_MISFIT:
            return NotFound("the tags do not lie as the target describes them", misfit=True)
        size = f"the target's {target.columns} x {target.rows}"
        if not own.all() and layout_misfit(_tag_corners(target, numbers), px) <= LAYOUT_MISFIT:
            return NotFound(f"the grid has tag {ids[~own][0]} besides {size}", misfit=True)
        numbers, px = numbers[own], px[own]
        if lacks_a_line(image, target, numbers, px):
            return NotFound(
                f"the grid ends before {size} tags: an outer line is missing", misfit=True
            )
        if not _has_squares(image, px, target.spacing):
            return NotFound(
                "the tags lack the small dark squares at their corners that an AprilGrid has "
                "(they are a target of kind points)",
                misfit=True,
            )
        px = refined_tags(image, px, target.spacing)
        spacing = measured_spacing(target, numbers, px)
        if abs(spacing - target.spacing) > _SPACING:
            if _has_other_border(image, target, ids):
                return border
            return NotFound(
                f"the tags are {spacing:.2f} of their side apart, and the target says spacing = "
                f"{target.spacing:g}",
                misfit=True,
            )
        return DetectedCorners((4 * numbers[:, None] + np.arange(4)).ravel(), px.reshape(-1, 2))

    def identify(self, image: Image, markers: Sequence[Marker]) -> list[Identity]:
        """Boards of Kalibr's family with borders of one or two modules."""
        del markers
        board = _identified(image)
        return [] if board is None else [board]


APRILGRID = AprilGrid()


# A board of unknown size.
_UNKNOWN = Target(
    "board",
    "aprilgrid",
    1,
    1,
    1.0,
    DEFAULT_RELATIVE_SIGMA,
    dictionary=APRILGRID_DICTIONARY,
    spacing=_USUAL_SPACING,
)


def grid_tags(
    image: Image, dictionary: str, border: int, enough: float
) -> tuple[IntArray, FloatArray]:
    """Tags in a (h, w) grey image whose corners touch dark squares, without ids that appear twice.

    The search stops at `enough` tags.

    Returns:
        (t,) ids, ascending, and (t, 4, 2) corners in OpenCV's order, to one or two pixels [px].
    """
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


def ordered_tags(
    target: Target, numbers: IntArray, px: FloatArray, own: Mask
) -> tuple[FloatArray, float]:
    """Orders the corners of tags as on the page, and measures the layout's misfit.

    Args:
        target: Grid.
        numbers: (t,) tag numbers on the grid.
        px: (t, 4, 2) corners in OpenCV's order [px].
        own: (t,) mask of the tags to use.

    Returns:
        (t, 4, 2) ordered corners, and the misfit of `layout_misfit`; 0 for a single tag.
    """
    # Kalibr's pages have the tags upside down; other orientations are recognised by the layout.
    rotated = [np.roll(px, turn, axis=1) for turn in (2, 0, 1, 3)]
    if own.sum() < _LEAST_TAGS:
        return rotated[0], 0.0
    places = _tag_corners(target, numbers[own])
    misfits = [layout_misfit(places, array[own]) for array in rotated]
    return rotated[int(np.argmin(misfits))], min(misfits)


def _has_other_border(image: Image, target: Target, ids: IntArray) -> bool:
    """Whether many more tags are read with the other border; a wrong one reads some."""
    expected = max(_MORE * len(ids), _MANY * target.columns * target.rows)
    other_ids = grid_tags(image, target.dictionary, 3 - target.border, expected)[0]
    return len(other_ids) >= expected


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
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return np.asarray(first[:, None] + square)


def refined_tags(image: Image, px: FloatArray, spacing: float) -> FloatArray:
    """Refines the (t, 4, 2) corners of tags [px], each a saddle point between two dark squares."""
    sides = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)
    window = int(np.clip(_WINDOW * spacing * sides.min(), *_WINDOWS_PX))
    start = px.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, start.copy(), (window, window), (-1, -1), _ENDS)
    # Without a saddle point the refinement diverges.
    strays = np.linalg.norm(refined - start, axis=2, keepdims=True) > 2 * window
    return np.where(strays, start, refined).reshape(px.shape).astype(float)


def measured_spacing(target: Target, numbers: IntArray, px: FloatArray) -> float:
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
    if len(lines) < _LEAST_SPACINGS:
        return target.spacing
    a, b, c, d = np.moveaxis(np.array(lines), 1, 0)
    far, near = (
        np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        for first, second in ((c - a, d - b), (c - b, d - a))
    )
    quarter, middle, last = np.percentile(np.sqrt(far / np.maximum(far - near, 1e-9)), [25, 50, 75])
    # Scattered corners, as in blurred images, are inconclusive.
    return target.spacing if last - quarter > _SCATTER else float(middle) - 1.0


def lacks_a_line(image: Image, target: Target, numbers: IntArray, px: FloatArray) -> bool:
    """Whether all tags of an outer row or column are missing, and the image shows paper there.

    Dark areas in their place may hide them.
    """
    rows, columns = np.divmod(np.arange(target.columns * target.rows), target.columns)
    # Rows count from below. A missing tag is checked on the side next to the others.
    near, far = _INSIDE, 1.0 - _INSIDE
    lines = (
        (rows, 0, [(value, near) for value in _ALONG]),
        (rows, target.rows - 1, [(value, far) for value in _ALONG]),
        (columns, 0, [(far, value) for value in _ALONG]),
        (columns, target.columns - 1, [(near, value) for value in _ALONG]),
    )
    return any(_lacks_line(image, target, numbers, px, *line) for line in lines)


def _lacks_line(
    image: Image,
    target: Target,
    numbers: IntArray,
    px: FloatArray,
    across: IntArray,
    end: int,
    rim: Sequence[tuple[float, float]],
) -> bool:
    """Whether a line is missing: the tags whose number `across` the grid is `end`."""
    line = np.flatnonzero(across == end)
    # The nearest tags predict the positions despite lens distortion.
    nearby = np.abs(across[numbers] - end) <= _NEAR_LINES
    if np.isin(line, numbers).any() or nearby.sum() < _LEAST_TAGS:
        return False
    on_board = _tag_corners(target, numbers[nearby])
    fit = cv2.findHomography(on_board.reshape(-1, 2), px[nearby].reshape(-1, 2))[0]
    homography = np.asarray(fit, dtype=float)
    if homography.shape != (3, 3):
        return False
    white = 0.5 + (0.5 + target.spacing / 2) * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    dark, light = (
        float(np.nanmedian(_levels(image, on_board[:, 0], array, homography)))
        for array in (np.array(rim), white)
    )
    missing = _levels(image, _tag_corners(target, line)[:, 0], np.array(rim), homography)
    # NaN outside the image compares as not missing.
    return float(np.mean(missing > (dark + light) / 2)) > _MOST_OF


def _levels(
    image: Image, corners: FloatArray, inside: FloatArray, homography: FloatArray
) -> FloatArray:
    """(t, k) grey levels at k offsets from the (t, 2) upper left corners of tags [sides].

    NaN outside the image.
    """
    places = (corners[:, None] + inside).reshape(1, -1, 2)
    px = np.rint(cv2.perspectiveTransform(places, homography)[0])
    shown = ((px >= 0) & (px < image.shape[::-1])).all(axis=1)
    x, y = np.where(shown[:, None], px, 0).astype(int).T
    return np.where(shown, image[y, x].astype(float), np.nan).reshape(len(corners), -1)


def _identified(image: Image) -> Identity | None:
    """Identifies an AprilGrid of Kalibr's family with borders of one or two modules, or None.

    Ids count the tags row by row from the lower left. Each number of columns therefore predicts the
    tags' positions; it is right if a homography maps these to the image.
    """
    read = {border: grid_tags(image, APRILGRID_DICTIONARY, border, np.inf) for border in (2, 1)}
    # With the wrong border a few tags are read at wrong positions.
    border = max(read, key=lambda index: len(read[index][0]))
    ids, px = read[border]
    if len(ids) < LEAST_MARKERS:
        return None
    columns, first = _grid_columns(ids, px)
    if not columns:
        return None
    first += columns * int((ids.min() - first) // columns)
    rows = int((ids.max() - first) // columns) + 1
    target = replace(_UNKNOWN, columns=columns, rows=rows, marker_id=first, border=border)
    numbers, all_tags = ids - first, np.ones(len(ids), bool)
    quads = refined_tags(image, ordered_tags(target, numbers, px, all_tags)[0], _USUAL_SPACING)
    target = replace(target, spacing=round(measured_spacing(target, numbers, quads), 2))
    # Rows below the image are included, as ids start with 0.
    below = replace(target, rows=rows + 1)
    if first and not lacks_a_line(image, below, numbers + columns, quads):
        rows, first = rows + first // columns, first % columns
        target = replace(target, rows=rows, marker_id=first)
    whole = lacks_a_line(image, replace(target, rows=rows + 1), ids - first, quads)
    seen = APRILGRID.search(image, target)
    if not isinstance(seen, DetectedCorners):
        return None
    notes = [
        "The white between its tags is estimated by the image, to a hundredth of their side: "
        "measure it to be sure."
    ]
    if not whole:
        notes.append(f"The board may go on above row {rows}, counted from below.")
    return Identity(
        target,
        whole,
        len(seen.ids),
        4 * columns * rows,
        marker_ids=tuple(ids.tolist()),
        notes=tuple(notes),
    )


def _grid_columns(ids: IntArray, px: FloatArray) -> tuple[int, int]:
    """Number of columns, and an id in the first column; 0 if none fits."""
    all_tags, tried = np.ones(len(ids), bool), range(1, _MOST_COLUMNS + 1)
    # Ids start with 0 unless the tags contradict it.
    for starts in (
        [(count, 0) for count in tried],
        [(count, offset) for count in tried for offset in range(1, count)],
    ):
        misfits = {}
        for columns, first in starts:
            numbers = ids - first + columns * (first > 0)
            rows = int(numbers.max()) // columns + 1
            target = replace(_UNKNOWN, columns=columns, rows=rows)
            misfits[columns, first] = ordered_tags(target, numbers, px, all_tags)[1]
        best = min(misfits, key=lambda key: misfits[key], default=(0, 0))
        if misfits.get(best, np.inf) <= LAYOUT_MISFIT:
            return best
    return 0, 0
