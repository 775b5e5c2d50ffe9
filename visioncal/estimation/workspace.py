"""What a calibrated arm is worth where it was not measured: the whole workspace."""

import numpy as np

from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.closure import Edges
from visioncal.robot import Robot
from visioncal.transforms import adjoint, invert, skew
from visioncal.types import FloatArray, Mount

# Postures that stand for the workspace, and how far a joint without limits turns.
_POSTURES, _TURN_RAD = 400, np.pi


def turning_range(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """How far joints turn (or move), at most half a turn either way: (n,) least and greatest."""
    return np.maximum(robot.lower_rad, -_TURN_RAD), np.minimum(robot.upper_rad, _TURN_RAD)


def postures(robot: Robot, count: int = _POSTURES) -> FloatArray:
    """(k, n) joint angles all over the workspace, above the base's plane [rad]."""
    rng = np.random.default_rng(0)
    q = rng.uniform(*turning_range(robot), (count, robot.joint_count))
    above = robot.base_from_flange(q)[:, 2, 3] > 0.0
    # A positioner may hang below the plane altogether.
    return q[above] if above.any() else q


def pose_slopes(model: ArmModel, edges: Edges, mount: Mount, q: FloatArray) -> FloatArray:
    """How the predicted pose of the target moves with both edges and the arm's errors.

    No frame of the arm's own is in it: what shifts the base or the flange alone moves nothing.

    Args:
        model: The arm.
        edges: x and z.
        mount: Where the camera is.
        q: (m, n) joint angles [rad].

    Returns:
        (m, 6, 12 + p) right perturbations of `cam_from_target`.
    """
    return chain_slopes(edges, mount, model.base_from_flange(q), model.basis(q))


def chain_slopes(
    edges: Edges, mount: Mount, base_from_flange: FloatArray, moved: FloatArray
) -> FloatArray:
    """How the predicted pose of the target moves with both edges and with anything of the arm.

    Args:
        edges: x and z.
        mount: Where the camera is.
        base_from_flange: (m, 4, 4) the flange.
        moved: (m, 6, p) its right perturbations.

    Returns:
        (m, 6, 12 + p) right perturbations of `cam_from_target`.
    """
    cam_from_target = _cam_from_target(edges, mount, base_from_flange)
    if mount == "eye-in-hand":
        by_arm = -adjoint(invert(edges.z) @ base_from_flange) @ moved
    else:
        by_arm = adjoint(invert(edges.z)) @ moved
    by_z = np.broadcast_to(np.eye(6), (len(moved), 6, 6))
    by_x = -adjoint(invert(cam_from_target))
    return np.concatenate([by_x, by_z, by_arm], axis=2)


def tool_slopes(
    model: ArmModel, edges: Edges, mount: Mount, at: FloatArray, q: FloatArray
) -> FloatArray:
    """How the place of what the flange carries moves, seen from what stands still.

    That is the camera's centre, seen from the target, or a point of the target, seen from the
    camera.

    Args:
        model: The arm.
        edges: x and z.
        mount: Where the camera is.
        at: (3,) the point of a target that the flange carries, in its frame [m].
        q: (m, n) joint angles [rad].

    Returns:
        (m, 3, 12 + p) derivatives of its place, up to a rotation [m].
    """
    slopes = pose_slopes(model, edges, mount, q)
    if mount == "eye-in-hand":
        flange = model.base_from_flange(q)
        at = invert(_cam_from_target(edges, mount, flange))[:, :3, 3]
    turned = -skew(np.broadcast_to(at, (len(q), 3))) @ slopes[:, :3]
    return np.asarray(turned + slopes[:, 3:])


def _cam_from_target(edges: Edges, mount: Mount, base_from_flange: FloatArray) -> FloatArray:
    if mount == "eye-in-hand":
        return invert(base_from_flange @ edges.x) @ edges.z
    return np.asarray(invert(edges.x) @ base_from_flange @ edges.z)
