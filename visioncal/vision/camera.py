"""The camera model: projection with analytic Jacobians, and its inverse.

Brown's model (Brown 1966, with the rational extension of OpenCV) and the equidistant fisheye
(Kannala and Brandt 2006), both in OpenCV's parameters, so that matrices can be exchanged.
"""

from dataclasses import dataclass

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
    return project_with_jacobian(camera, points_cam).px


def project_with_jacobian(
    camera: Camera, points_cam: FloatArray, *, lens: bool = True
) -> Projection:
    """Projects points, with Jacobians with respect to points and intrinsics.

    Args:
        camera: Intrinsics.
        points_cam: (n, 3) points in the camera's frame [m].
        lens: Whether to compute the intrinsics' Jacobian; it takes a third of the time.

    Returns:
        The projection; NaN for points that are not in front of the camera.
    """
    depth = np.where(points_cam[:, 2] > 0.0, points_cam[:, 2], np.nan)
    plane = points_cam[:, :2] / depth[:, None]
    distorted, by_plane = _distort(camera, plane)
    focal, centre = camera.matrix[:2], camera.matrix[2:]

    by_point = np.empty((len(plane), 2, 3))
    by_point[:, :, :2] = by_plane * (focal[:, None] / depth[:, None, None])
    x, y = plane[:, :1], plane[:, 1:]
    by_point[:, :, 2] = -(by_point[:, :, 0] * x + by_point[:, :, 1] * y)

    by_intrinsics = np.zeros((len(plane), 2, 4 + len(camera.distortion) if lens else 0))
    if lens:
        by_intrinsics[:, [0, 1], [0, 1]] = distorted
        by_intrinsics[:, [0, 1], [2, 3]] = 1.0
        by_intrinsics[:, :, 4:] = focal[:, None] * (
            _fisheye_by_coefficients(plane)
            if camera.model == "fisheye"
            else _brown_by_coefficients(plane, camera.distortion)
        )
    return Projection(distorted * focal + centre, by_point, by_intrinsics)


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
    for _ in range(_INVERSE_ITERATIONS):
        distorted, by_plane = _distort(camera, plane)
        error = goal - distorted
        if np.all(np.abs(error) < 1e-13):
            break
        # The map is singular beyond the fold of the distortion; those pixels do not converge.
        singular = np.abs(np.linalg.det(by_plane)) < 1e-6
        safe = np.where(singular[:, None, None], np.eye(2), by_plane)
        plane = plane + np.linalg.solve(safe, error[:, :, None])[:, :, 0]
    distorted, by_plane = _distort(camera, plane)
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


def _distort(camera: Camera, plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorts (n, 2) plane points; returns points and (n, 2, 2) Jacobian."""
    if camera.model == "fisheye":
        return _distort_fisheye(plane, camera.distortion)
    return _distort_brown(plane, camera.distortion)


def _distort_brown(plane: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, p1, p2, k3 = coefficients[:5]
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial_derivative = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    if len(coefficients) == 8:
        k4, k5, k6 = coefficients[5:]
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = radial / denominator
        radial_derivative = (
            radial_derivative - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
        ) / denominator
    cross = x * y
    tangential_x, tangential_y = r2 + 2 * x * x, r2 + 2 * y * y
    distorted = np.empty_like(plane)
    distorted[:, 0] = x * radial + 2 * p1 * cross + p2 * tangential_x
    distorted[:, 1] = y * radial + p1 * tangential_y + 2 * p2 * cross

    by_plane = np.empty((len(x), 2, 2))
    by_plane[:, 0, 0] = radial + 2 * x * x * radial_derivative + 2 * p1 * y + 6 * p2 * x
    by_plane[:, 0, 1] = 2 * cross * radial_derivative + 2 * p1 * x + 2 * p2 * y
    by_plane[:, 1, 0] = by_plane[:, 0, 1]
    by_plane[:, 1, 1] = radial + 2 * y * y * radial_derivative + 6 * p1 * y + 2 * p2 * x
    return distorted, by_plane


def _brown_by_coefficients(plane: FloatArray, coefficients: FloatArray) -> FloatArray:
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    r4, r6 = r2 * r2, r2 * r2 * r2
    rational = len(coefficients) == 8
    denominator = np.ones_like(r2)
    if rational:
        k4, k5, k6 = coefficients[5:]
        denominator = 1 + k4 * r2 + k5 * r4 + k6 * r6

    by_coefficients = np.empty((len(x), 2, len(coefficients)))
    scaled = plane / denominator[:, None]
    for column, power in ((0, r2), (1, r4), (4, r6)):
        by_coefficients[:, :, column] = scaled * power[:, None]
    by_coefficients[:, 0, 2], by_coefficients[:, 1, 2] = 2 * x * y, r2 + 2 * y * y
    by_coefficients[:, 0, 3], by_coefficients[:, 1, 3] = r2 + 2 * x * x, 2 * x * y
    if rational:
        k1, k2, k3 = coefficients[[0, 1, 4]]
        radial = (1 + k1 * r2 + k2 * r4 + k3 * r6) / denominator
        for column, power in ((5, r2), (6, r4), (7, r6)):
            by_coefficients[:, :, column] = -scaled * (radial * power)[:, None]
    return by_coefficients


def _distort_fisheye(plane: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, k3, k4 = coefficients
    r = _radius(plane)
    theta = np.arctan(r)
    t2 = theta * theta
    distorted_angle = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = distorted_angle / r
    angle_derivative = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    # d(scale)/dr divided by r, so that it multiplies plane (x) plane below.
    scale_derivative = (angle_derivative / (1 + r * r) - scale) / (r * r)
    by_plane = scale_derivative[:, None, None] * plane[:, :, None] * plane[:, None, :]
    by_plane[:, [0, 1], [0, 1]] += scale[:, None]
    return plane * scale[:, None], by_plane


def _fisheye_by_coefficients(plane: FloatArray) -> FloatArray:
    r = _radius(plane)
    theta = np.arctan(r)
    t2 = theta * theta
    powers = np.stack([t2, t2**2, t2**3, t2**4], axis=1) * (theta / r)[:, None]
    return plane[:, :, None] * powers[:, None, :]


def _radius(plane: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(np.linalg.norm(plane, axis=1), 1e-9))
