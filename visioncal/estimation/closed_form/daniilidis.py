"""Daniilidis (1999): dual quaternions, rotation and translation in one null space.

K. Daniilidis, "Hand-eye calibration using dual quaternions", International Journal of Robotics
Research 18(3), 1999.
"""

import numpy as np

from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form import quaternions
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.pairs import pair_products, pair_up
from visioncal.estimation.closed_form.translation import complete


def _squares() -> FloatArray:
    """The (36, 16) map from sums of w w^T to sums of S^T S, with w = (a - b, a + b)."""
    # S = [[0, -(a - b)^T], [a - b, skew(a + b)]] is linear in w, hence S^T S in w w^T.
    rows = np.zeros((6, 4, 4))
    rows[:3, 0, 1:] = -np.eye(3)
    rows[:3, 1:, 0] = np.eye(3)
    rows[3:, 1:, 1:] = skew(np.eye(3))
    return np.asarray(np.einsum("krp,lrq->klpq", rows, rows).reshape(36, 16))


_SQUARES = _squares()

# Least squared norm of q in the unit 8-vector (q, q'): with less, X would be a kilometre long. The
# motion then does not determine q', and the null space contains little else.
_SMALLEST_PART = 1e-6


@solver
def daniilidis(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for X's dual quaternion in the null space of the screws' equations.

    With a, b the vector parts of a pair's quaternions and a', b' those of their dual parts, X's
    dual quaternion (q, q') is in the null space of the rows [S, 0] and [S', S], where S q = a q - q
    b (eq. 31); the two smallest singular vectors span it. Within that plane q . q' = 0 and |q| = 1
    (eqs. 34, 35) select the solution. The paper omits the scalar row of a q - q b as redundant;
    with it the result does not depend on the choice of axes.

    Only the rotation is taken from it: q' carries the noise of both screws' moments, so the
    translation is solved for again with the rotation known. One metre weighs as much as one radian.
    """
    squares = _screw_equations(robot, camera)
    quaternion = _study_point(np.linalg.eigh(squares)[1][:, :2])[:4]
    if quaternion @ quaternion < _SMALLEST_PART:
        quaternion = np.linalg.eigh(squares[:4, :4])[1][:, 0]
    return complete(robot, camera, quaternions.to_rotation(quaternion))


def _screw_equations(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """The (8, 8) sum T^T T of eq. 31 over all pairs."""
    conjugate = quaternions.CONJUGATE
    r, r_dual = _dual_quaternions(robot)
    c, c_dual = _dual_quaternions(camera)
    pairs = pair_up(r, c)
    a_dual = _dual_products(r * conjugate, r_dual * conjugate, r, r_dual)
    b_dual = _dual_products(c, c_dual, c * conjugate, c_dual * conjugate)

    sign = np.copysign(1.0, pairs.weight)
    a, b = pairs.robot[1:], sign * pairs.camera[1:]
    a_dual, b_dual = a_dual[1:], sign * b_dual[1:]
    w = np.concatenate([a - b, a + b, a_dual - b_dual, a_dual + b_dual])
    moments = (np.abs(pairs.weight) * w) @ w.T

    squares = np.empty((8, 8))
    real = _squared(moments[:6, :6])
    squares[:4, :4] = real + _squared(moments[6:, 6:])
    squares[4:, :4] = _squared(moments[:6, 6:])
    squares[:4, 4:] = squares[4:, :4].T
    squares[4:, 4:] = real
    return squares


def _squared(moments: FloatArray) -> FloatArray:
    return np.asarray((moments.reshape(36) @ _SQUARES).reshape(4, 4))


def _dual_quaternions(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both (m, 4) parts of (m, 4, 4) poses; the dual part is t q / 2 [m]."""
    real = quaternions.from_rotations(poses[:, :3, :3])
    half = 0.5 * poses[:, :3, 3]
    dual = np.empty_like(real)
    dual[:, 0] = -(half * real[:, 1:]).sum(axis=1)
    dual[:, 1:] = real[:, :1] * half + (skew(half) @ real[:, 1:, None])[..., 0]
    return real, dual


def _dual_products(
    left: FloatArray, left_dual: FloatArray, right: FloatArray, right_dual: FloatArray
) -> FloatArray:
    return pair_products(left, right_dual) + pair_products(left_dual, right)


def _study_point(plane: FloatArray) -> FloatArray:
    """The (8,) unit vector in the plane of two orthonormal columns that is a rigid transform."""
    # q . q' is a quadratic form in the combination's coefficients. In its eigenvectors' basis its
    # zeros are square roots of eigenvalues: no division, and no negative discriminant where noise
    # leaves no real zeros; then the nearest combination is taken. Of the two zeros one is the
    # solution and the other has q = 0. The vector is zero where the form is.
    form = plane[:4].T @ plane[4:]
    (low, high), vectors = np.linalg.eigh(form + form.T)
    weights = np.sqrt([max(high, 0.0), max(-low, 0.0)])
    weights /= max(np.hypot(*weights), np.finfo(float).tiny)
    zeros = plane @ vectors @ np.array([weights, weights * [1.0, -1.0]]).T
    return np.asarray(zeros[:, (zeros[:4] ** 2).sum(axis=0).argmax()])
