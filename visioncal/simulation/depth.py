"""Depth pictures of a simulated cell: a sensor whose depth is false, noisy, and has holes."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import Camera, FloatArray, Image, Image16
from visioncal.simulation.boards import outline_m
from visioncal.simulation.optics import rays
from visioncal.simulation.render import RenderScene
from visioncal.simulation.textures import margin_m


@dataclass(frozen=True, kw_only=True)
class DepthOptions:
    """A depth sensor's errors: measured = scale * true + offset + tilt . (u, v) + bowl * r^2.

    u and v go from -1 to 1 over the image, and r is in half widths.
    """

    scale: float = 1.008  # Measured over true distance.
    offset_m: float = -0.0025  # Offset along z [m].
    tilt_m: tuple[float, float] = (0.0, 0.0)  # Change from the image's middle to its edges [m].
    bowl_m: float = 0.004  # Change from the middle to the left and right edges [m].
    noise_m: float = 0.0008  # Noise of a pixel at 1 m, which grows with the square [m].
    ink_m: float = 0.002  # How much deeper black is read than white [m].
    holes: float = 0.03  # Share of pixels without distance.
    unit_m: float = 0.0001  # Unit of the picture [m].
    boxed: float = 0.0  # Share of views in which a box stands before the board.


def depth_picture(
    scene: RenderScene, index: int, image: Image, options: DepthOptions, rng: np.random.Generator
) -> tuple[Image16, Image]:
    """Depth of a view in units of `unit_m`, and its image with the box.

    Args:
        scene: Prepared scene.
        index: The view's.
        image: (height, width) its image.
        options: The sensor.
        rng: Source of noise, holes and boxes.
    """
    if scene.board.bow_m:
        raise DataError("simulation: depth is that of a flat board; leave bow_m out.")
    width, height = scene.camera.camera.resolution
    px, directions = _seen(scene.camera.camera)
    pose = scene.sights[index].cam_from_target
    outline = outline_m(scene.board, margin_m(scene.board.target))
    low, high = outline.min(axis=0)[:2], outline.max(axis=0)[:2]
    behind = scene.backdrop.depth_m
    depth = (
        _plane(pose, directions, behind)[0]
        if scene.backdrop.moves
        else np.full(px.shape[:2], behind)
    )
    board = _rectangle(pose, directions, 0.0, low, high)
    on_board = np.isfinite(board)
    depth = np.where(on_board, board, depth)
    is_ink = np.zeros(depth.shape, dtype=bool)
    if on_board.any():
        is_ink = on_board & (image < 0.5 * np.sum(np.percentile(image[on_board], [5, 95])))
    if rng.random() < options.boxed:
        size = (high - low) * rng.uniform(0.35, 0.55, 2)
        corner = low + (high - low - size) * rng.random(2)
        box = _rectangle(pose, directions, -rng.uniform(0.03, 0.09), corner, corner + size)
        is_box = np.isfinite(box)
        depth, is_ink = np.where(is_box, box, depth), is_ink & ~is_box
        image = np.where(is_box, np.uint8(120), image).astype(np.uint8)
    # Pixels at edges see both sides.
    edge = cv2.dilate(depth, np.ones((3, 3))) - cv2.erode(depth, np.ones((3, 3)))
    flying = np.where(edge > 0.01, edge * (rng.random(depth.shape) - 0.5), 0.0)
    u, v = np.moveaxis((2.0 * px + 1.0) / (width, height) - 1.0, -1, 0)
    r2 = u**2 + (v * height / width) ** 2
    measured = options.scale * (depth + flying) + options.offset_m + options.bowl_m * r2
    measured += options.tilt_m[0] * u + options.tilt_m[1] * v + options.ink_m * is_ink
    measured += options.noise_m * depth**2 * rng.standard_normal(depth.shape)
    blobs = cv2.resize(rng.random((height // 12 + 2, width // 12 + 2)), (width, height))
    measured[blobs < np.quantile(blobs, options.holes)] = 0.0
    return np.clip(np.rint(measured / options.unit_m), 0, 65535).astype(np.uint16), image


@lru_cache(maxsize=1)
def _seen(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """(h, w, 2) pixels of a camera's images and (h, w, 3) their rays of unit depth."""
    width, height = camera.resolution
    px = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    directions = rays(camera, px)
    return px, directions / directions[..., 2:]


def _plane(pose: FloatArray, directions: FloatArray, z_m: float) -> tuple[FloatArray, FloatArray]:
    """(h, w) depth at which rays of unit depth meet z = `z_m` of a frame, and (h, w, 3) where."""
    inverse = invert(pose)
    along = directions @ inverse[:3, :3].T
    # Rays above the horizon see something far behind.
    depth = (z_m - inverse[2, 3]) / np.maximum(along[..., 2], 0.06)
    return np.asarray(depth), np.asarray(inverse[:3, 3] + depth[..., None] * along)


def _rectangle(
    pose: FloatArray, directions: FloatArray, z_m: float, low: FloatArray, high: FloatArray
) -> FloatArray:
    """(h, w) depth of a rectangle in z = `z_m` of a frame, NaN beside it."""
    depth, places = _plane(pose, directions, z_m)
    inside = ((places[..., :2] >= low) & (places[..., :2] <= high)).all(axis=-1)
    return np.where(inside, depth, np.nan)
