"""A kind of target: one class in one file, which reads, places, draws, finds and identifies it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.files import is_inside
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards.template import Refined, unrefined

# Relative sigma of a square by default: the scale error of office printers.
DEFAULT_RELATIVE_SIGMA = 1e-3
# Smallest sigma, even for squares etched in glass.
LEAST_SIGMA_M = 1e-8
# Largest printed square [m]. Larger numbers are in millimetres, those up to the second limit in
# centimetres or inches, as no square of so few millimetres is printed.
LARGEST_M, _LARGEST_IN_CM = 1.0, 4.0
# Smallest side that can be measured to 0.1 % [mm].
_SMALLEST_MM = 0.1
# Fewer squares do not determine a pose robustly; more do not fit a printable board.
FEWEST_SQUARES, MOST_SQUARES = 3, 100
# Counts and lengths [mm] in a description of one word.
COUNTS = "(?P<columns>[0-9]{1,3})x(?P<rows>[0-9]{1,3})"
MM = r"[0-9]{1,5}(?:\.[0-9]{1,9})?"
# Fields of targets with other names than their keys.
_FIELDS = {"id": "marker_id", "first_id": "marker_id", "size_m": "square_m"}


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Detected corners."""

    ids: IntArray  # (n,) corner ids, ascending.
    px: FloatArray  # (n, 2) positions [px].
    # (n,) accuracy relative to the usual one, as the ratio of standard deviations; None if all are
    # usual.
    weights: FloatArray | None = None
    # Edge width as a Gaussian's sigma, in the direction of the wider edges [px]; None if not
    # measured.
    blur_px: float | None = None
    drawn_m: float | None = None  # Diameter of circles in the image, by their distances.


@dataclass(frozen=True)
class NotFound:
    """Why the target was not found, in words; `misfit` if another layout was seen instead."""

    reason: str
    misfit: bool = False


@dataclass(frozen=True, eq=False)
class Cells:
    """A grid of dark and light cells."""

    corner_m: FloatArray  # (2,) outer corner of the first cell in the target's frame [m].
    cell_m: float  # Side of a cell [m].
    dark: Mask  # (rows, columns) mask of dark cells.
    # (2, 2) rotation, with the directions of the grid's columns and rows as columns.
    turn: FloatArray = field(default_factory=lambda: np.eye(2))


class BoardKind(ABC):
    """A kind of target. Its instance has no state: everything is in the `Target`."""

    name: ClassVar[str]
    # Keys of its description besides `kind`; the one of its size, what that is, and what has it.
    keys: ClassVar[str] = "columns rows square_m square_sigma_m"
    size_key: ClassVar[str] = "square_m"
    side: ClassVar[str] = "side of a square"
    sides: ClassVar[str] = "squares"
    unit: ClassVar[str] = "square"  # The part that is made smaller where it does not fit on a page.
    noun: ClassVar[str] = "board"  # Its noun before its name.
    # Options of `target make` that describe it; empty where it cannot be made by options.
    options: ClassVar[str] = ""
    # Pattern of its description in one word, after its name and _, with keys as groups; empty
    # without one.
    in_a_word: ClassVar[str] = ""
    # Whether some of its corners can be detected without the others.
    is_seen_in_part: ClassVar[bool] = False
    # Whether tags stand alone, and need white around them that is as wide as one module.
    has_lone_tags: ClassVar[bool] = False
    fewest: ClassVar[int] = 6  # Corners that a view needs, or all of fewer.
    # Whether its squares alternate over the whole board, for the fit to all pixels.
    is_dense: ClassVar[bool] = False
    # The part that a turn must map to itself to leave the print as it was; empty for none.
    symmetric: ClassVar[Literal["", "squares", "places"]] = ""

    @abstractmethod
    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads the description of a target; raises DataError."""

    @abstractmethod
    def corners(self, target: Target) -> FloatArray:
        """(n, 3) corners in the target's frame [m], by id."""

    @abstractmethod
    def words(self, target: Target, size: str) -> str:
        """The target in a few words, with its columns and rows as `size`."""

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Dark areas; those of two grids share at most a point; raises DataError."""
        del target
        return ()

    @abstractmethod
    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet: its name, the origin's place, how to measure its size."""

    @abstractmethod
    def find(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Finds the corners in a (h, w) grey image; see `find_target`."""

    def refine(self, image: Image, target: Target, ids: IntArray, px: FloatArray) -> Refined:
        """Refines (n, 2) detected corners [px] with these (n,) ids by the template."""
        del image, target, ids
        return unrefined(px)

    def document(self, target: Target) -> dict[str, Any]:
        """The target as the content of a `.toml` that `read` can read."""
        return {key: getattr(target, _FIELDS.get(key, key)) for key in self.keys.split()}

    def loaded(self, document: dict[str, Any], folder: Path) -> dict[str, Any]:
        """The content of its `.toml` with that of the tables that it names, from its folder."""
        del folder
        return document

    def stored(
        self, document: Mapping[str, Any], stem: str
    ) -> tuple[Mapping[str, Any], dict[str, str | bytes]]:
        """The inverse of `loaded`: the content of `STEM.toml`, and its other files by name."""
        del stem
        return document, {}

    def picture(self, target: Target) -> Image | None:
        """(h, w) grey levels over its extent, where it has no cells and discs."""
        del target
        return None

    def scaled(self, target: Target, factor: float) -> Target:
        """A board whose printed sizes are larger by a factor."""
        return replace(
            target,
            square_m=factor * target.square_m,
            marker_m=factor * target.marker_m,
            diameter_m=factor * target.diameter_m,
        )

    def otherwise(
        self, target: Target, ids: Sequence[IntArray], px: Sequence[FloatArray]
    ) -> dict[str, object]:
        """Keys of a description that a detector's corners contradict, as they should be.

        Args:
            target: The description.
            ids: (n,) numbers of the corners in each image.
            px: (n, 2) these corners [px].
        """
        del target, ids, px
        return {}

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the printed pattern in the target's frame, (2,) each [m]."""
        places = self.corners(target)[:, :2]
        return places.min(axis=0), places.max(axis=0)

    def discs(self, target: Target) -> FloatArray:
        """(n, 3) centres and radii of dark discs [m]."""
        del target
        return np.zeros((0, 3))

    def quiet_m(self, cells: Sequence[Cells]) -> float:
        """Width of the white that it needs around its cells [m]."""
        # Detectors need 2.5 mm around squares; markers need one module.
        return max(grid.cell_m for grid in cells) if self.has_lone_tags else 0.0025

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested board with sides of `square_mm`."""
        counts = {"columns": request.columns, "rows": request.rows}
        return {
            self.size_key: side_metres(f"--{self.size_key[:-2]}-mm", square_mm),
            **{key: count for key, count in counts.items() if count is not None},
        }

    def file_name(self, target: Target, side: str) -> str:
        """Name of a target with sides of `side`."""
        return f"{self.name}_{target.columns}x{target.rows}_{side}"

    def marker_places(self, numbers: IntArray, columns: int) -> Sequence[FloatArray]:
        """(n, 2) places of markers in steps of their grid, by variant of the layout.

        x and y are those of the markers themselves; `numbers` count from the first marker on, and
        may continue before it. Empty where a kind has no such grid.
        """
        del numbers, columns
        return ()

    def seen_in(self, image: Image) -> tuple[Target, bool] | None:
        """The board without markers, of sides of 1 m, that a (h, w) grey image shows.

        And whether the image shows on each side that it ends there.
        """
        del image
        return None


def file_beside(folder: Path, key: str, name: str, what: str) -> Path:
    """The path of a file that a target's `.toml` names, which must lie in its folder."""
    path = folder / name.replace("\\", "/")
    if not is_inside(path, folder):
        raise DataError(
            f"{key} = {name[:80]!r} leads out of the folder of the target's file.",
            culprits=[key],
            next_step=f"Copy the {what} beside the target's file.",
        )
    return path


def size_of(table: DocumentTable, key: str) -> float:
    """Reads the side of a square or a tag [m], or raises DataError."""
    size_m = table.number(key, positive=True)
    if size_m > _LARGEST_IN_CM:
        raise table.refuse(
            key, size_m, f"a length in metres, such as {1e-3 * size_m:g} for {size_m:g} mm"
        )
    if size_m > LARGEST_M:
        cm, inches = f"{1e-2 * size_m:g} for {size_m:g} cm", f"{0.0254 * size_m:g} for inches"
        raise table.refuse(key, size_m, f"metres: {cm}, {inches}")
    return size_m


def sigma_of(table: DocumentTable, size_m: float) -> float:
    """Reads the standard deviation of a side [m], or raises DataError."""
    sigma_m = table.number("square_sigma_m", DEFAULT_RELATIVE_SIGMA * size_m, positive=True)
    if not LEAST_SIGMA_M <= sigma_m <= size_m:
        needed = f"a standard deviation from {LEAST_SIGMA_M:g} m to the square's own {size_m:g} m"
        raise table.refuse("square_sigma_m", sigma_m, needed)
    return sigma_m


def counts_of(table: DocumentTable, fewest: int = FEWEST_SQUARES) -> tuple[int, int]:
    """Reads columns and rows, or raises DataError."""
    columns, rows = (table.integer(key, fewest, MOST_SQUARES) for key in ("columns", "rows"))
    return columns, rows


def dictionary_size(table: DocumentTable, name: str) -> int:
    """Number of markers of one of OpenCV's dictionaries; raises DataError for another name."""
    names = [entry for entry in dir(cv2.aruco) if entry.startswith("DICT_")]
    if name not in names:
        raise DataError(
            f"{table.label}: dictionary is {name!r}, which OpenCV does not have.",
            culprits=[f"{table.label}: dictionary"],
            next_step=did_you_mean(name.upper(), names)
            or "The names look like DICT_5X5_100 or DICT_APRILTAG_36h11.",
        )
    return len(aruco_dictionary(name).bytesList)


def first_id(table: DocumentTable, count: int, board: str, dictionary: str) -> int:
    """Reads the id of the first of a board's `count` markers, or raises DataError."""
    markers = dictionary_size(table, dictionary)
    first = table.integer("id" if "id" in table.content else "first_id", 0, markers - 1, 0)
    if first + count > markers:
        raise DataError(
            f"{table.label}: dictionary {dictionary} has {markers} markers; a board of {board}"
            f"{f' from id {first} on' if first else ''} needs {first + count}.",
            culprits=[f"{table.label}: dictionary"],
        )
    return first


def aruco_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """One of OpenCV's dictionaries by name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def dictionary_numbered(number: int) -> str:
    """Name of a dictionary by OpenCV's number of it; empty where there is none."""
    names = (name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    return next((name for name in names if getattr(cv2.aruco, name) == number), "")


def marker_cells(dictionary_name: str, marker_id: int, border: int = 1) -> Mask:
    """(n, n) mask of a marker's dark cells, including a border of `border` cells."""
    dictionary = aruco_dictionary(dictionary_name)
    size = dictionary.markerSize
    code = dictionary.bytesList[marker_id : marker_id + 1]
    bits = np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(code, size))
    return np.pad(bits == 0, border, constant_values=True)


def metres(millimetres: float) -> float:
    """Converts millimetres to metres without rounding twice: 23.6 becomes 0.0236."""
    return float(Decimal(str(millimetres)) / 1000)


def side_metres(option: str, side_mm: float) -> float:
    """Converts a side from millimetres to metres; `option` is named in messages.

    Raises:
        DataError: It is out of range.
    """
    most_mm = 1e3 * LARGEST_M
    if not _SMALLEST_MM <= side_mm <= most_mm:
        raise DataError(
            f"{option} is {side_mm:g}; {_SMALLEST_MM:g} to {most_mm:g} mm are possible.",
            culprits=[option],
        )
    return metres(side_mm)
