"""What a simulated camera sees of a board, and a detector finds: corners without a picture."""

from dataclasses import replace

import numpy as np

from visioncal.core.types import Camera, Corners, FloatArray, Mask, Target
from visioncal.simulation.boards import Sheet, corners_m, found_in_part
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CameraOptions
from visioncal.simulation.poses import LEAST_SHARE, MARGIN_PX

# A corner nearer to the image's edge is not detected [px].
EDGE_PX = 2.0
# A board is not looked at from farther aside.
_LEAST_COSINE = 0.5


def looks_at(camera: Camera, sheet: Sheet, cam_from_target: FloatArray) -> Mask:
    """(s,) in which of the stops a board is in view, not too much from the side."""
    points = corners_m(sheet) @ np.swapaxes(cam_from_target[:, :3, :3], 1, 2)
    points = points + cam_from_target[:, None, :3, 3]
    towards = points / np.linalg.norm(points, axis=2, keepdims=True)
    facing = np.einsum("mni,mi->mn", towards, cam_from_target[:, :3, 2]) > _LEAST_COSINE
    looks = facing.all(axis=1) & (towards[:, :, 2] > _LEAST_COSINE).all(axis=1)
    if not looks.any():
        return np.asarray(looks)
    share = sees(camera, points[looks], MARGIN_PX).mean(axis=1)
    looks[looks] = share >= (LEAST_SHARE if found_in_part(sheet.target) else 1.0)
    return np.asarray(looks)


def seen_in(camera: CameraOptions, sheet: Sheet, cam_from_target: FloatArray, view: int) -> Corners:
    """Where the corners of a sheet are in the image of one view, without the ones outside it."""
    points = corners_m(sheet) @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    ids = np.flatnonzero(sees(camera.camera, points, EDGE_PX)).astype(np.int64)
    return Corners(view, ids, project(camera.camera, points[ids]), camera.blur_px)


def detected(sheet: Sheet, exact: Corners, sigma_px: float, noise: np.random.Generator) -> Corners:
    """The corners of a view as a detector reports them, with noise.

    It begins a board that looks alike from both ends at the upper left.
    """
    found = replace(exact, px=exact.px + sigma_px * noise.standard_normal(exact.px.shape))
    if not is_symmetric(sheet.target) or not len(found.ids):
        return found
    if found.px[0].sum() <= found.px[-1].sum():
        return found
    last = sheet.target.columns * sheet.target.rows - 1
    return replace(found, ids=(last - found.ids)[::-1], px=found.px[::-1])


def is_symmetric(target: Target) -> bool:
    """Whether a board looks alike when it is turned by half a turn."""
    if target.kind == "circles":
        return not target.asymmetric or target.rows % 2 == 0
    return target.kind == "checkerboard" and (target.columns + target.rows) % 2 == 0
