"""Drawing of a target: its pattern on a sheet, or its points."""

import cv2
import numpy as np
import rerun as rr

from visioncal.core.types import Image, Target
from visioncal.present.recording import colours
from visioncal.vision.boards import kind_of
from visioncal.vision.printing.pattern import dark_cells, dark_discs
from visioncal.vision.targets import corner_positions, extent_m, outline


def sheet(target: Target) -> rr.Mesh3D | rr.Points3D:
    """The pattern as a textured sheet in the target's frame; for a rig, its points."""
    if target.is_rig:
        return rr.Points3D(
            corner_positions(target),
            colors=colours.DETECTED,
            radii=0.02 * target.square_m,
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
    """The printed pattern as a grey image, x to the right and y down."""
    own = kind_of(target).picture(target)
    if own is not None:
        return own
    low, high = extent_m(target)
    side_px = 2000 * target.square_m / float(np.max(high - low))
    # Shows the markers' bits; a large board's pattern is smaller.
    side_px = max(int(min(48 if target.columns * target.rows > 1 else 192, side_px)), 1)
    scale = side_px / target.square_m
    width, height = np.rint(scale * (high - low)).astype(int).tolist()
    page = np.full((height, width), 255, dtype=np.uint8)
    for grid in dark_cells(target):
        left, top = np.rint(scale * (grid.corner_m - low)).astype(int).tolist()
        rows, columns = (max(round(scale * grid.cell_m * value), 1) for value in grid.dark.shape)
        # More cells than pixels are averaged to grey.
        interpolation = cv2.INTER_NEAREST if rows >= len(grid.dark) else cv2.INTER_AREA
        brightness = np.where(grid.dark, 0, 255).astype(np.uint8)
        region = page[top : top + rows, left : left + columns]
        resized = cv2.resize(brightness, (columns, rows), interpolation=interpolation)
        np.minimum(region, resized[: region.shape[0], : region.shape[1]], out=region)
    discs = scale * (dark_discs(target) - [*low, 0.0]) - [0.5, 0.5, 0.0]
    for x, y, radius in np.rint(16.0 * discs).astype(int).tolist():
        cv2.circle(page, (x, y), radius, 0.0, -1, cv2.LINE_AA, shift=4)
    return page
