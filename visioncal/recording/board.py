"""The target as it is drawn: its pattern on a sheet or its points, and its outline."""

import cv2
import numpy as np
import rerun as rr

from visioncal.recording import colours
from visioncal.targets import corner_positions, extent_m, marked_squares, marker_cells
from visioncal.types import FloatArray, Image, Mask, Target

# Enough to show the bits of the markers; the pattern of a large board still stays small.
_SQUARE_PX, _LARGEST_PX = 48, 2000
# A rig's points are drawn so large, as a share of its extent; and the edges of a unit box, in one.
_DOT = 0.02
_BOX = np.array(
    [
        *((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0)),
        *((1, 0, 1), (1, 1, 1), (1, 1, 0), (1, 1, 1), (0, 1, 1), (0, 1, 0), (0, 1, 1), (0, 0, 1)),
    ]
)


def outline(target: Target) -> FloatArray:
    """(4, 3) corners of the printed pattern in the target's frame [m], clockwise on the page.

    Those of a rig are of the middle of the box around its points.
    """
    low, high = extent_m(target)
    middle = float(np.mean([it[:, 2] for it in _ends(target)]))
    corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
    return np.pad(corners, ((0, 0), (0, 1)), constant_values=middle)


def _ends(target: Target) -> tuple[FloatArray, FloatArray]:
    """The low and high ends (1, 3) of the box around a target's corners [m]."""
    places = corner_positions(target)
    return places.min(axis=0, keepdims=True), places.max(axis=0, keepdims=True)


def closed_outline(target: Target) -> FloatArray:
    """(k, 3) the outline as a line strip [m]; of a rig, the edges of the box around it."""
    if target.kind == "points":
        low, high = _ends(target)
        return np.asarray(low + _BOX * (high - low))
    corners = outline(target)
    return np.vstack([corners, corners[:1]])


def sheet(target: Target) -> rr.Mesh3D | rr.Points3D:
    """The pattern as a textured sheet in the target's frame; of a rig, its points."""
    if target.kind == "points":
        return rr.Points3D(
            corner_positions(target),
            colors=colours.DETECTED,
            radii=_DOT * target.square_m,
            labels=list(map(str, target.point_numbers)),
            show_labels=False,
        )
    pattern = picture(target)
    return rr.Mesh3D(
        vertex_positions=outline(target),
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_texcoords=[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
        albedo_texture=np.repeat(pattern[:, :, None], 3, axis=2),
    )


def picture(target: Target) -> Image:
    """The printed pattern inside its outline, as a grey image with x to the right and y down."""
    squares = np.rint(np.subtract(*extent_m(target)[::-1]) / target.square_m).astype(int)
    square_px = max(min(_SQUARE_PX, _LARGEST_PX // int(squares.max())), 1)
    if target.kind == "marker":
        return _marker(target, target.marker_id, 4 * _SQUARE_PX)
    if target.kind == "checkerboard":
        row, column = np.mgrid[: squares[1], : squares[0]]
        # The square that touches corner 0 from outside, on its diagonal, is dark.
        return _enlarged((row + column) % 2 == 1, square_px)
    marked = marked_squares(target)
    light = np.zeros((target.rows, target.columns), dtype=bool)
    light[marked[:, 1], marked[:, 0]] = True
    page = _enlarged(light, square_px)
    side_px = max(round(square_px * target.marker_m / target.square_m), 1)
    corners = square_px * marked + (square_px - side_px) // 2
    for marker_id, (x, y) in enumerate(corners):
        page[y : y + side_px, x : x + side_px] = _marker(target, marker_id, side_px)
    return page


def _enlarged(light: Mask, square_px: int) -> Image:
    squares = np.where(light, 255, 0).astype(np.uint8)
    return np.kron(squares, np.ones((square_px, square_px), dtype=np.uint8))


def _marker(target: Target, marker_id: int, side_px: int) -> Image:
    cells = np.where(marker_cells(target.dictionary, marker_id), 0, 255).astype(np.uint8)
    # Where there are more cells than pixels, they mix to grey.
    how = cv2.INTER_NEAREST if side_px >= len(cells) else cv2.INTER_AREA
    return np.asarray(cv2.resize(cells, (side_px, side_px), interpolation=how), dtype=np.uint8)
