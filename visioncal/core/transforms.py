"""Batched rigid transforms, SE(3), as arrays.

Public interfaces use `scipy.spatial.transform.RigidTransform`; solvers and the estimator use plain
(m, 4, 4) arrays. Twists are (rotation [rad], translation [m]) and
perturbations act on the right, in the local frame: `T * exp(twist)`.
"""

import numpy as np

from visioncal.core.types import FloatArray, Mount

# Arms are off by some 0.5 mm for each mrad.
LEVER_M = 0.5

# Tolerance of rotation matrices, which are given with five digits or more.
RIGID = 1e-4
LAST_ROW = (0.0, 0.0, 0.0, 1.0)


def invert(matrices: FloatArray) -> FloatArray:
    """Inverts rigid transforms: (..., 4, 4) `a_from_b` to `b_from_a`."""
    inverse = np.zeros_like(matrices)
    rotation_t = np.swapaxes(matrices[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation_t
    inverse[..., :3, 3] = -(rotation_t @ matrices[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def compose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Builds (..., 4, 4) transforms from (..., 3, 3) rotations and (..., 3) translations [m]."""
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    matrices = np.zeros((*shape, 4, 4))
    matrices[..., :3, :3] = rotation
    matrices[..., :3, 3] = translation
    matrices[..., 3, 3] = 1.0
    return matrices


def apply(matrices: FloatArray, points: FloatArray) -> FloatArray:
    """Applies (..., 4, 4) transforms to (..., n, 3) points."""
    turned = points @ np.swapaxes(matrices[..., :3, :3], -1, -2)
    return np.asarray(turned + matrices[..., None, :3, 3])


def apply_each(matrices: FloatArray, points: FloatArray) -> FloatArray:
    """Applies (n, 4, 4) transforms to one point each, (n, 3)."""
    return np.asarray((matrices[:, :3, :3] @ points[:, :, None])[:, :, 0] + matrices[:, :3, 3])


def skew(vectors: FloatArray) -> FloatArray:
    """Cross-product matrices (..., 3, 3) of (..., 3) vectors."""
    matrices = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices[..., 0, 1], matrices[..., 0, 2] = -z, y
    matrices[..., 1, 0], matrices[..., 1, 2] = z, -x
    matrices[..., 2, 0], matrices[..., 2, 1] = -y, x
    return matrices


def cross(vectors: FloatArray, others: FloatArray) -> FloatArray:
    """Cross products (..., 3); for few vectors five times as fast as numpy's."""
    after, before = [1, 2, 0], [2, 0, 1]
    products = vectors[..., after] * others[..., before]
    return np.asarray(products - vectors[..., before] * others[..., after])


def exp(twists: FloatArray) -> FloatArray:
    """Exponential map: (..., 6) twists (rotation [rad], translation [m]) to (..., 4, 4).

    Rodrigues' formula, component by component, takes half of the time of scipy's.
    """
    wx, wy, wz, tx, ty, tz = np.ascontiguousarray(twists.reshape(-1, 6).T)
    # No angle is zero: what would need a series there is multiplied by squares of the rotation.
    angle = np.sqrt(np.maximum(wx * wx + wy * wy + wz * wz, 1e-300))
    sinc, half = np.sin(angle) / angle, np.sin(0.5 * angle) / angle
    versine, rest = 2.0 * half * half, (1.0 - sinc) / (angle * angle)
    sx, sy, sz = sinc * wx, sinc * wy, sinc * wz
    vx, vy, vz = versine * wx, versine * wy, versine * wz
    cx, cy, cz = wy * tz - wz * ty, wz * tx - wx * tz, wx * ty - wy * tx
    matrices = np.zeros((len(angle), 4, 4))
    entries = matrices.reshape(-1, 16).T
    entries[0], entries[1], entries[2] = 1.0 - vy * wy - vz * wz, vx * wy - sz, vx * wz + sy
    entries[4], entries[5], entries[6] = vx * wy + sz, 1.0 - vx * wx - vz * wz, vy * wz - sx
    entries[8], entries[9], entries[10] = vx * wz - sy, vy * wz + sx, 1.0 - vx * wx - vy * wy
    entries[3] = tx + versine * cx + rest * (wy * cz - wz * cy)
    entries[7] = ty + versine * cy + rest * (wz * cx - wx * cz)
    entries[11] = tz + versine * cz + rest * (wx * cy - wy * cx)
    entries[15] = 1.0
    return matrices.reshape(*twists.shape[:-1], 4, 4)


def log(matrices: FloatArray) -> FloatArray:
    """Logarithm map: (..., 4, 4) transforms to (..., 6) twists, the inverse of `exp`.

    By the quaternion of each rotation (Shepperd 1978): scipy orthogonalises every matrix first,
    which takes five times as long.
    """
    flat = matrices.reshape(-1, 4, 4)
    vector, scalar = quaternions(flat[:, :3, :3])
    sine = np.sqrt(np.sum(vector**2, axis=1))
    half = np.arctan2(sine, np.abs(scalar))
    scale = 2.0 * half / np.maximum(sine, np.finfo(float).tiny)
    rotation = np.copysign(scale, scalar)[:, None] * vector
    squared = 4.0 * half**2
    # 1 / angle^2 - cot(angle / 2) / (2 angle), by its series where it cancels.
    is_small = squared < 1e-4
    half, angle_sq = np.where(is_small, 1.0, half), np.where(is_small, 1.0, squared)
    coefficient = np.where(is_small, _log_series(squared), (1.0 - half / np.tan(half)) / angle_sq)
    translation = flat[:, :3, 3]
    crossed = cross(rotation, translation)
    result = translation - 0.5 * crossed + coefficient[:, None] * cross(rotation, crossed)
    return np.concatenate([rotation, result], axis=1).reshape(*matrices.shape[:-2], 6)


def quaternions(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Vector parts (m, 3) and scalars (m,) of the quaternions of (m, 3, 3) rotations.

    They are not normalised.
    """
    diagonal = np.diagonal(rotations, axis1=1, axis2=2)
    trace = diagonal.sum(axis=1)
    after, before = [2, 0, 1], [1, 2, 0]
    vector, scalar = rotations[:, after, before] - rotations[:, before, after], 1.0 + trace
    # Relative to the largest component, since a small one is mostly rounding.
    large = np.flatnonzero(trace < 0.0)
    if len(large):
        axis = diagonal[large].argmax(axis=1)
        scalar[large] = vector[large, axis]
        vector[large] = rotations[large, axis] + rotations[large, :, axis]
        vector[large, axis] = 1.0 + 2.0 * diagonal[large, axis] - trace[large]
    return vector, scalar


def _log_series(squared: FloatArray) -> FloatArray:
    """1 / x^2 - cot(x / 2) / (2 x) as a series in x^2, to 1e-9 up to x = 0.5."""
    return 1 / 12 + squared * (1 / 720 + squared * (1 / 30240 + squared / 1209600))


def adjoint(matrices: FloatArray) -> FloatArray:
    """Adjoints (..., 6, 6), which transform (rotation, translation) twists from frame b to frame a.

    `a_from_b * exp(twist_b) = exp(adjoint(a_from_b) @ twist_b) * a_from_b`.
    """
    rotation = matrices[..., :3, :3]
    adjoints = np.zeros((*matrices.shape[:-2], 6, 6))
    adjoints[..., :3, :3] = rotation
    adjoints[..., 3:, 3:] = rotation
    adjoints[..., 3:, :3] = skew(matrices[..., :3, 3]) @ rotation
    return adjoints


def inverse_right_jacobian(twists: FloatArray) -> FloatArray:
    """Derivative (..., 6, 6) of `log(exp(twist) * exp(step))` over the step, at zero.

    The series in the adjoint of the twist with Bernoulli numbers (Iserles, Munthe-Kaas, Norsett and
    Zanna 2000, Lie-group methods, section 2) converges for rotations under 2 pi, and is truncated
    to an error of 1e-9 up to 0.5 rad. Beyond, it still gives descent directions, which suffice far
    from a minimum. The lower left block is the derivative of the upper left one along the
    translation, as for dual rotations.
    """
    # Components first: sums over rows of three numbers would take most of the time.
    rotation, translation = np.ascontiguousarray(twists.reshape(-1, 6).T).reshape(2, 3, -1)
    squared, dot = np.sum(rotation**2, axis=0), np.sum(rotation * translation, axis=0)
    coefficient = _log_series(squared)
    derivative = 1 / 720 + squared * (2 / 30240 + squared * 3 / 1209600)
    # Squares of cross-product matrices are outer products of the vectors, but for a diagonal.
    mixed = (coefficient * translation + dot * derivative * rotation)[:, None] * rotation
    jacobian, axes = np.zeros((6, 6, len(squared))), np.arange(3)
    jacobian[:3, :3], jacobian[3:, :3] = (
        (coefficient * rotation)[:, None] * rotation,
        mixed + np.swapaxes(mixed, 0, 1),
    )
    jacobian[axes, axes] += 1.0 - coefficient * squared
    jacobian[3 + axes, axes] -= 2.0 * dot * (coefficient + derivative * squared)
    for row, vector in ((0, 0.5 * rotation), (3, 0.5 * translation)):
        after, before = [2, 0, 1], [1, 2, 0]
        jacobian[[row + index for index in after], before] += vector
        jacobian[[row + index for index in before], after] -= vector
    jacobian[3:, 3:] = jacobian[:3, :3]
    return np.ascontiguousarray(jacobian.transpose(2, 0, 1)).reshape(*twists.shape, 6)


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """Projects (..., 3, 3) matrices onto the nearest rotations in the Frobenius norm.

    Umeyama (1991): the orthogonal Procrustes solution with determinant +1.
    """
    u, _, vt = np.linalg.svd(matrices)
    sign = np.ones(matrices.shape[:-1])
    sign[..., -1] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * sign[..., None, :]) @ vt)


def mean_transform(matrices: FloatArray) -> FloatArray:
    """Mean of (m, 4, 4) transforms: chordal mean rotation and mean translation, as (4, 4)."""
    return compose(
        nearest_rotation(matrices[:, :3, :3].mean(axis=0)), matrices[:, :3, 3].mean(axis=0)
    )


def rotation_angle(matrices: FloatArray) -> FloatArray:
    """Angles [rad] of (..., 3, 3) or (..., 4, 4) rotations, accurate near 0 and near pi."""
    flat = matrices[..., :3, :3].reshape(-1, 3, 3)
    vector, scalar = quaternions(flat)
    angles = 2.0 * np.arctan2(np.linalg.norm(vector, axis=1), np.abs(scalar))
    return np.asarray(angles.reshape(matrices.shape[:-2]))


def distances(poses: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (m,) [m] and angles (m,) [rad] of (m, 4, 4) poses from one pose, or one each."""
    return (
        np.linalg.norm(poses[:, :3, 3] - others[..., :3, 3], axis=1),
        rotation_angle(invert(others) @ poses),
    )


def pose_difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance between the origins [mm] and angle [deg] of two (4, 4) poses in one frame."""
    between = invert(a) @ b
    return 1e3 * float(np.linalg.norm(between[:3, 3])), float(np.rad2deg(rotation_angle(between)))


def rigid_fault(matrix: FloatArray, most: float = RIGID) -> str:
    """Why a (4, 4) matrix is no rigid transform; empty where it is one.

    `most` is the tolerance of the entries of the rotation's product with its transpose.
    """
    if matrix.shape != (4, 4):
        return f"its shape is {matrix.shape}"
    if not np.isfinite(matrix).all():
        return "it has entries that are not finite"
    if not np.allclose(matrix[3], LAST_ROW, atol=most):
        row = ", ".join(f"{value:.4g}" for value in matrix[3])
        return f"its last row is [{row}], but must be [0, 0, 0, 1]; it may be transposed"
    # Squares of the largest numbers overflow.
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrix[:3, :3].T @ matrix[:3, :3] - np.eye(3)).max()
    if not error < most:
        return (
            "the columns of its rotation are no unit vectors at right angles: they are off by "
            f"{error:.2g}, and {most:g} is allowed"
        )
    return "" if np.linalg.det(matrix[:3, :3]) > 0.0 else "its rotation is a reflection"


def robot_part(base_from_flange: FloatArray, mount: Mount) -> FloatArray:
    """Robot transforms (m, 4, 4) of the chain `robot * x * camera = z`."""
    return base_from_flange if mount == "eye-in-hand" else invert(base_from_flange)


def distances_m(poses: FloatArray, predicted: FloatArray) -> FloatArray:
    """Distances (...) [m] of (..., 4, 4) poses from predicted ones, rotations on a lever."""
    between = invert(predicted) @ poses
    return np.asarray(
        np.linalg.norm(between[..., :3, 3], axis=-1) + LEVER_M * rotation_angle(between)
    )
