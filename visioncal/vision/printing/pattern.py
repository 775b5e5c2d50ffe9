"""Dark shapes of a target, in its own frame."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Mask, Target
from visioncal.vision.boards import kind_of
from visioncal.vision.boards.kind import Cells

# A polygon whose sides deviate from the circle by less than 0.05 % of the radius.
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def dark_cells(target: Target) -> tuple[Cells, ...]:
    """Dark areas of a target; those of two grids share at most a point.

    Raises:
        DataError: The target is a rig that cannot be printed.
    """
    return kind_of(target).cells(target)


def dark_discs(target: Target) -> FloatArray:
    """(n, 3) centres and radii of the dark discs on a target [m]."""
    return kind_of(target).discs(target)


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
    kind = kind_of(target)
    (left, top), (right, bottom) = (array.tolist() for array in kind.extent_m(target))
    grids = dark_cells(target)
    loops = [
        grid.corner_m + grid.cell_m * loop @ grid.turn.T
        for grid in grids
        for loop in outlines(grid.dark)
    ]
    loops += [disc[:2] + disc[2] * _CIRCLE for disc in dark_discs(target)]
    return Pattern(tuple(loops), (left, top, right, bottom), kind.quiet_m(grids))


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
