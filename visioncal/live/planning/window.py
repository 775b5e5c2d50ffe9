"""Whether points are in an image: by planes through the lens where these decide, else exactly."""

import numpy as np

from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.vision.camera import normalise, project_with_jacobian

# Rays along each side of the image, and the share by which planes keep off what lies between them.
_RAYS, _OFF = 33, 2e-3


class Window:
    """The part of space that a camera has in its image.

    A lens bends the image's sides. Points between four planes within the bent sides are in the
    image, points beyond four planes around them are not; only points in between need be projected.
    """

    def __init__(self, camera: Camera, edge_px: float) -> None:
        """Prepares the planes.

        Args:
            camera: The intrinsics.
            edge_px: How far points stay from the image's edge [px].
        """
        self._camera, self._edge_px = camera, edge_px
        whole = border_tangents(camera, 0.0, _RAYS)
        # Tangents of rays are shorter; beyond, a lens model may fold back into the image.
        self._rays_within = float(np.nanmax(np.linalg.norm(whole, axis=-1))) * (1.0 + 1e-6)
        self._inner, self._outer = _planes(border_tangents(camera, edge_px, _RAYS))

    def holds(self, points_cam: FloatArray) -> Mask:
        """Whether all of (..., p, 3) points in the camera's frame are in the image (...)."""
        inside = _between(self._inner, points_cam)
        doubtful = ~inside & _between(self._outer, points_cam)
        if doubtful.any():
            inside[doubtful] = self._projected(points_cam[doubtful])
        return inside

    def _projected(self, points_cam: FloatArray) -> Mask:
        flat = points_cam.reshape(-1, 3)
        straight = np.linalg.norm(flat[:, :2], axis=1) < self._rays_within * flat[:, 2]
        px = np.full((len(flat), 2), -np.inf)
        px[straight] = project_with_jacobian(self._camera, flat[straight], lens=False).px
        high = np.array(self._camera.resolution) - 1.0 - self._edge_px
        good = ((px >= self._edge_px) & (px <= high)).all(axis=1)
        return np.asarray(good.reshape(points_cam.shape[:-1]).all(axis=-1))


def border_tangents(camera: Camera, edge_px: float, rays: int) -> FloatArray:
    """(4, rays, 2) x / z and y / z of rays along the image's sides, `edge_px` inside.

    The sides are the upper, lower, left and right one; NaN where the lens has no ray.
    """
    along = np.linspace(-1.0, 1.0, rays)
    ones = np.ones_like(along)
    sides = [(along, -ones), (along, ones), (-ones, along), (ones, along)]
    unit = np.concatenate([np.column_stack(side) for side in sides])
    half = 0.5 * (np.array(camera.resolution) - 1.0)
    return normalise(camera, half + unit * (half - edge_px)).reshape(4, rays, 2)


def _planes(tangents: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (4, 3) of the planes within and around the sides; points between have no negative."""
    if np.isnan(tangents).any():
        # A lens without rays to its corners: no point is surely inside, and any before it may be.
        ahead, aside = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        return np.array([ahead, -ahead, aside, -aside]), np.array([ahead] * 4)
    top, bottom, left, right = tangents
    off = _OFF * np.ptp(tangents.reshape(-1, 2), axis=0)
    inner = [left[:, 0].max(), right[:, 0].min(), top[:, 1].max(), bottom[:, 1].min()]
    outer = [left[:, 0].min(), right[:, 0].max(), top[:, 1].min(), bottom[:, 1].max()]
    inward = np.array([off[0], -off[0], off[1], -off[1]])
    return _normals(np.array(inner) + inward), _normals(np.array(outer) - inward)


def _normals(bounds: FloatArray) -> FloatArray:
    """(4, 3) normals of the planes at least and greatest x / z and y / z."""
    left, right, top, bottom = bounds.tolist()
    return np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]])


def _between(normals: FloatArray, points: FloatArray) -> Mask:
    """Whether all of (..., p, 3) points are between planes."""
    sides = points.reshape(-1, 3) @ normals.T
    return np.asarray((sides >= 0.0).reshape(*points.shape[:-1], 4).all(axis=(-1, -2)))
