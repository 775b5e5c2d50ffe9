"""Dark shapes of a target, in its own frame."""

from dataclasses import dataclass, field

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Mask, Target
from visioncal.vision.targets import (
    corner_positions,
    extent_m,
    marked_squares,
    marker_cells,
    tag_corners,
)

# Quiet zone that detectors need around squares; markers need one module.
_QUIET_M = 0.0025
# A polygon whose sides deviate from the circle by less than 0.05 % of the radius.
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


@dataclass(frozen=True, eq=False)
class Pattern:
    """Printed shapes of a target."""

    # Closed outlines, (n, 2) each, in the target's frame [m]; the last point connects to the first.
    # Dark is the area with winding number one; a hole's outline has the opposite direction. Two
    # outlines share at most a point, so that renderers show no seams.
    loops: tuple[FloatArray, ...]
    # Left, top, right and bottom of the print in the target's frame [m].
    box: tuple[float, float, float, float]
    quiet_m: float  # Width of the quiet zone around the print [m].


def draw_pattern(target: Target) -> Pattern:
    """Shapes of a target; its corners are those of `targets.corner_positions`.

    Raises:
        DataError: The target is a rig of points that cannot be printed.
    """
    (left, top), (right, bottom) = (array.tolist() for array in extent_m(target))
    grids = dark_cells(target)
    loops = [
        grid.corner_m + grid.cell_m * loop @ grid.turn.T
        for grid in grids
        for loop in outlines(grid.dark)
    ]
    loops += [disc + target.diameter_m / 2 * _CIRCLE for disc in dark_discs(target)]
    of_tags = target.kind in ("marker", "points")
    quiet_m = max(grid.cell_m for grid in grids) if of_tags else _QUIET_M
    return Pattern(tuple(loops), (left, top, right, bottom), quiet_m)


def outlines(dark: Mask) -> tuple[FloatArray, ...]:
    """Traces the borders of the dark cells of a grid.

    Every dark cell has four directed sides, with the cell on their right as seen on the page. Sides
    between two dark cells cancel; the others are joined to loops.

    Args:
        dark: (rows, columns) mask of dark cells.

    Returns:
        (n, 2) loops of corners (x, y), in cells; (0, 0) is the outer corner of the first cell.
    """
    sides: set[tuple[tuple[int, int], tuple[int, int]]] = set()
    for y, x in np.argwhere(dark).tolist():
        corners = ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            if (end, start) in sides:
                sides.remove((end, start))
            else:
                sides.add((start, end))
    successors: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for start, end in sorted(sides):
        successors.setdefault(start, []).append(end)
    loops = []
    while successors:
        point = first = next(iter(successors))
        loop: list[tuple[int, int]] = []
        while not loop or point != first:
            loop.append(point)
            # Where two cells touch in a point, both continuations give the same winding numbers.
            ends = successors[point]
            successor = ends.pop()
            if not ends:
                del successors[point]
            point = successor
        loops.append(_without_straight(np.array(loop, dtype=float)))
    return tuple(loops)


def _without_straight(loop: FloatArray) -> FloatArray:
    """Drops the points of a loop where its direction does not change."""
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    turns = before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]
    return np.asarray(loop[turns])


# Largest deviation of a tag's measured corners from a square, as a share of its side.
_SQUARE = 0.02


@dataclass(frozen=True, eq=False)
class Cells:
    """A grid of dark and light cells."""

    corner_m: FloatArray  # (2,) outer corner of the first cell in the target's frame [m].
    cell_m: float  # Side of a cell [m].
    dark: Mask  # (rows, columns) mask of dark cells.
    # (2, 2) rotation, with the directions of the grid's columns and rows as columns.
    turn: FloatArray = field(default_factory=lambda: np.eye(2))


def dark_cells(target: Target) -> tuple[Cells, ...]:
    """Dark areas of a target; dark areas of two grids share at most a point.

    Raises:
        DataError: The target is a rig other than tags in the plane z = 0.
    """
    side = target.square_m
    match target.kind:
        case "marker":
            dark = marker_cells(target.dictionary, target.marker_id)
            return (Cells(np.full(2, -0.5 * side), side / len(dark), dark),)
        case "checkerboard":
            # The square diagonally outside corner 0 is dark.
            row, column = np.indices((target.rows + 1, target.columns + 1))
            return (Cells(np.full(2, -side), side, (row + column) % 2 == 0),)
        case "charuco":
            return _charuco(target)
        case "aprilgrid":
            return _aprilgrid(target)
        case "circles":
            return ()
        case "points":
            return _tags(target)


def _tags(target: Target) -> tuple[Cells, ...]:
    """Tags of a rig, at the poses given by their corners."""
    ids_of_corners, places = tag_corners(target), corner_positions(target)
    if (
        not ids_of_corners
        or np.ptp(places[:, 2]) > 0.0
        or min(array.min() for array in ids_of_corners.values()) < 0
    ):
        raise DataError(
            f"target {target.name} is a rig of points; a board can be printed, or a rig in one "
            "plane z = 0 whose points are all four corners of tags.",
            culprits=[target.name],
        )
    grids = []
    for number, corners in ids_of_corners.items():
        quad = places[corners, :2]
        cells = marker_cells(target.dictionary, number)
        x_side, y_side = quad[1] - quad[0], quad[3] - quad[0]
        side_m = float(np.linalg.norm(x_side))
        square = np.array([[-x_side[1], x_side[0]], quad[2] - quad[0] - x_side])
        if np.abs(square - y_side).max() > _SQUARE * side_m:
            raise DataError(
                f"target {target.name}: the corners of tag {number} are no square, clockwise from "
                "its upper left.",
                culprits=[f"tag {number}"],
            )
        turn = np.stack([x_side, y_side], axis=1) / side_m
        grids.append(Cells(quad[0], side_m / len(cells), cells, turn))
    return tuple(grids)


def dark_discs(target: Target) -> FloatArray:
    """(n, 2) centres of the dark discs on a target [m], of its diameter."""
    return corner_positions(target)[:, :2] if target.kind == "circles" else np.zeros((0, 2))


def _charuco(target: Target) -> tuple[Cells, ...]:
    light = marked_squares(target)
    dark = np.ones((target.rows, target.columns), dtype=bool)
    dark[light[:, 1], light[:, 0]] = False
    grids = [Cells(np.zeros(2), target.square_m, dark)]
    inset = (target.square_m - target.marker_m) / 2
    for marker_id, square in enumerate(light):
        cells = marker_cells(target.dictionary, marker_id)
        corner_m = target.square_m * square + inset
        grids.append(Cells(corner_m, target.marker_m / len(cells), cells))
    return tuple(grids)


def _aprilgrid(target: Target) -> tuple[Cells, ...]:
    """Tags, rotated by a half turn as on Kalibr's pages, and a square at each corner of a tag."""
    side, gap = target.square_m, target.square_m * target.spacing
    corners = corner_positions(target)[::4, :2]
    grids = []
    for number, corner_m in enumerate(corners, start=target.marker_id):
        cells = np.rot90(marker_cells(target.dictionary, number, target.border), 2)
        grids.append(Cells(corner_m, side / len(cells), cells))
    x, y = np.meshgrid(np.arange(target.columns + 1), np.arange(target.rows + 1))
    squares = (side + gap) * np.stack([x, y], axis=-1).reshape(-1, 2) - gap
    return (*grids, *(Cells(square, gap, np.ones((1, 1), bool)) for square in squares))
