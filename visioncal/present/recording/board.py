"""Drawing of a target: its pattern on a sheet, or its points."""

import numpy as np
import rerun as rr

from visioncal.core.types import Image, Target
from visioncal.present.recording import colours
from visioncal.vision.boards import kind_of
from visioncal.vision.printing.pattern import light_of
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
    kind_image = kind_of(target).picture(target)
    if kind_image is not None:
        return kind_image
    low, high = extent_m(target)
    side_px = 2000 * target.square_m / float(np.max(high - low))
    # Shows the markers' bits; a large board's pattern is smaller.
    side_px = max(int(min(48 if target.columns * target.rows > 1 else 192, side_px)), 1)
    scale = side_px / target.square_m
    width, height = np.rint(scale * (high - low)).astype(int).tolist()
    return np.rint(255 * light_of(target, low, 1 / scale, (height, width))).astype(np.uint8)
