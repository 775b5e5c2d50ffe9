"""Closed-form hand-eye solvers: starts for the joint fit, and a second opinion on it.

A view i pairs a robot pose `R_i` with a camera pose `C_i = cam_from_target`. Two transforms are
unknown and obey `R_i @ X @ C_i = Z`:

- eye-in-hand: `R_i = base_from_flange`, `X = flange_from_cam`, `Z = base_from_target`;
- eye-to-hand: `R_i = flange_from_base`, `X = base_from_cam`, `Z = flange_from_target`.

Two views i and j eliminate Z: `A @ X = X @ B` with `A = inv(R_j) @ R_i`, `B = C_j @ inv(C_i)`. Of
more than a hundred views only those in random groups are paired, which loses 1 % of the information
and keeps the work linear in the number of views.

The solvers differ in the rotation of X. The vector part sin(angle / 2) * axis of a relative
rotation's quaternion moves across its axis by the same noise at every angle, so that plain least
squares weights pairs of small rotation correctly. Near 180 degrees its sign is lost in noise: the
weight of such pairs falls continuously to zero. Motion too poor to determine X gives a finite but
poor solution here; it is refused later, where the Fisher information is known.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, wraps
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose, exp, invert, nearest_rotation, quaternions, skew
from visioncal.core.types import FloatArray, IntArray

_GROUP = 100  # Views whose pairs are all taken, as their number grows by the square.
# Scalar products of the quaternions from which pairs count in full: up to 165 degrees.
_FULL_WEIGHT = float(np.cos(np.radians(82.5)) ** 2)
# The identity and the half turns about x, y, z.
_FRAMES = np.array([np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])], float)


@dataclass(frozen=True, eq=False)
class HandEye:
    """Both unknown transforms."""

    # (..., 4, 4) X: `flange_from_cam` (eye-in-hand) or `base_from_cam` (eye-to-hand) [m].
    x: FloatArray
    z: FloatArray  # (..., 4, 4) Z: `base_from_target` or `flange_from_target` [m].


Solver: TypeAlias = Callable[[FloatArray, FloatArray], HandEye]
# Of robot and camera poses (m, 4, 4): the rotation of X (3, 3), or those of X and Z.
_Rotations: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray | tuple[FloatArray, ...]]


def _completed(rotations: _Rotations) -> Solver:
    """Decorates rotations to a solver of two views or more."""

    @wraps(rotations)
    def solve(robot: FloatArray, camera: FloatArray) -> HandEye:
        found = rotations(robot, camera)
        return complete(robot, camera, *(found if isinstance(found, tuple) else (found,)))

    return solve


@dataclass(frozen=True, eq=False)
class Pairs:
    """Relative motions of n pairs of views, as quaternions with a scalar part of 0 or more."""

    robot: FloatArray  # (..., 4, n) of A, the scalar first.
    camera: FloatArray  # (..., 4, n) of B.
    weight: FloatArray  # (..., n) from 0 to 1.
    views: tuple[IntArray, IntArray]  # (n,) first views i, and second ones j.

    @property
    def matched(self) -> FloatArray:
        """(..., 3, 3) weighted sum of the products of both vector parts."""
        weighted = self.weight[..., None, :] * self.robot[..., 1:, :]
        return np.asarray(weighted @ np.swapaxes(self.camera[..., 1:, :], -1, -2))


@lru_cache(maxsize=8)
def upper_pairs(count: int) -> tuple[IntArray, IntArray]:
    """First and second indices (p,) of all pairs of so many, the first one the smaller."""
    return np.triu_indices(count, 1)


def rotation_pairs(robot: FloatArray, camera: FloatArray) -> Pairs:
    """Forms the relative motions of pairs of (..., m, 4, 4) views."""
    views = robot.shape[-3]
    order = np.random.default_rng(0).permutation(views) if views > _GROUP else np.arange(views)
    groups = np.array_split(order, -(-views // _GROUP))
    group_pairs = [upper_pairs(len(group)) for group in groups]
    first, second = (
        np.concatenate([group[pair[at]] for group, pair in zip(groups, group_pairs, strict=True)])
        for at in (0, 1)
    )
    # Relative quaternions take a third of the time of relative matrices.
    by_robot, from_camera = _quaternions(robot), _quaternions(camera)
    from_camera[..., 1:, :] *= -1.0
    by_robot, by_camera = (_relative(unit, first, second) for unit in (by_robot, from_camera))
    weight = np.minimum(by_robot[..., 0, :] * by_camera[..., 0, :] / _FULL_WEIGHT, 1.0)
    return Pairs(by_robot, by_camera, weight, (first, second))


def _quaternions(motions: FloatArray) -> FloatArray:
    """Unit quaternions (..., 4, n) of (..., n, 4, 4) motions, the scalar first."""
    vector, scalar = quaternions(motions[..., :3, :3].reshape(-1, 3, 3))
    scalar_first = np.concatenate([scalar[:, None], vector], axis=1)
    unit = scalar_first / np.sqrt(np.sum(scalar_first**2, axis=1))[:, None]
    return np.swapaxes(unit.reshape(*motions.shape[:-2], 4), -1, -2)


def _relative(unit: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """Quaternions (..., 4, n) of `inv(q_j) q_i`, the scalar not negative, of (..., 4, m) units."""
    q, p = np.take(unit, first, axis=-1), np.take(unit, second, axis=-1)
    (qw, qx, qy, qz), (pw, px, py, pz) = ([each[..., at, :] for at in range(4)] for each in (q, p))
    found = np.empty(q.shape)
    scalar = pw * qw + px * qx + py * qy + pz * qz
    sign = np.copysign(1.0, scalar)
    found[..., 0, :] = np.abs(scalar)
    found[..., 1, :] = sign * (pw * qx - px * qw - py * qz + pz * qy)
    found[..., 2, :] = sign * (pw * qy - py * qw - pz * qx + px * qz)
    found[..., 3, :] = sign * (pw * qz - pz * qw - px * qy + py * qx)
    return found


def _rotation(quaternion: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


@_completed
def tsai(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """R. Y. Tsai, R. K. Lenz, IEEE Trans. Robotics and Automation 5(3), 1989.

    A pair obeys (P_g + P_c) x P' = P_c - P_g (eq. 12), with P = 2 sin(angle / 2) axis of both
    relative rotations and P' = tan(angle / 2) axis of X, which is infinite for a half turn.
    Therefore the camera's vectors are first rotated by the best conditioned of four known
    rotations, and then by the solution of that, so that the result does not depend on the choice of
    the camera's axes.
    """
    pairs = rotation_pairs(robot, camera)
    g, c, mixed = pairs.robot[1:], pairs.camera[1:], pairs.matched
    moments = (pairs.weight * g) @ g.T, (pairs.weight * c) @ c.T

    def normal_equations(frames: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal matrices (..., 3, 3) [rad^2] and right sides (..., 3) in rotated frames."""
        turned = mixed @ np.swapaxes(frames, -1, -2)
        turned_t = np.swapaxes(turned, -1, -2)
        outer = moments[0] + frames @ moments[1] @ np.swapaxes(frames, -1, -2) + turned + turned_t
        normals = np.trace(outer, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - outer
        # (g + c) x (c - g) = 2 g x c, and the entries of g x c are differences of those of g c^T.
        return normals, -2.0 * (turned - turned_t)[..., [1, 2, 0], [2, 0, 1]]

    frame: FloatArray = _FRAMES[np.linalg.eigvalsh(normal_equations(_FRAMES)[0])[:, 0].argmax()]
    for _ in range(2):
        normal, right = normal_equations(frame)
        # Less is rounding [rad^2].
        rodrigues = _smallest_solution(normal, right, 1e-14 * pairs.weight.size)
        frame = _rotation(np.array([1.0, *rodrigues])) @ frame
    return frame


@_completed
def park(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """F. C. Park, B. J. Martin, IEEE Trans. Robotics and Automation 10(5), 1994.

    With log A = [alpha], log B = [beta] a pair obeys alpha = R_X beta. The least squares solution
    is (M^T M)^(-1/2) M^T with M = sum beta alpha^T; the singular value decomposition gives it even
    where M is rank deficient. For (...,) sets at once.
    """
    pairs = rotation_pairs(robot, camera)
    alpha, beta = (_half_logarithms(part) for part in (pairs.robot, pairs.camera))
    return nearest_rotation((pairs.weight[..., None, :] * alpha) @ np.swapaxes(beta, -1, -2))


def _half_logarithms(unit: FloatArray) -> FloatArray:
    """Half the (..., 3, n) rotation vectors [rad] of (..., 4, n) quaternions."""
    sine = np.sqrt(np.sum(unit[..., 1:, :] ** 2, axis=-2, keepdims=True))
    angle = np.arctan2(sine, unit[..., :1, :])
    return np.asarray(angle / np.maximum(sine, np.finfo(float).tiny) * unit[..., 1:, :])


@_completed
def horaud(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """R. Horaud, F. Dornaika, International Journal of Robotics Research 14(3), 1995.

    A pair obeys a q = q b with the vector parts a and b. The quaternion q that minimises the sum of
    |a q - q b|^2, the paper's eigenvector, is that of the rotation nearest to sum a b^T. The
    paper's a and b are unit axes; here they keep their length sin(angle / 2), which weights the
    pairs by their noise.
    """
    return nearest_rotation(rotation_pairs(robot, camera).matched)


@_completed
def daniilidis(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """K. Daniilidis, International Journal of Robotics Research 18(3), 1999.

    With a, b the vector parts of a pair's quaternions and a', b' those of their dual parts, X's
    dual quaternion (q, q') is in the null space of the rows [S, 0] and [S', S], where S q = a q - q
    b (eq. 31); the two smallest singular vectors span it. Within that plane q . q' = 0 and |q| = 1
    (eqs. 34, 35) select the solution. The paper omits the scalar row of a q - q b as redundant;
    with it the result does not depend on the choice of axes. One metre weighs as much as a radian.
    """
    pairs = rotation_pairs(robot, camera)
    i, j = pairs.views
    motions = invert(robot)[j] @ robot[i], camera[j] @ invert(camera)[i]
    (a, a_dual), (b, b_dual) = (
        (unit[1:], 0.5 * (unit[0] * shift + np.cross(shift, unit[1:], axis=0)))
        for unit, shift in zip(
            (pairs.robot, pairs.camera), (motion[:, :3, 3].T for motion in motions), strict=True
        )
    )
    scale = np.sqrt(pairs.weight)
    real, dual = ((scale * _commutators(*at)).reshape(4, -1) for at in ((a, b), (a_dual, b_dual)))
    square, mixed = real @ real.T, dual @ real.T
    squares = np.block([[square + dual @ dual.T, mixed], [mixed.T, square]])
    quaternion = _study_point(np.linalg.eigh(squares)[1][:, :2])[:4]
    # With a smaller q, X would be a kilometre long, and the motion does not determine q'.
    if quaternion @ quaternion < 1e-6:
        quaternion = np.linalg.eigh(squares[:4, :4])[1][:, 0]
    return _rotation(quaternion)


def _commutators(a: FloatArray, b: FloatArray) -> FloatArray:
    """(4, 4, n) transposed matrices S of S q = a q - q b, for (3, n) vectors a and b."""
    matrices = np.zeros((4, 4, a.shape[1]))
    matrices[1:, 0], matrices[0, 1:] = b - a, a - b
    matrices[1:, 1:] = np.moveaxis(skew((a + b).T), 0, -1).swapaxes(0, 1)
    return matrices


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


@_completed
def andreff(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """N. Andreff, R. Horaud, B. Espiau, 3-D Digital Imaging and Modeling, 1999.

    A pair obeys (I - kron(A_R, B_R)) vec(R_X) = 0 and kron(I, t_B^T) vec(R_X) + (I - A_R) t_X = t_A
    (eq. 10). Summed over all pairs both are the scatter of each view's Z, the second that of the
    target's point half-way to the camera. The system is solved up to scale, with t_A times a free
    factor; otherwise it collapses to R_X = 0 where the flange rotates about a fixed point.
    """
    seen = _half_way(camera)
    rows = np.empty((len(robot), 3, 13))
    rows[:, :, :4] = robot[:, :3, :]
    rows[:, :, 4:] = (robot[:, :3, :3, None] * seen[:, None, None, :]).reshape(-1, 3, 9)
    return np.asarray(_rotations(_least_scatter(_rotation_maps(robot, camera), rows))[0])


@_completed
def shah(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, ...]:
    """M. Shah, Journal of Mechanisms and Robotics 5(3), 2013.

    R_i R_X C_i = R_Z makes vec(R_X) and vec(R_Z) the singular vectors of K = sum kron(R_i, C_i^T)
    for its largest singular value, which is m without noise. As the terms of K are orthogonal, m -
    |K x|^2 / m is their scatter at a unit vector x, and is minimised as such: the singular values
    of K themselves are nearly equal where all tilts are small.
    """
    maps = _rotation_maps(robot, camera)
    vector_x = _least_scatter(maps)
    return tuple(_rotations(vector_x, (maps @ vector_x).sum(axis=0)))


@_completed
def li(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, ...]:
    """A. Li, L. Wang, D. Wu, International Journal of the Physical Sciences 5(10), 2010.

    With D_i = inv(C_i) a view obeys kron(R_i, C_i^T) vec(R_X) = vec(R_Z) and R_i t_X + t_i = R_Z
    d_i + t_Z (eq. 19, where A = R_i and B = D_i), solved up to scale as in `andreff`.
    """
    rows = np.zeros((len(robot), 3, 13))
    rows[:, :, :4] = robot[:, :3, :]
    # -d_i: from the camera to the target's origin, in the target's axes.
    origins = (camera[:, None, :3, 3] @ camera[:, :3, :3])[:, 0]
    for axis in range(3):
        rows[:, axis, 4 + 3 * axis : 7 + 3 * axis] = origins
    to_x = _rotation_maps(robot, camera).swapaxes(1, 2)
    vector_z = _least_scatter(to_x, rows)
    return tuple(_rotations((to_x @ vector_z).sum(axis=0), vector_z))


def _rotation_maps(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """The (m, 9, 9) orthogonal matrices kron(R_i, C_i^T), which map vec(R_X) to vec(R_Z).

    vec() stacks the rows of a matrix.
    """
    products = np.einsum("mab,mcd->madbc", robot[:, :3, :3], camera[:, :3, :3])
    return np.asarray(products.reshape(-1, 9, 9))


def _least_scatter(maps: FloatArray, rows: FloatArray | None = None) -> FloatArray:
    """Minimises the scatter of the entries' images under the views' maps, up to scale.

    The mean image is eliminated by centring, and other unknowns by a QR decomposition. Normal
    equations would lose half of the digits, which small tilts need.

    Args:
        maps: (m, 9, 9) maps from the entries to an image that all views share.
        rows: (m, k, n + 9) coefficients of n other unknowns and of the 9 entries in further
            equations, with an unknown constant of their own that all views share.

    Returns:
        (9,) entries, of length 1 and of either sign.
    """
    system = maps
    if rows is not None:
        system = np.zeros((len(maps), 9 + rows.shape[1], rows.shape[2]))
        system[:, :9, -9:], system[:, 9:] = maps, rows
    centred = (system - system.mean(axis=0)).reshape(-1, system.shape[2])
    triangle = np.asarray(np.linalg.qr(centred, mode="r"))
    return np.asarray(np.linalg.svd(triangle[-9:, -9:])[2][-1])


def _rotations(*vectors: FloatArray) -> FloatArray:
    """The (n, 3, 3) rotations of which (9,) vectors are multiples, of the first one's sign."""
    matrices = np.array(vectors).reshape(-1, 3, 3)
    return nearest_rotation(np.copysign(1.0, np.linalg.det(matrices[0])) * matrices)


@_completed
def lone_axis(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """Rotation about one axis only, as of an arm with four axes.

    X's rotation is known up to one about the robot's axis. The robot's translations determine that:
    the target's position is linear in its cosine and sine and in X's translation, whose component
    along the axis remains undetermined, and zero.
    """
    matched = rotation_pairs(robot, camera).matched
    axis, aligned = np.linalg.svd(matched)[0][..., None, :, 0], nearest_rotation(matched)
    seen = _half_way(camera) @ np.swapaxes(aligned, -1, -2)
    along = np.sum(seen * axis, axis=-1, keepdims=True) * axis
    turns = robot[..., :3, :3]
    columns = turns @ np.stack([seen - along, np.cross(axis, seen)], axis=-1)
    system = np.concatenate([columns, turns], axis=-1)
    right = -(robot[..., :3, 3:] + turns @ along[..., None])
    whole = np.concatenate([system, right], axis=-1)
    whole = (whole - whole.mean(axis=-3, keepdims=True)).reshape(*matched.shape[:-2], -1, 6)
    cosine, sine = np.moveaxis((np.linalg.pinv(whole[..., :5]) @ whole[..., 5:])[..., :2, 0], -1, 0)
    turn = np.arctan2(sine, cosine)[..., None] * axis[..., 0, :]
    return np.asarray(
        exp(np.concatenate([turn, np.zeros_like(turn)], axis=-1))[..., :3, :3] @ aligned
    )


def _mean_camera(camera: FloatArray) -> FloatArray:
    """The (..., 3) mean camera centre in the target frame [m], of (..., m, 4, 4) poses."""
    return np.asarray(invert(camera)[..., :3, 3].mean(axis=-2))


def _half_way(camera: FloatArray) -> FloatArray:
    """The (..., m, 3) target's point half-way to the camera; see `complete`."""
    middle = 0.5 * _mean_camera(camera)[..., None, :, None]
    return np.asarray((camera[..., :3, :3] @ middle)[..., 0] + camera[..., :3, 3])


def _smallest_solution(normal: FloatArray, right: FloatArray, noise: float) -> FloatArray:
    """Minimum-norm solution of `normal @ x = right`, without eigenvalues up to the noise.

    `normal` is (..., n, n), positive semidefinite, `right` (n,) or (..., n, k).
    """
    values, vectors = np.linalg.eigh(normal)
    inverse = np.where(values > noise, 1.0 / np.where(values > noise, values, 1.0), 0.0)
    return np.asarray((vectors * inverse[..., None, :]) @ (np.swapaxes(vectors, -1, -2) @ right))


def complete(
    robot: FloatArray,
    camera: FloatArray,
    rotation_x: FloatArray,
    rotation_z: FloatArray | None = None,
) -> HandEye:
    """Solves for both translations and Z's rotation, by least squares over all pairs of views.

    The equation is (A_R - I) t_X = R_X t_B - t_A of Tsai and Lenz (1989), eq. 15. A pair's residual
    is the difference between both views' positions of one target point, so the sum over all pairs
    is m times the scatter of m positions: linear in the number of views. Noise makes the choice of
    that point matter: at the target's origin the robot's rotation noise has the lever from target
    to flange; at the camera's centre the camera's has the same lever. The point between both with
    the least scatter is used.

    Args:
        robot: (..., m, 4, 4) robot poses `R_i` [m].
        camera: (..., m, 4, 4) `cam_from_target` [m].
        rotation_x: (..., 3, 3) rotation of X.
        rotation_z: (..., 3, 3) rotation of Z; if None, the chordal mean of `R_i X C_i`.

    Returns:
        X and Z. Components of X's translation that the motion does not determine are zero.
    """
    *sets, m, _, _ = robot.shape
    turns, rotation_x = robot[..., :3, :3], rotation_x[..., None, :, :]
    towards = _mean_camera(camera)
    # Column 0 is the target's origin; column 1 the step from it to the camera.
    step_to = (camera[..., :3, :3] @ towards[..., None, :, None])[..., 0]
    columns = np.stack([camera[..., :3, 3], step_to], axis=-1)
    positions = turns @ (rotation_x @ columns)
    positions[..., 0] += robot[..., :3, 3]

    mean_turn, mean_position = turns.mean(axis=-3), positions.mean(axis=-3)
    deviations = (turns - mean_turn[..., None, :, :]).reshape(*sets, 3 * m, 3)
    scatter = (positions - mean_position[..., None, :, :]).reshape(*sets, 3 * m, 2)
    # Least rotation (root mean square) about a direction that determines a translation: less is the
    # robot's noise of up to 0.5 mrad, and useful motion begins at 10 mrad.
    cut, transposed = m * 2e-3**2, np.swapaxes(deviations, -1, -2)
    shifts = -_smallest_solution(transposed @ deviations, transposed @ scatter, cut)
    # The step from 0 to 1 that makes column 0 + step * column 1 of the residuals least.
    origin, change = np.moveaxis(scatter + deviations @ shifts, -1, 0)
    square, pulled = np.sum(change**2, axis=-1), -np.sum(origin * change, axis=-1)
    best = np.divide(pulled, square, out=np.full_like(square, 0.5), where=square > 0.0)
    step = np.clip(best, 0.0, 1.0)[..., None]

    translation_x = shifts[..., 0] + step * shifts[..., 1]
    if rotation_z is None:
        rotation_z = nearest_rotation((turns @ rotation_x @ camera[..., :3, :3]).sum(axis=-3))
    position = mean_position[..., 0] + step * mean_position[..., 1]
    position = position + (mean_turn @ translation_x[..., None])[..., 0]
    translation_z = position - (rotation_z @ (step * towards)[..., None])[..., 0]
    x = compose(rotation_x[..., 0, :, :], translation_x)
    return HandEye(x, compose(rotation_z, translation_z))


# Those for general motion; `lone_axis` is for rotation about one axis.
SOLVERS: Mapping[str, Solver] = MappingProxyType(
    {solver.__name__: solver for solver in (tsai, park, horaud, daniilidis, andreff, shah, li)}
)
