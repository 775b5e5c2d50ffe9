"""Targets from partial requirements: sizes left open become the largest that fit."""

from dataclasses import dataclass
from typing import Any

from visioncal.core.errors import DataError
from visioncal.core.types import Target, TargetKind
from visioncal.vision.printing.page import Page, arrange, largest_side_mm
from visioncal.vision.targets import (
    APRILGRID_DICTIONARY,
    LARGEST_M,
    aruco_dictionary,
    metres,
    target_from_document,
)

# Marker side over square side: at least one module of white on every side.
_MARKER_SHARE = 0.75
# Gap between tags as a share of a tag's side, as on Kalibr's pages.
_SPACING = 0.3
# Diameter of circles over the spacing of neighbours: as much dark as white between them.
_DIAMETER_SHARE = 0.5
# Kinds whose size is that of a tag.
OF_TAGS = ("marker", "aprilgrid")
# Smaller squares are limited by the printer's resolution.
_LEAST_MM = 5
# Smallest side that can be measured to 0.1 %.
_SMALLEST_MM = 0.1
_USUAL = ("DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000")


@dataclass(frozen=True)
class BoardRequest:
    """Requirements of a board; None and empty texts are chosen automatically."""

    kind: TargetKind  # Kind of target.
    # Number of squares (ChArUco), inner corners (checkerboard), tags (AprilGrid) or circles along
    # x.
    columns: int | None = None
    rows: int | None = None  # Likewise along y.
    # Side of a square, or of the marker for a single marker and an AprilGrid [mm].
    square_mm: float | None = None
    marker_mm: float | None = None  # Side of the markers in a ChArUco board [mm].
    dictionary: str = ""  # ArUco dictionary by OpenCV's name.
    legacy: bool = False  # Whether a ChArUco board has OpenCV's layout before 4.6.
    marker_id: int | None = None  # Id of a single marker; the smallest one of an AprilGrid.
    name: str = ""  # Name of the target.
    spacing: float | None = None  # Gap between the tags of an AprilGrid, as a share of their side.
    border: int | None = None  # Number of dark modules around their bits.
    diameter_mm: float | None = None  # Diameter of circles [mm].
    asymmetric: bool = False  # Whether every second row of circles is shifted.


def side_metres(option: str, side_mm: float) -> float:
    """Converts a side from millimetres to metres.

    Args:
        option: Name of its option, for messages.
        side_mm: Side of a square or of a marker [mm].

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


def requested_target(request: BoardRequest, pages: tuple[Page, ...]) -> Target:
    """Builds the requested target.

    Args:
        request: Requirements. An open side becomes the largest in whole millimetres that fits one
            of the pages; an open marker side three quarters of its square's, in whole millimetres.
        pages: Pages that it may be printed on.

    Raises:
        DataError: A requirement is missing or cannot be met.
    """
    if request.square_mm is not None:
        return _target(request, request.square_mm)
    smallest = _target(request, _LEAST_MM)
    largest = largest_side_mm(smallest, pages)
    if largest < _LEAST_MM:
        # Raises an error with the required size.
        arrange(smallest, pages)
    return _target(request, largest)


def _target(request: BoardRequest, square_mm: float) -> Target:
    document: dict[str, Any] = {"kind": request.kind}
    of_tags = request.kind in OF_TAGS
    side_m = side_metres("--size-mm" if of_tags else "--square-mm", square_mm)
    document |= {"size_m" if of_tags else "square_m": side_m}
    if of_tags:
        document |= {"dictionary": request.dictionary or APRILGRID_DICTIONARY}
    requested: dict[str, float | None] = {"id": request.marker_id} if of_tags else {}
    if request.kind != "marker":
        requested |= {"columns": request.columns, "rows": request.rows}
    if request.kind == "aprilgrid":
        spacing = _SPACING if request.spacing is None else request.spacing
        requested |= {"spacing": spacing, "border": request.border}
    document |= {key: value for key, value in requested.items() if value is not None}
    if request.kind == "circles":
        share = _DIAMETER_SHARE * (1.4 if request.asymmetric else 1.0)
        diameter_mm = round(share * square_mm, 6)
        if request.diameter_mm is not None:
            diameter_mm = request.diameter_mm
        document |= {
            "diameter_m": side_metres("--diameter-mm", diameter_mm),
            "asymmetric": request.asymmetric,
        }
    if request.kind == "charuco":
        marker_mm = request.marker_mm
        if marker_mm is None:
            # Below ten millimetres whole numbers are too coarse; rounded to a nanometre.
            marker_mm = round(_MARKER_SHARE * square_mm, 6)
            marker_mm = float(int(marker_mm)) if square_mm >= 2 * _LEAST_MM else marker_mm
        document |= {
            "marker_m": side_metres("--marker-mm", marker_mm),
            "dictionary": request.dictionary or _sufficient_dictionary(request),
            "legacy": request.legacy,
        }
    label = request.name or request.kind
    target = target_from_document(document, label)
    return target if request.name else target_from_document(document, _name(target))


def _sufficient_dictionary(request: BoardRequest) -> str:
    """The first of the usual dictionaries with enough markers."""
    needed = (request.columns or 0) * (request.rows or 0) // 2
    for name in _USUAL:
        if len(aruco_dictionary(name).bytesList) >= needed:
            return name
    return _USUAL[-1]


def _name(target: Target) -> str:
    side = f"{1e3 * target.square_m:g}mm"
    if target.kind == "marker":
        family = target.dictionary.removeprefix("DICT_").lower()
        family = family if family.startswith("a") else f"aruco_{family}"
        return f"{family}_id{target.marker_id}_{side}"
    legacy = "_legacy" if target.legacy else ""
    layout = "_asymmetric" if target.asymmetric else legacy
    return f"{target.kind}_{target.columns}x{target.rows}_{side}{layout}"
