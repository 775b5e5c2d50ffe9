"""The camera model: OpenCV's projection with its analytic Jacobians, and the inverse.

Brown's model (Brown 1966, with OpenCV's rational extension) and the equidistant fisheye (Kannala
and Brandt 2006).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.types import Camera, FloatArray

# Newton's method converges quadratically; points that need more steps lie where the model has no
# inverse.
_INVERSE_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Projection:
    """Projected points and their Jacobians."""

    px: FloatArray  # (n, 2) pixels.
    # (n, 2, 3) Jacobian with respect to the point in the camera's frame [px/m].
    jacobian_point: FloatArray
    # (n, 2, 4 + k) Jacobian with respect to fx, fy, cx, cy and the k coefficients.
    jacobian_intrinsics: FloatArray


def intrinsics(camera: Camera) -> FloatArray:
    """The (4 + k,) vector of fx, fy, cx, cy and the distortion coefficients."""
    return np.concatenate([camera.matrix, camera.distortion])


def with_intrinsics(camera: Camera, values: FloatArray) -> Camera:
    """The camera with other (4 + k,) intrinsics."""
    return Camera(camera.model, camera.resolution, values[:4].copy(), values[4:].copy())


def matrix_3x3(camera: Camera) -> FloatArray:
    """The camera matrix in 3 x 3 form."""
    fx, fy, cx, cy = camera.matrix
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project(camera: Camera, points_cam: FloatArray) -> FloatArray:
    """Projects (n, 3) points in the camera's frame [m] to (n, 2) pixels.

    Points that are not in front of the camera give NaN.
    """
    return project_with_jacobian(camera, points_cam, lens=False).px


def project_with_jacobian(
    camera: Camera, points_cam: FloatArray, *, lens: bool = True
) -> Projection:
    """Projects points, with Jacobians with respect to points and intrinsics.

    Args:
        camera: Intrinsics.
        points_cam: (n, 3) points in the camera's frame [m].
        lens: Whether the intrinsics' Jacobian is needed.

    Returns:
        The projection; NaN for points that are not in front of the camera.
    """
    points = np.where(points_cam[:, 2:] > 0.0, points_cam, np.nan)
    return _projected(camera, camera.matrix, points, lens=lens)


def normalise(camera: Camera, px: FloatArray) -> FloatArray:
    """Inverse projection: pixels to points on the plane at unit depth.

    Args:
        camera: Intrinsics.
        px: (n, 2) pixels.

    Returns:
        (n, 2) coordinates x / z and y / z of the rays; NaN where the distortion cannot be inverted.
    """
    goal = (px - camera.matrix[2:]) / camera.matrix[:2]
    plane = _undistorted_fisheye(goal, camera) if camera.model == "fisheye" else goal.copy()

    def distort(plane: FloatArray) -> tuple[FloatArray, FloatArray]:
        points = np.column_stack([plane, np.ones(len(plane))])
        found = _projected(camera, np.array([1.0, 1.0, 0.0, 0.0]), points, lens=False)
        return found.px, found.jacobian_point[:, :, :2]

    for _ in range(_INVERSE_ITERATIONS):
        distorted, by_plane = distort(plane)
        error = goal - distorted
        if np.all(np.abs(error) < 1e-13):
            break
        # The map is singular beyond the fold of the distortion; those pixels do not converge.
        singular = np.abs(np.linalg.det(by_plane)) < 1e-6
        safe = np.where(singular[:, None, None], np.eye(2), by_plane)
        plane = plane + np.linalg.solve(safe, error[:, :, None])[:, :, 0]
    distorted, by_plane = distort(plane)
    # Beyond the fold the map has other branches: flipped, or mirrored through the centre.
    valid_branch = (np.linalg.det(by_plane) > 0) & (np.sum(plane * goal, axis=1) >= 0)
    converged = valid_branch & np.all(np.abs(goal - distorted) < 1e-9, axis=1)
    return np.where(converged[:, None], plane, np.nan)


def _undistorted_fisheye(goal: FloatArray, camera: Camera) -> FloatArray:
    """Start for the Newton iteration in the plane: Newton's method on the angle alone."""
    radius = np.linalg.norm(goal, axis=1)
    theta = np.minimum(radius, 1.5)
    k = camera.distortion
    for _ in range(_INVERSE_ITERATIONS):
        t2 = theta**2
        value = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        derivative = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
        theta = np.clip(theta - (value - radius) / derivative, 0.0, 1.57)
    scale = np.where(radius > 1e-12, np.tan(theta) / np.maximum(radius, 1e-12), 1.0)
    return goal * scale[:, None]


def _projected(
    camera: Camera, fx_fy_cx_cy: FloatArray, points: FloatArray, *, lens: bool
) -> Projection:
    """Projects points (n, 3) with another matrix, by OpenCV."""
    count, size = len(points), len(camera.distortion)
    if not count:
        columns = 4 + size if lens else 0
        return Projection(np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2, columns)))
    fx, fy, cx, cy = fx_fy_cx_cy
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    places, none = np.ascontiguousarray(points, float)[:, None], np.zeros(3)
    if camera.model == "fisheye":
        px, full = cv2.fisheye.projectPoints(places, none, none, matrix, camera.distortion)
        # Of matrix and coefficients, rotation, translation, skew.
        by_lens, by_point = slice(0, 4 + size), slice(7 + size, 10 + size)
    else:
        px, full = cv2.projectPoints(places, none, none, matrix, camera.distortion)
        # Of rotation, translation, matrix and coefficients.
        by_lens, by_point = slice(6, 10 + size), slice(3, 6)
    jacobian = np.asarray(full, float).reshape(count, 2, -1)
    by_intrinsics = jacobian[:, :, by_lens if lens else slice(0)]
    parts = map(np.ascontiguousarray, (jacobian[:, :, by_point], by_intrinsics))
    return Projection(np.asarray(px, float).reshape(-1, 2), *parts)


def turned_back(px: FloatArray, size: tuple[int, int], quarters: int) -> FloatArray:
    """(n, 2) pixels of a picture that was turned clockwise, as they were.

    Args:
        px: Pixels of the turned picture, pixel centres at integers.
        size: (width, height) of the picture before [px].
        quarters: By how many quarters it was turned: 1, 2 or 3.
    """
    u, v = np.asarray(px, float).T
    last_u, last_v = size[0] - 1, size[1] - 1
    back = {1: (v, last_v - u), 2: (last_u - u, last_v - v), 3: (last_u - v, u)}
    return np.column_stack(back[quarters])
