"""Single ArUco or AprilTag markers."""

from typing import Any, ClassVar

import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards.board import DETECTED_WEIGHT
from visioncal.vision.boards.kind import (
    MM,
    BoardKind,
    Cells,
    DetectedCorners,
    NotFound,
    aruco_dictionary,
    dictionary_size,
    marker_cells,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.layout import read_markers
from visioncal.vision.boards.template import SQUARE, refine_tags

# Dictionary of Kalibr's pages, which is the usual one of tags.
APRILGRID_DICTIONARY = "DICT_APRILTAG_36h11"


class MarkerKind(BoardKind):
    """A single marker. Its origin is its centre."""

    name: ClassVar[str] = "marker"
    noun = "marker"
    options = "--id --size-mm --dictionary --name"
    in_a_word = rf"(?P<dictionary>DICT_\w+)_(?P<id>[0-9]{{1,5}})_(?P<size_m>{MM})mm"
    keys = "id size_m square_sigma_m dictionary"
    size_key = "size_m"
    side, sides = "side of the dark square", "a side"
    unit = "side"
    has_lone_tags = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads size_m, square_sigma_m, dictionary and id."""
        size_m = size_of(table, "size_m")
        sigma_m = sigma_of(table, size_m)
        dictionary = table.text("dictionary")
        number = table.integer("id", 0, dictionary_size(table, dictionary) - 1)
        return Target(
            name, self.name, 1, 1, size_m, sigma_m, dictionary=dictionary, marker_id=number
        )

    def corners(self, target: Target) -> FloatArray:
        """(4, 3) corners [m], clockwise from its upper left."""
        return target.square_m * np.pad(SQUARE - 0.5, ((0, 0), (0, 1)))

    def words(self, target: Target, size: str) -> str:
        """The marker in a few words."""
        del size
        return f"marker {target.marker_id} of {target.dictionary}"

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Modules of the marker."""
        dark = marker_cells(target.dictionary, target.marker_id)
        side = target.square_m
        return (Cells(np.full(2, -0.5 * side), side / len(dark), dark),)

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        return (
            f"{self.words(target, '')}, {1e3 * target.square_m:g} mm a side",
            "the marker's centre",
            "Measure the dark square's side and write it into size_m, in metres.",
        )

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested marker."""
        document = super().requested(request, square_mm)
        document |= {"dictionary": request.dictionary or APRILGRID_DICTIONARY}
        return document | ({} if request.marker_id is None else {"id": request.marker_id})

    def file_name(self, target: Target, side: str) -> str:
        """Name of a marker with sides of `side`."""
        family = target.dictionary.removeprefix("DICT_").lower()
        family = family if family.startswith("a") else f"aruco_{family}"
        return f"{family}_id{target.marker_id}_{side}"

    def find(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Corners of the marker in a (h, w) grey image, or why there are none.

        OpenCV's corners (Garrido-Jurado et al. 2014) are biased inwards by blur. They are refined
        by the template of `refine_tags`; a corner that it does not fit remains OpenCV's, with less
        weight.
        """
        ids, px = read_markers(image, target.dictionary, refined=True)
        if target.marker_id not in ids:
            seen = f"; seen instead: {', '.join(map(str, ids[:5]))}" if ids else ""
            return NotFound(f"no marker {target.marker_id} of {target.dictionary} is seen{seen}")
        if ids.count(target.marker_id) > 1:
            return NotFound(
                f"marker {target.marker_id} is seen {ids.count(target.marker_id)} times"
            )
        corners = px[ids.index(target.marker_id)]
        count = int(aruco_dictionary(target.dictionary).markerSize) + 2
        refined = refine_tags(image, count, corners[None])
        # OpenCV's corners err by so much, due to rounding by blur.
        fitted = refined.sigma_px < 0.2
        weights = None if fitted.all() else np.where(fitted, 1.0, DETECTED_WEIGHT)
        return DetectedCorners(
            np.arange(4), np.where(fitted[:, None], refined.px, corners), weights
        )
