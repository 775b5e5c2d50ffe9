"""Dark shapes of a target, in its own frame."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Target
from visioncal.vision.boards import kind_of
from visioncal.vision.boards.kind import Cells
from visioncal.vision.boards.template import SQUARE

# A polygon whose sides deviate from the circle by less than 0.05 % of the radius.
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def dark_cells(target: Target) -> tuple[Cells, ...]:
    """Dark areas of a target; those of two grids share at most a point; raises DataError."""
    return kind_of(target).cells(target)


def dark_discs(target: Target) -> FloatArray:
    """(n, 3) centres and radii of the dark discs on a target [m]."""
    return kind_of(target).discs(target)


@dataclass(frozen=True, eq=False)
class Pattern:
    """Printed shapes of a target."""

    # Closed outlines, (n, 2) each, in the target's frame [m]; the last point connects to the first.
    # All have the same direction: common sides cancel in one path, and leave no seam.
    loops: tuple[FloatArray, ...]
    # Left, top, right and bottom of the print in the target's frame [m].
    box: tuple[float, float, float, float]
    quiet_m: float  # Width of the quiet zone around the print [m].


def draw_pattern(target: Target) -> Pattern:
    """Shapes of a target; its corners are those of `targets.corner_positions`; raises DataError."""
    kind = kind_of(target)
    (left, top), (right, bottom) = (array.tolist() for array in kind.extent_m(target))
    grids = dark_cells(target)
    loops = [
        grid.corner_m + grid.cell_m * (SQUARE + place[::-1]) @ grid.turn.T
        for grid in grids
        for place in np.argwhere(grid.dark)
    ]
    loops += [disc[:2] + disc[2] * _CIRCLE for disc in dark_discs(target)]
    return Pattern(tuple(loops), (left, top, right, bottom), kind.quiet_m(grids))
