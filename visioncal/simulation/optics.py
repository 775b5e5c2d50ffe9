"""Simulated optics: projection and its inverse by OpenCV, independent of the application.

Models: Brown (1971) with OpenCV's rational radial term, and the equidistant fisheye polynomial of
Kannala and Brandt (2006). Pixel centres are at integers.
"""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.types import Camera, FloatArray

# Of the iterations that invert a distortion.
_EXACT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-13)


CAMERAS: Mapping[str, Camera] = {
    # 70 degrees of horizontal field of view and mild distortion.
    "wide": Camera(
        "brown",
        (1280, 800),
        np.array([914.2, 913.6, 645.3, 396.8]),
        np.array([-0.115, 0.062, 0.0004, -0.0003, -0.008]),
    ),
    # A 5 MP machine-vision camera with a 12 mm lens.
    "fine": Camera(
        "brown",
        (2448, 2048),
        np.array([3481.0, 3480.2, 1218.6, 1031.4]),
        np.array([-0.098, 0.121, -0.0002, 0.0003, -0.031]),
    ),
    # About 130 degrees of horizontal field of view.
    "fisheye": Camera(
        "fisheye",
        (1280, 960),
        np.array([563.0, 562.4, 642.2, 477.1]),
        np.array([-0.012, 0.004, -0.003, 0.0006]),
    ),
}


def inaccurate_camera(camera: Camera, rms_px: float, rng: np.random.Generator) -> Camera:
    """Intrinsics from a slightly inaccurate calibration, with an rms pixel error over the image."""
    if rms_px == 0.0:
        return camera
    # Errors that each move pixels at the image's edge by about one pixel.
    focal, count = float(camera.matrix[0]), len(camera.distortion)
    draws = rng.standard_normal(4 + count)
    matrix, distortion = draws[:4], draws[4:] * (2.0 / focal)
    centres = (np.arange(24) + 0.5) / 24
    grid = np.meshgrid(*(centres * size - 0.5 for size in camera.resolution))
    directions = rays(camera, np.stack(grid, axis=-1))

    def disturbed(share: float) -> Camera:
        return replace(
            camera,
            matrix=camera.matrix + share * matrix,
            distortion=camera.distortion + share * distortion,
        )

    errors_px = project(disturbed(1e-3), directions) - project(camera, directions)
    unit = 1e3 * float(np.sqrt(np.mean(np.sum(errors_px**2, axis=-1))))
    return disturbed(rms_px / unit)


def project(camera: Camera, points_cam: FloatArray) -> FloatArray:
    """Projects points into the image.

    Args:
        camera: The camera.
        points_cam: (..., 3) points in front of the camera, in its frame [m].

    Returns:
        (..., 2) pixels [px].

    Raises:
        DataError: The number of coefficients does not fit the camera's model.
    """
    points = np.ascontiguousarray(points_cam, dtype=float)
    if not points.size:
        return np.zeros((*points.shape[:-1], 2))
    module = cv2.fisheye if camera.model == "fisheye" else cv2
    zero = np.zeros(3)
    px, _ = module.projectPoints(points.reshape(-1, 1, 3), zero, zero, *_parameters(camera))
    return np.asarray(px.reshape(*points.shape[:-1], 2))


def rays(camera: Camera, px: FloatArray) -> FloatArray:
    """(..., 3) unit vectors in the camera frame, from (..., 2) pixels.

    Outside the region where the distortion is monotonic, which contains the image of any real lens,
    the directions are meaningless.
    """
    flat = np.ascontiguousarray(px, dtype=float).reshape(-1, 1, 2)
    if camera.model == "fisheye":
        plane = cv2.fisheye.undistortPoints(flat, *_parameters(camera), criteria=_EXACT)
    else:
        one = np.eye(3)
        plane = cv2.undistortPointsIter(flat, *_parameters(camera), one, one, _EXACT)
    directions = np.pad(plane.reshape(*px.shape), (*[(0, 0)] * (px.ndim - 1), (0, 1)))
    directions[..., 2] = 1.0
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def sees(camera: Camera, points_cam: FloatArray, margin_px: float) -> npt.NDArray[np.bool_]:
    """(...) mask of (..., 3) points in the camera frame [m] inside the image, by a margin [px]."""
    px = project(camera, points_cam)
    width, height = camera.resolution
    inside = (px >= margin_px - 0.5) & (px <= np.array([width, height]) - 0.5 - margin_px)
    seen = np.asarray(inside.all(axis=-1) & (points_cam[..., 2] > 0.0))
    if seen.any():
        # The polynomial can fold points from far outside back into the image; their rays differ.
        points = points_cam[seen]
        unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
        seen[seen] = np.einsum("ni,ni->n", rays(camera, px[seen]), unit) > 1.0 - 1e-9
    return seen


def _parameters(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Camera matrix (3, 3) and distortion coefficients, as OpenCV takes them."""
    count, allowed = camera.distortion.size, (4,) if camera.model == "fisheye" else (5, 8)
    if count not in allowed:
        raise DataError(
            f"simulation: a {camera.model} camera has {count} distortion coefficients, but "
            f"must have {' or '.join(map(str, allowed))}."
        )
    fx, fy, cx, cy = camera.matrix
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix, np.asarray(camera.distortion, dtype=float)
