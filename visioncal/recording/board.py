"""The printed target as it is drawn: its pattern on a sheet, and its outline."""

import cv2
import numpy as np
import rerun as rr

from visioncal.targets import aruco_dictionary, charuco_board, extent_m
from visioncal.types import FloatArray, Image, Target

# Enough to show the bits of the markers; the pattern of a large board still stays small.
_SQUARE_PX, _LARGEST_PX = 48, 2000


def outline(target: Target) -> FloatArray:
    """(4, 3) corners of the printed pattern in the target's frame [m], clockwise on the page."""
    low, high = extent_m(target)
    return np.array(
        [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    )


def closed_outline(target: Target) -> FloatArray:
    """(5, 3) the outline with its first corner repeated, as a line strip needs it [m]."""
    corners = outline(target)
    return np.vstack([corners, corners[:1]])


def sheet(target: Target) -> rr.Mesh3D:
    """The pattern as a textured sheet in the target's frame."""
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
    columns, rows = (int(count) for count in squares)
    if target.kind == "charuco":
        board = charuco_board(target).generateImage((columns * square_px, rows * square_px))
        return np.asarray(board, dtype=np.uint8)
    if target.kind == "marker":
        dictionary = aruco_dictionary(target.dictionary)
        side_px = 4 * _SQUARE_PX
        marker = cv2.aruco.generateImageMarker(dictionary, target.marker_id, side_px)
        return np.asarray(marker, dtype=np.uint8)
    row, column = np.mgrid[:rows, :columns]
    # The square that touches corner 0 from outside, on its diagonal, is dark.
    light = np.where((row + column) % 2, 255, 0).astype(np.uint8)
    return np.kron(light, np.ones((square_px, square_px), dtype=np.uint8))
