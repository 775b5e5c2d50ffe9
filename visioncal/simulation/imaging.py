"""Corners of a board in a simulated camera, exact and as detected, without rendering."""

from dataclasses import replace

import numpy as np

from visioncal.core.types import Camera, Corners, FloatArray, Mask, Target
from visioncal.simulation.boards import Sheet, corners_m, detectable_in_part
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CameraOptions
from visioncal.simulation.poses import LEAST_SHARE, MARGIN_PX

# Corners closer to the image's edge are not detected [px].
EDGE_PX = 2.0
# Smallest cosine of the angle between view and board normal.
_LEAST_COSINE = 0.5


def board_in_view(camera: Camera, sheet: Sheet, cam_from_target: FloatArray) -> Mask:
    """(s,) mask of stops at which a board is in view and not too oblique."""
    points = corners_m(sheet) @ np.swapaxes(cam_from_target[:, :3, :3], 1, 2)
    points = points + cam_from_target[:, None, :3, 3]
    directions = points / np.linalg.norm(points, axis=2, keepdims=True)
    facing = np.einsum("mni,mi->mn", directions, cam_from_target[:, :3, 2]) > _LEAST_COSINE
    visible = facing.all(axis=1) & (directions[:, :, 2] > _LEAST_COSINE).all(axis=1)
    if not visible.any():
        return np.asarray(visible)
    share = sees(camera, points[visible], MARGIN_PX).mean(axis=1)
    visible[visible] = share >= (LEAST_SHARE if detectable_in_part(sheet.target) else 1.0)
    return np.asarray(visible)


def visible_corners(
    camera: CameraOptions, sheet: Sheet, cam_from_target: FloatArray, view: int
) -> Corners:
    """Exact corners of a sheet inside the image of one view."""
    points = corners_m(sheet) @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    ids = np.flatnonzero(sees(camera.camera, points, EDGE_PX)).astype(np.int64)
    return Corners(view, ids, project(camera.camera, points[ids]), camera.blur_px)


def detected(sheet: Sheet, exact: Corners, sigma_px: float, noise: np.random.Generator) -> Corners:
    """Corners of a view as detected, with noise.

    The numbering of a symmetric board starts at the upper left.
    """
    corners = replace(exact, px=exact.px + sigma_px * noise.standard_normal(exact.px.shape))
    if not is_symmetric(sheet.target) or not len(corners.ids):
        return corners
    if corners.px[0].sum() <= corners.px[-1].sum():
        return corners
    last = sheet.target.columns * sheet.target.rows - 1
    return replace(corners, ids=(last - corners.ids)[::-1], px=corners.px[::-1])


def is_symmetric(target: Target) -> bool:
    """Whether a board is invariant under a half turn."""
    if target.kind == "circles":
        return not target.asymmetric or target.rows % 2 == 0
    return target.kind == "checkerboard" and (target.columns + target.rows) % 2 == 0
