"""Boards of simulated cells, and the surface of a printed, scaled and bowed one."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from visioncal.core.codec import within
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.vision.targets import corner_positions, extent_m, load_target, rotation_transforms

# Corners closer to the image's edge are not detected [px].
EDGE_PX = 2.0
# Smallest cosine of the angle between view and board normal.
LEAST_COSINE = 0.5


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
        dictionary="DICT_APRILTAG_36h11",
        points_m=tuple(points),
        point_numbers=tuple(range(len(points))),
        point_tags=tuple((tag[0], corner) for tag in tags for corner in range(4)),
    )


BOARDS: Mapping[str, Target] = {
    "charuco": load_target("charuco_9x6_30mm"),
    "checkerboard": load_target("checkerboard_9x6_25mm"),
    "aprilgrid": load_target("aprilgrid_6x4_32mm"),
    "circles": load_target("circles_5x9_20mm_asymmetric"),
    "symmetric-circles": Target("circles_8x6_30mm", "circles", 8, 6, 0.030, 3e-5, diameter_m=0.015),
    "tags": _tags(),
}
TARGETS: Mapping[str, Target] = {board.name: board for board in BOARDS.values()}


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A printed target on its plate."""

    target: Target  # Target as designed.
    scale: Annotated[float, within(0.5, 2.0)] = 1.0  # Printed size over stated size.
    # Depth of the pattern's outer corners relative to its centre, positive away from a camera in
    # front of it [m].
    bow_m: Annotated[float, within(-0.05, 0.05)] = 0.0


def corners_m(sheet: Sheet) -> FloatArray:
    """Corners of the real sheet in the target frame, (n, 3) by corner id [m]."""
    return _lifted(sheet, sheet.scale * corner_positions(sheet.target)[:, :2])


def unit_m(target: Target) -> float:
    """Side of a square, a patch or the first of free tags, as a unit of sheets' textures [m]."""
    first, second = corner_positions(target)[:2]
    is_side = target.is_rig or target.kind == "picture"
    return float(np.linalg.norm(second - first)) if is_side else target.square_m


def outline_m(sheet: Sheet, margin_m: float) -> FloatArray:
    """(64, 3) points in the target frame around the real print, at a distance `margin_m` [m]."""
    low, high = (sheet.scale * end for end in extent_m(sheet.target))
    (left, top), (right, bottom) = low - margin_m, high + margin_m
    knots = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    along = np.linspace(0.0, 1.0, 16, endpoint=False)[:, None]
    sides = [
        start + along * (end - start)
        for start, end in zip(knots, np.roll(knots, -1, axis=0), strict=True)
    ]
    return _lifted(sheet, np.concatenate(sides))


def centre_m(sheet: Sheet) -> FloatArray:
    """Centre of the print in the target frame, (3,) [m]."""
    low, high = extent_m(sheet.target)
    return np.append(0.5 * sheet.scale * (low + high), 0.0)


def bow_depth_m(sheet: Sheet, flat: FloatArray) -> FloatArray:
    """Depth of the bowed surface at (..., 2) points of the sheet, (...) [m].

    A paraboloid, four times as strong along x as along y, as paper curls about one axis. It touches
    the plane z = 0 at the centre of the print.
    """
    low, high = extent_m(sheet.target)
    half = 0.5 * sheet.scale * (high - low)
    u, v = np.moveaxis((flat - centre_m(sheet)[:2]) / half, -1, 0)
    return np.asarray(sheet.bow_m * (0.8 * u * u + 0.2 * v * v))


def _lifted(sheet: Sheet, flat: FloatArray) -> FloatArray:
    """Maps (..., 2) points of the flat sheet onto the bowed surface, (..., 3) [m]."""
    return np.concatenate([flat, bow_depth_m(sheet, flat)[..., None]], axis=-1)


def detected(sheet: Sheet, exact: Corners, sigma_px: float, noise: np.random.Generator) -> Corners:
    """Corners of a view as detected, with noise.

    The numbering of a symmetric board starts at the upper left.
    """
    corners = replace(exact, px=exact.px + sigma_px * noise.standard_normal(exact.px.shape))
    is_symmetric = len(rotation_transforms(sheet.target)) > 1
    if not is_symmetric or not len(corners.ids):
        return corners
    if corners.px[0].sum() <= corners.px[-1].sum():
        return corners
    last = sheet.target.columns * sheet.target.rows - 1
    return replace(corners, ids=(last - corners.ids)[::-1], px=corners.px[::-1])
