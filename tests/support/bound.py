"""The Cramer-Rao bound of a simulated cell whose arm is unknown, by code of its own.

Unknown are both edges, the flange's error at every view (with its variance as a prior), lens and
board where they are not as stated, and the parameters of the arm, which are those of the
simulation, with the variances they were drawn from (van Trees 1968, section 2.4). Derivatives are
central differences of the simulation's projection, which shares nothing with the application's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import adjoint, exp, invert, log
from visioncal.core.types import Camera, FloatArray, IntArray
from visioncal.simulation import SimulatedCell, forward
from visioncal.simulation.arms import load_torques, loaded_joints
from visioncal.simulation.boards import Sheet, centre_m, corners_m
from visioncal.simulation.optics import project

# Small enough for central differences to be exact to 1e-8, large enough for rounding.
_STEP = 1e-5
# Springs count by how far they bend under so much [N m].
_TORQUE_NM = 100.0
# Exponents of what a board may be bent by.
_BENDS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


def _jacobian(function: Callable[[FloatArray], FloatArray], size: int) -> FloatArray:
    if not size:
        return np.zeros((len(function(np.zeros(0))), 0))
    steps = _STEP * np.eye(size)
    return np.stack([(function(step) - function(-step)) / (2 * _STEP) for step in steps], axis=1)


def workspace_bound_m(cell: SimulatedCell, q: FloatArray) -> float:
    """Least root mean square error of what the arm carries, seen from what stands still [m].

    That is the camera's place seen from the target, or the target's middle seen from the camera.

    Both edges, all parameters of the arm and the flange's error at every view are unknown; with
    them lens and board, where they are not as stated. Gears that ripple add to the flange's error.

    Args:
        cell: The cell.
        q: (k, n) postures at which the error counts, as the encoders have them [rad].
    """
    covariance = _arm_bound(cell)
    at = np.zeros(3) if cell.options.mount == "eye-in-hand" else centre_m(cell.board())
    turn = np.concatenate([np.cross(at, np.eye(3)), np.eye(3)], axis=1)
    stood = [_held(cell, value) for value in q]
    jacobian = [turn @ _carried(cell, held) @ _pose_jacobian(cell, held) for held in stood]
    return float(np.sqrt(np.mean([np.trace(value @ covariance @ value.T) for value in jacobian])))


def compliance_bound(cell: SimulatedCell) -> FloatArray:
    """Least standard deviations (n,) of what the joints yield to a torque [rad/(N m)].

    Beside all that `workspace_bound_m` has unknown. Of the springs no more is known beforehand than
    how stiff the softest is.
    """
    return np.sqrt(np.diag(_arm_bound(cell))[-cell.robot.arm.a.size :]) / _TORQUE_NM


def _arm_bound(cell: SimulatedCell) -> FloatArray:
    """Least covariance of x, z and the arm's parameters, those of its springs last."""
    arm, look = _arm_sigmas(cell), _look_sigmas(cell)
    size = 12 + len(arm)
    information = np.diag(np.concatenate([np.zeros(12), arm**-2.0, look**-2.0]))
    for view, pose in enumerate(cell.cam_from_target):
        seen, held = cell.corners[view].ids, _held(cell, cell.robot.joints[view], view)
        by_pose = _jacobian(
            lambda value, pose=pose, seen=seen: _seen(cell, pose @ exp(value), seen), 6
        )
        by_look = _jacobian(
            lambda value, pose=pose, seen=seen: _seen(cell, pose, seen, value), len(look)
        )
        moved, flange_jacobian = np.split(_pose_jacobian(cell, held, slack=True), [size], axis=1)
        jacobian = np.hstack([by_pose @ moved, by_look]) / cell.options.pixel_sigma_px
        by_slack = by_pose @ flange_jacobian / cell.options.pixel_sigma_px
        between = by_slack.T @ jacobian
        own = by_slack.T @ by_slack + np.linalg.inv(_slack(cell, held))
        information += jacobian.T @ jacobian - between.T @ np.linalg.solve(own, between)
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(covariance[:size, :size])


def _slack(cell: SimulatedCell, held: "_Held") -> FloatArray:
    """Covariance (6, 6) of the flange's error at a stop: what it does not repeat, and ripple."""
    options, arm, q = cell.options, cell.robot.true_arm, held.standing
    covariance = np.diag(np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3) ** 2)
    middle = invert(forward(arm, q[None])[0])
    turned = _jacobian(lambda array: log(middle @ forward(arm, (q + array)[None])[0]), len(q))
    return np.asarray(covariance + options.ripple_sigma_rad**2 * turned @ turned.T)


def _look_sigmas(cell: SimulatedCell) -> FloatArray:
    """Standard deviations of lens and board; empty where they are as stated.

    The board is known as any printed one is: its size as stated, its sides to 0.1 %, and its bend
    to a hundredth of its size. Of the lens nothing is.
    """
    options, target = cell.options, cell.options.target
    if not options.board_bow_m and not options.lens_mismatch_px:
        return np.zeros(0)
    lens = np.full(4 + len(options.camera.distortion), np.inf)
    half = 0.5 * target.square_m * max(target.columns, target.rows)
    sides = [target.square_sigma_m / target.square_m, 1e-3]
    return np.concatenate([lens, sides, np.full(len(_BENDS), 1e-2 * half)])


@dataclass(frozen=True, eq=False)
class _Held:
    """Where the joints stand under their loads, (n,) [rad], and the torques on them [N m].

    Other errors of the arm change the torques by as little as they are: that is left out.
    """

    standing: FloatArray
    torques: FloatArray


def _held(cell: SimulatedCell, q: FloatArray, view: int | None = None) -> _Held:
    """The joints (n,) at a stop, with what it carried at a view."""
    options, arm = cell.options, cell.robot.true_arm
    if not options.compliance_rad_per_nm:
        return _Held(q, np.zeros(len(q)))
    load = () if view is None else cell.robot.loads[view : view + 1]
    standing = loaded_joints(arm, options.compliance_rad_per_nm, q[None], load)
    return _Held(standing[0], load_torques(arm, standing, load)[0])


def _carried(cell: SimulatedCell, held: _Held) -> FloatArray:
    """(6, 6) from motions of the target seen from the camera to those of what the arm carries."""
    if cell.options.mount == "eye-to-hand":
        return np.eye(6)
    return adjoint(_pose(cell, held, np.zeros(12 + len(_arm_sigmas(cell)))))


def _arm_sigmas(cell: SimulatedCell) -> FloatArray:
    """Standard deviations of a, d, alpha, beta, the joints' offsets, waves and springs, (n,) each.

    A spring's is how far it bends under `_TORQUE_NM`. Waves are those of eccentric joints.
    """
    options, count = cell.options, cell.robot.arm.a.size
    offset = np.hypot(options.dh_sigma_rad, options.offset_sigma_rad)
    each = [options.dh_sigma_m] * 2 + [options.dh_sigma_rad] * 2 + [offset]
    if options.eccentricity_sigma_rad:
        each += [options.eccentricity_sigma_rad] * 2
    if cell.options.compliance_rad_per_nm:
        each.append(_TORQUE_NM * max(cell.options.compliance_rad_per_nm))
    return np.repeat(each, count)


def _pose_jacobian(cell: SimulatedCell, held: _Held, *, slack: bool = False) -> FloatArray:
    """How `cam_from_target` (6) moves with x, z and the arm, and with the flange's error."""
    size = 12 + len(_arm_sigmas(cell)) + (6 if slack else 0)
    middle = invert(_pose(cell, held, np.zeros(size)))
    return _jacobian(lambda array: log(middle @ _pose(cell, held, array)), size)


def _pose(cell: SimulatedCell, held: _Held, change: FloatArray) -> FloatArray:
    arm, count = cell.robot.true_arm, cell.robot.arm.a.size
    a, d, alpha, beta, offset = change[12 : 12 + 5 * count].reshape(5, count)
    moved = replace(
        arm,
        a=arm.a + a,
        d=arm.d + d,
        alpha=arm.alpha + alpha,
        beta=arm.beta + beta,
        offset=arm.offset + offset,
    )
    rest, standing = change[12 + 5 * count :], held.standing
    if cell.options.eccentricity_sigma_rad:
        turned, rest = rest[: 2 * count].reshape(2, count), rest[2 * count :]
        moved = replace(moved, waves=arm.waves + np.vstack([turned, np.zeros((2, count))]))
    if cell.options.compliance_rad_per_nm:
        standing, rest = standing + rest[:count] / _TORQUE_NM * held.torques, rest[count:]
    flange = forward(moved, standing[None])[0] @ exp(rest if len(rest) else np.zeros(6))
    x, z = cell.transforms.values()
    robot = flange if cell.options.mount == "eye-in-hand" else invert(flange)
    return invert(robot @ x @ exp(change[:6])) @ z @ exp(change[6:12])


def _seen(
    cell: SimulatedCell, pose: FloatArray, ids: IntArray, look: Sequence[float] = ()
) -> FloatArray:
    """Flat pixels of some corners, where lens and board (`_look_sigmas`) change."""
    camera = cell.options.camera
    points = corners_m(Sheet(target=cell.options.target))[ids]
    if len(look):
        own, (scale, aspect, *bends) = np.split(look, [4 + len(camera.distortion)])
        camera = _other_lens(camera, own)
        points = points * [1.0 + scale - 0.5 * aspect, 1.0 + scale + 0.5 * aspect, 1.0]
        u, v = (points - centre_m(cell.board()))[:, :2].T / np.abs(points[:, :2]).max()
        points[:, 2] += sum(by * u**a * v**b for by, (a, b) in zip(bends, _BENDS, strict=True))
    return project(camera, points @ pose[:3, :3].T + pose[:3, 3]).ravel()


def _other_lens(camera: Camera, change: FloatArray) -> Camera:
    """The camera with other intrinsics: focal length and centre change by thousands of pixels.

    So one step suits all of them.
    """
    values = np.concatenate([camera.matrix, camera.distortion])
    values = values + change * np.where(np.arange(len(values)) < 4, 1e3, 1.0)
    return replace(camera, matrix=values[:4], distortion=values[4:])
