"""Simulated optics: projection and its inverse, independent of the application.

Models: Brown (1971) with OpenCV's rational radial term, and the equidistant fisheye polynomial of
Kannala and Brandt (2006) in OpenCV's parametrisation. Pixel centres are at integers.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.types import Camera, FloatArray


def wide_camera() -> Camera:
    """A 1280x800 camera with 70 degrees of horizontal field of view and mild distortion."""
    return Camera(
        model="brown",
        resolution=(1280, 800),
        matrix=np.array([914.2, 913.6, 645.3, 396.8]),
        distortion=np.array([-0.115, 0.062, 0.0004, -0.0003, -0.008]),
    )


def fine_camera() -> Camera:
    """A 5 MP machine-vision camera (2448x2048) with a 12 mm lens."""
    return Camera(
        model="brown",
        resolution=(2448, 2048),
        matrix=np.array([3481.0, 3480.2, 1218.6, 1031.4]),
        distortion=np.array([-0.098, 0.121, -0.0002, 0.0003, -0.031]),
    )


def fisheye_camera() -> Camera:
    """A 1280x960 fisheye camera with about 130 degrees of horizontal field of view."""
    return Camera(
        model="fisheye",
        resolution=(1280, 960),
        matrix=np.array([563.0, 562.4, 642.2, 477.1]),
        distortion=np.array([-0.012, 0.004, -0.003, 0.0006]),
    )


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
    x, y, z = np.moveaxis(np.asarray(points_cam, dtype=float), -1, 0)
    if camera.model == "fisheye":
        radius = np.hypot(x, y)
        distorted = _fisheye_radius(_coefficients(camera), np.arctan2(radius, z))
        scale = distorted / np.where(radius > 0.0, radius, 1.0)
        return _to_pixels(camera, x * scale, y * scale)
    return _to_pixels(camera, *_brown(_coefficients(camera), x / z, y / z))


def rays(camera: Camera, px: FloatArray) -> FloatArray:
    """(..., 3) unit vectors in the camera frame, from (..., 2) pixels.

    Newton's method on the distortion. Outside the region where the distortion is monotonic, which
    contains the image of any real lens, the directions are meaningless.
    """
    fx, fy, cx, cy = camera.matrix
    x_bent, y_bent = (px[..., 0] - cx) / fx, (px[..., 1] - cy) / fy
    if camera.model == "fisheye":
        return _fisheye_rays(_coefficients(camera), x_bent, y_bent)
    x, y = _undo_brown(_coefficients(camera), x_bent, y_bent)
    directions = np.stack([x, y, np.ones_like(x)], axis=-1)
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


CAMERAS: Mapping[str, Camera] = {
    "wide": wide_camera(),
    "fine": fine_camera(),
    "fisheye": fisheye_camera(),
}


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


def _to_pixels(camera: Camera, x: FloatArray, y: FloatArray) -> FloatArray:
    fx, fy, cx, cy = camera.matrix
    return np.stack([fx * x + cx, fy * y + cy], axis=-1)


def _coefficients(camera: Camera) -> FloatArray:
    """The 8 Brown coefficients (missing ones zero), or the 4 fisheye coefficients."""
    given = np.asarray(camera.distortion, dtype=float).ravel()
    allowed = (4,) if camera.model == "fisheye" else (5, 8)
    if given.size not in allowed:
        raise DataError(
            f"simulation: a {camera.model} camera has {given.size} distortion coefficients, "
            f"{' or '.join(map(str, allowed))} are needed."
        )
    return given if camera.model == "fisheye" else np.pad(given, (0, 8 - given.size))


def _brown(coefficients: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    x_bent = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    y_bent = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return x_bent, y_bent


def _undo_brown(
    coefficients: FloatArray, x_bent: FloatArray, y_bent: FloatArray
) -> tuple[FloatArray, FloatArray]:
    x, y = x_bent.copy(), y_bent.copy()
    h = 1e-6
    for _ in range(20):
        distorted_x, distorted_y = _brown(coefficients, x, y)
        error_x, error_y = x_bent - distorted_x, y_bent - distorted_y
        right_x, right_y = _brown(coefficients, x + h, y)
        down_x, down_y = _brown(coefficients, x, y + h)
        a, b = (right_x - distorted_x) / h, (down_x - distorted_x) / h
        c, d = (right_y - distorted_y) / h, (down_y - distorted_y) / h
        determinant = a * d - b * c
        # Limited steps, against divergence at the rim of strong distortion.
        step_x = np.clip((d * error_x - b * error_y) / determinant, -0.3, 0.3)
        step_y = np.clip((a * error_y - c * error_x) / determinant, -0.3, 0.3)
        x, y = x + step_x, y + step_y
        if max(np.abs(step_x).max(), np.abs(step_y).max()) < 1e-14:
            break
    return x, y


def _fisheye_radius(coefficients: FloatArray, angle: FloatArray) -> FloatArray:
    k1, k2, k3, k4 = coefficients
    a2 = angle * angle
    return np.asarray(angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))))


def _fisheye_rays(coefficients: FloatArray, x_bent: FloatArray, y_bent: FloatArray) -> FloatArray:
    radius = np.hypot(x_bent, y_bent)
    factors = coefficients * np.array([3.0, 5.0, 7.0, 9.0])
    angle = radius.copy()
    for _ in range(20):
        a2 = angle * angle
        derivative = 1.0 + a2 * (
            factors[0] + a2 * (factors[1] + a2 * (factors[2] + a2 * factors[3]))
        )
        step = np.clip((radius - _fisheye_radius(coefficients, angle)) / derivative, -0.3, 0.3)
        angle = angle + step
        if np.abs(step).max() < 1e-14:
            break
    scale = np.sin(angle) / np.where(radius > 0.0, radius, 1.0)
    return np.stack([x_bent * scale, y_bent * scale, np.cos(angle)], axis=-1)
