"""Dark shapes of a target, in its own frame."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.types import FloatArray, Target
from visioncal.vision.boards import kind_of
from visioncal.vision.boards.template import SQUARE

# A polygon whose sides deviate from the circle by less than 0.05 % of the radius.
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def light_of(
    target: Target, low_m: FloatArray, texel_m: float, shape: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """(h, w) light of a print, by area, from 0 for dark to 1 for light; nothing is on its paper.

    Args:
        target: The target; turned tags are drawn straight.
        low_m: (2,) outer corner of the first texel in the target's frame [m].
        texel_m: Side of a texel [m].
        shape: Texels down and across.

    Raises:
        DataError: The target is a rig of points that cannot be printed.
    """
    kind, light = kind_of(target), np.ones(shape, np.float32)
    picture = kind.picture(target)
    if picture is not None:
        corner, size = (
            np.rint((end - low_m) / texel_m).astype(int) for end in kind.extent_m(target)
        )
        size = size - corner
        by = cv2.INTER_AREA if size[0] < picture.shape[1] else cv2.INTER_LINEAR
        window = light[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
        window[:] = cv2.resize(picture, size.tolist(), interpolation=by)[
            : len(window), : window.shape[1]
        ] / np.float32(255.0)
    for grid in kind.cells(target):
        (top, down), (left, across) = (
            _overlaps(start, grid.cell_m / texel_m, grid.dark.shape[axis], shape[axis])
            for axis, start in enumerate(((grid.corner_m - low_m) / texel_m)[::-1].tolist())
        )
        light[top : top + down.shape[1], left : left + across.shape[1]] -= (
            down.T @ grid.dark @ across
        )
    for disc in (kind.discs(target) - [*low_m, 0.0]) / texel_m:
        centre, radius = disc[:2], float(disc[2])
        # Circles' edges are straight within a texel.
        start, end = (
            np.clip(centre + value, 0, shape[::-1]) for value in (-radius - 1, radius + 2)
        )
        (left, top), (right, bottom) = start.astype(int), end.astype(int)
        x, y = np.arange(left, right) + 0.5 - centre[0], np.arange(top, bottom) + 0.5 - centre[1]
        outside = np.clip(np.hypot(x[None], y[:, None]) - radius + 0.5, 0.0, 1.0)
        np.minimum(light[top:bottom, left:right], outside, out=light[top:bottom, left:right])
    return light


def _overlaps(
    start: float, cell: float, count: int, texels: int
) -> tuple[int, npt.NDArray[np.float32]]:
    """First texel that a row of cells touches, and (cells, texels) overlaps."""
    edges = start + cell * np.arange(count + 1)
    first, end = max(math.floor(edges[0]), 0), min(math.ceil(edges[-1]), texels)
    texel = np.arange(first, end)
    low, high = (np.clip(texel[None] + side, edges[:-1, None], edges[1:, None]) for side in (0, 1))
    return first, np.asarray(high - low, np.float32)


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
    grids = kind.cells(target)
    loops = [
        grid.corner_m + grid.cell_m * (SQUARE + place[::-1]) @ grid.turn.T
        for grid in grids
        for place in np.argwhere(grid.dark)
    ]
    loops += [disc[:2] + disc[2] * _CIRCLE for disc in kind.discs(target)]
    return Pattern(tuple(loops), (left, top, right, bottom), kind.quiet_m(grids))
