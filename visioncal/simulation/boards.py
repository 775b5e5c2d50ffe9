"""Simulated targets, and the corners of a printed, scaled and bowed one."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Target

_APRILTAGS = "DICT_APRILTAG_36h11"


def _tags() -> Target:
    """Seven tags of 40 to 60 mm on a plate, with measured corners."""
    tags = (
        *((3, 0.000, 0.000, 0.050), (17, 0.085, 0.010, 0.040), (42, 0.160, 0.000, 0.060)),
        *((5, 0.010, 0.075, 0.040), (101, 0.140, 0.085, 0.050), (64, 0.075, 0.070, 0.045)),
        (9, 0.205, 0.090, 0.040),
    )
    points = [
        (x + dx * side, y + dy * side, 0.0)
        for _, x, y, side in tags
        for dx, dy in ((0, 0), (1, 0), (1, 1), (0, 1))
    ]
    return Target(
        name="tags",
        kind="points",
        columns=len(points),
        rows=1,
        square_m=0.245,
        square_sigma_m=0.0,
        dictionary=_APRILTAGS,
        points_m=tuple(points),
        point_numbers=tuple(range(len(points))),
        point_tags=tuple((tag[0], corner) for tag in tags for corner in range(4)),
    )


# Boards with square sides and their sigmas [m]: a ChArUco board, a checkerboard whose colours
# determine corner 0, an AprilGrid as on Kalibr's pages, circles of 14 mm in shifted rows, and a
# symmetric grid of circles of 15 mm.
_CHARUCO = Target(
    "charuco_9x6_30mm", "charuco", 9, 6, 0.030, 3e-5, marker_m=0.022, dictionary="DICT_5X5_100"
)
_CHECKERBOARD = Target("checkerboard_9x6_25mm", "checkerboard", 9, 6, 0.025, 2.5e-5)
_APRILGRID = Target(
    name="aprilgrid_6x4_32mm",
    kind="aprilgrid",
    columns=6,
    rows=4,
    square_m=0.032,
    square_sigma_m=3.2e-5,
    dictionary=_APRILTAGS,
    marker_id=0,
    spacing=0.3,
    border=2,
)
_CIRCLES = Target(
    "circles_5x9_20mm_asymmetric", "circles", 5, 9, 0.020, 2e-5, diameter_m=0.014, asymmetric=True
)
_SYMMETRIC = Target("circles_8x6_30mm", "circles", 8, 6, 0.030, 3e-5, diameter_m=0.015)
BOARDS: Mapping[str, Target] = {
    "charuco": _CHARUCO,
    "checkerboard": _CHECKERBOARD,
    "aprilgrid": _APRILGRID,
    "circles": _CIRCLES,
    "symmetric-circles": _SYMMETRIC,
    "tags": _tags(),
}
TARGETS: Mapping[str, Target] = {board.name: board for board in BOARDS.values()}


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A printed target on its plate."""

    target: Target  # Target as designed.
    scale: float = 1.0  # Printed size over stated size.
    # Depth of the pattern's outer corners relative to its centre, positive away from a camera in
    # front of it [m].
    bow_m: float = 0.0


def pattern_box(target: Target) -> tuple[float, float, float, float]:
    """Bounds of the print in the target frame: left, top, right, bottom [m], as designed."""
    side = target.square_m
    if target.kind == "marker":
        return (-0.5 * side, -0.5 * side, 0.5 * side, 0.5 * side)
    if target.kind == "aprilgrid":
        gap = target.spacing * side
        return (-gap, -gap, target.columns * (side + gap), target.rows * (side + gap))
    if target.kind == "points":
        places = np.array(target.points_m)[:, :2]
        return (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())
    if target.kind == "circles":
        places, radius = circles_m(target), 0.5 * target.diameter_m
        return (-radius, -radius, *(places.max(axis=0) + radius).tolist())
    start = 0.0 if target.kind == "charuco" else -side
    return (start, start, target.columns * side, target.rows * side)


def corners_m(sheet: Sheet) -> FloatArray:
    """Corners of the real sheet in the target frame.

    Returns:
        (n, 3) points [m] by corner id.
    """
    target = sheet.target
    if target.kind == "marker":
        half = 0.5 * target.square_m
        flat = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    elif target.kind == "circles":
        flat = circles_m(target)
    elif target.kind == "points":
        flat = np.array(target.points_m)[:, :2]
    elif target.kind == "aprilgrid":
        flat = np.concatenate([_around(array, target.square_m) for _, array in tags_m(target)])
    else:
        first, less = (1, 1) if target.kind == "charuco" else (0, 0)
        columns = np.arange(target.columns - less) + first
        rows = np.arange(target.rows - less) + first
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        flat = target.square_m * grid.astype(float)
    return lift(sheet, sheet.scale * flat)


def unit_m(target: Target) -> float:
    """Side of a square, or of the first of free tags, as the unit of a sheet's texture [m]."""
    if target.kind != "points":
        return target.square_m
    first, second = target.points_m[:2]
    return float(np.linalg.norm(np.subtract(second, first)))


def circles_m(target: Target) -> FloatArray:
    """(n, 2) centres of circles, row by row; every second row of an asymmetric grid is shifted."""
    wide, shift = (2, 1) if target.asymmetric else (1, 0)
    return target.square_m * np.array(
        [
            (wide * column + shift * (row % 2), row)
            for row in range(target.rows)
            for column in range(target.columns)
        ],
        dtype=float,
    )


def tags_m(target: Target) -> list[tuple[int, FloatArray]]:
    """Ids of an AprilGrid's tags with their upper left corners, (2,) each [m].

    As on Kalibr's pages: row by row from the lower left.
    """
    pitch_m = (1.0 + target.spacing) * target.square_m
    places = [(x, y) for y in reversed(range(target.rows)) for x in range(target.columns)]
    return [
        (target.marker_id + number, pitch_m * np.array(place, dtype=float))
        for number, place in enumerate(places)
    ]


def _around(corner: FloatArray, side_m: float) -> FloatArray:
    """(4, 2) corners of a tag, clockwise from its upper left one [m]."""
    right, down = side_m * np.eye(2)
    return np.array([corner, corner + right, corner + right + down, corner + down])


def detectable_in_part(target: Target) -> bool:
    """Whether detectors accept a part of a board."""
    return target.kind in ("charuco", "aprilgrid", "points")


def outline_m(sheet: Sheet, margin_m: float) -> FloatArray:
    """(64, 3) points in the target frame around the real print, at a distance `margin_m` [m]."""
    left, top, right, bottom = pattern_box(sheet.target)
    along = np.linspace(0.0, 1.0, 16, endpoint=False)[:, None]
    print_m = sheet.scale * np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    knots = print_m + margin_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    sides = [
        start + along * (end - start)
        for start, end in zip(knots, np.roll(knots, -1, axis=0), strict=True)
    ]
    return lift(sheet, np.concatenate(sides))


def centre_m(sheet: Sheet) -> FloatArray:
    """Centre of the print in the target frame, (3,) [m]."""
    left, top, right, bottom = pattern_box(sheet.target)
    return sheet.scale * np.array([0.5 * (left + right), 0.5 * (top + bottom), 0.0])


def lift(sheet: Sheet, flat: FloatArray) -> FloatArray:
    """Maps (..., 2) points of the flat sheet onto the bowed surface, (..., 3) [m]."""
    return np.concatenate([flat, bow_depth_m(sheet, flat)[..., None]], axis=-1)


def bow_depth_m(sheet: Sheet, flat: FloatArray) -> FloatArray:
    """Depth of the bowed surface at (..., 2) points of the sheet, (...) [m].

    A paraboloid, four times as strong along x as along y, as paper curls about one axis. It touches
    the plane z = 0 at the centre of the print.
    """
    left, top, right, bottom = pattern_box(sheet.target)
    half = 0.5 * sheet.scale * np.array([right - left, bottom - top])
    u, v = np.moveaxis((flat - centre_m(sheet)[:2]) / half, -1, 0)
    return np.asarray(sheet.bow_m * (0.8 * u * u + 0.2 * v * v))
