"""Grids of lone markers: OpenCV's GridBoard, which MoveIt prints by default."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards.imaging import blur_at_corners
from visioncal.vision.boards.kind import (
    COUNTS,
    MM,
    BoardKind,
    Cells,
    DetectedCorners,
    NotFound,
    counts_of,
    first_id,
    marker_cells,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.layout import LAYOUT_MARKERS, find_tags, once, read_markers, side_share
from visioncal.vision.boards.marker import APRILGRID_DICTIONARY
from visioncal.vision.boards.template import SQUARE


class GridBoard(BoardKind):
    """A grid of lone markers. Its origin is the outer corner of the marker at the upper left."""

    name: ClassVar[str] = "gridboard"
    noun = "grid of markers"
    options = "--columns --rows --size-mm --spacing --border --dictionary --id --name"
    in_a_word = (
        rf"{COUNTS}_(?P<size_m>{MM})mm_(?P<spacing>[0-9](?:\.[0-9]{{1,9}})?)_"
        r"(?P<dictionary>DICT_\w+)"
    )
    keys = "columns rows size_m square_sigma_m spacing dictionary first_id border"
    size_key = "size_m"
    side, sides = "side of a marker", "markers"
    unit = "side"
    usual_dictionary = usual_place = ""
    usual_border = 1
    has_lone_tags = is_seen_in_part = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, size_m, square_sigma_m, spacing, dictionary, first_id and border."""
        columns, rows = counts_of(table, 1)
        size_m = size_of(table, "size_m")
        sigma_m = sigma_of(table, size_m)
        if "spacing_m" in table.content:
            spacing = table.number("spacing_m", positive=True) / size_m
        else:
            spacing = table.number("spacing", positive=True)
        # Largest gap between markers, as a share of a side.
        if spacing > 4.0:
            raise table.refuse("spacing", spacing, "a share of size_m, such as 0.3")
        dictionary = table.text("dictionary", *filter(None, [self.usual_dictionary]))
        size = f"{columns} x {rows} {self.sides}"
        first = first_id(table, columns * rows, size, dictionary)
        # Most dark modules around bits.
        border = table.integer("border", 1, 2, self.usual_border)
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

    def page_places(self, target: Target, numbers: IntArray) -> FloatArray:
        """(t, 2) columns and rows of tags on the page; those outside the grid continue its rows."""
        return marker_grid(numbers, target.columns)

    def tag_corners(self, target: Target, numbers: IntArray) -> FloatArray:
        """(t, 4, 2) corners of tags, clockwise on the page [sides]."""
        first = self.page_places(target, numbers) * (1.0 + target.spacing)
        return np.asarray(first[:, None] + SQUARE)

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) corners [m], clockwise on the page, marker by marker in the order of their ids."""
        places = self.tag_corners(target, np.arange(target.columns * target.rows)).reshape(-1, 2)
        return np.asarray(target.square_m * np.pad(places, ((0, 0), (0, 1))))

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        numbered = f"{target.dictionary} from id {target.marker_id}"
        return f"{self.noun.removesuffix(' of markers')} of {size} {self.sides}, {numbered}"

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Cells of the markers."""
        corners = self.corners(target)[::4, :2]
        return tuple(
            Cells(corner, target.square_m / len(dark), dark)
            for number, corner in enumerate(corners, target.marker_id)
            for dark in [marker_cells(target.dictionary, number, target.border)]
        )

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        side_mm = 1e3 * target.square_m
        sides = target.columns + (target.columns - 1) * target.spacing
        return (
            f"{self.noun}, {target.columns} x {target.rows} tags of {side_mm:g} mm, "
            f"{target.spacing * side_mm:g} mm apart, {target.dictionary} from id "
            f"{target.marker_id}{self.usual_place}",
            "the upper left corner of the tag at the top left",
            f"Measure over all {target.columns} columns of tags, meant to be "
            f"{sides * side_mm:g} mm; divide by {sides:g} and write the result into size_m, in "
            "metres.",
        )

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested board; Kalibr's where it says nothing."""
        optional = {"first_id": request.marker_id, "border": request.border}
        return super().requested(request, square_mm) | {
            "dictionary": request.dictionary or APRILGRID_DICTIONARY,
            "spacing": 0.3 if request.spacing is None else request.spacing,
            **{key: value for key, value in optional.items() if value is not None},
        }

    def marker_places(self, numbers: IntArray, columns: int) -> Sequence[FloatArray]:
        """Row by row from the upper left."""
        return [marker_grid(numbers, columns)]

    def find(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Corners of the markers in a (h, w) grey image, or why there are none."""
        seen = self.located(image, target)
        if isinstance(seen, DetectedCorners) and (
            why := self.other_spacing(target, *self.whole(target, seen.ids, seen.px))
        ):
            return NotFound(why, misfit=True)
        return seen

    def located(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Corners as `find` gives them, whose refined gaps may be others than stated."""
        numbers = np.arange(target.columns * target.rows)
        ids = numbers + target.marker_id
        seen = once(*read_markers(image, target.dictionary, target.border))
        board_markers = {number: px for number, px in seen.items() if number in ids}
        if 2 * len(board_markers) < len(seen):
            return foreign([number for number in seen if number not in board_markers])
        places = self.page_places(
            target, np.array([*board_markers], dtype=np.int64) - target.marker_id
        )
        px = np.reshape([*board_markers.values()], (-1, 4, 2))
        if why := self.other_spacing(target, places, px, image):
            return NotFound(why, misfit=True)
        corner_ids = dict(zip(ids.tolist(), 4 * numbers[:, None] + np.arange(4), strict=True))
        return find_tags(image, target.dictionary, target.border, corner_ids, self.corners(target))

    def other_spacing(
        self, target: Target, places: FloatArray, px: FloatArray, image: Image | None = None
    ) -> str:
        """Says that tags lie nearer or farther than stated; empty where not.

        Args:
            target: The grid.
            places: (t, 2) columns and rows of the tags.
            px: (t, 4, 2) their corners [px].
            image: Their (h, w) grey image where the corners are a detector's: blur draws these
                inwards by up to its width.
        """
        share, scatter = side_share([places], [px])
        # Scattered corners, as in blurred images, are inconclusive. Differences are in sides.
        if not scatter <= 0.05 * share**2:
            return ""
        side_px = float(np.median(np.linalg.norm(np.diff(px, axis=1), axis=2)))
        off_px = 0.0 if image is None else blur_at_corners(image, px.reshape(-1, 2))
        off = 0.02 + 2.0 * (1.0 + target.spacing) * off_px / side_px
        if abs(1.0 / share - 1.0 - target.spacing) <= off:
            return ""
        # No print has gaps of so small a share: they are metres. Detectors need this share of a
        # side between markers.
        unit = ", which looks like metres" if target.spacing < 0.04 else ""
        return (
            f"the tags are {1.0 / share - 1.0:.2f} of their side apart, and the target says "
            f"spacing = {target.spacing:g}{unit}"
        )

    def whole(self, target: Target, ids: IntArray, px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(t, 2) columns and rows of tags that are seen whole, and their (t, 4, 2) corners [px]."""
        order = np.argsort(ids, kind="stable")
        ids, px = ids[order], px[order]
        numbers, counts = np.unique(ids // 4, return_counts=True)
        of_whole = np.isin(ids // 4, numbers[counts == 4])
        return self.page_places(target, numbers[counts == 4]), px[of_whole].reshape(-1, 4, 2)

    def otherwise(
        self, target: Target, ids: Sequence[IntArray], px: Sequence[FloatArray]
    ) -> dict[str, object]:
        """Another spacing, by the gaps between neighbours that are seen whole."""
        seen = [self.whole(target, *view) for view in zip(ids, px, strict=True)]
        share, scatter = side_share(*zip(*seen, strict=True))
        spacing = 1.0 / share - 1.0
        # A print's gaps are true to a hundredth of a side, unless corners scatter by more.
        is_other = abs(spacing - target.spacing) > max(0.01, scatter)
        return {"spacing": round(spacing, 2)} if is_other else {}


def foreign(others: Sequence[int]) -> NotFound:
    """Says that most markers seen, these, are none of a target's; a few are read by chance."""
    some = ", ".join(map(str, others[:5]))
    return NotFound(
        f"most tags seen ({some}) are none of the target's", misfit=len(others) >= LAYOUT_MARKERS
    )


def marker_grid(numbers: IntArray, columns: int) -> FloatArray:
    """(n, 2) columns and rows of markers that are numbered row by row."""
    return np.stack([numbers % columns, numbers // columns], axis=1).astype(float)
