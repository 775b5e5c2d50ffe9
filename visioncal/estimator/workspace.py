"""What a calibrated arm is worth where it was not measured: the whole workspace."""

from dataclasses import dataclass

import numpy as np

from visioncal.estimator.armmodel import ArmModel
from visioncal.estimator.closure import Edges
from visioncal.robot import Robot
from visioncal.transforms import adjoint, invert
from visioncal.types import FloatArray, Mount

# Postures that stand for the workspace, and how far a joint without limits turns.
_POSTURES, _TURN_RAD = 400, np.pi
# Directions that move the flange by less than this share of the best told are not told at all.
_LEAST_SHARE = 1e-7


@dataclass(frozen=True, eq=False)
class Observability:
    """What poses of the target in the camera can tell of an arm.

    Attributes:
        columns: How many values are carried: both edges and the arm's errors.
        rank: How many of them any posture tells apart.
        told: How many of them the used stops tell apart.
        condition: Largest over smallest singular value of what is told, in units of the errors'
            standard deviations.
    """

    columns: int
    rank: int
    told: int
    condition: float


def postures(robot: Robot, count: int = _POSTURES) -> FloatArray:
    """(k, n) joint angles all over the workspace, above the base's plane [rad]."""
    rng = np.random.default_rng(0)
    lower = np.maximum(robot.lower_rad, -_TURN_RAD)
    upper = np.minimum(robot.upper_rad, _TURN_RAD)
    q = rng.uniform(lower, upper, (count, robot.joint_count))
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
    flange, moved = model.robot.base_from_flange(q), model.basis(q)
    if mount == "eye-in-hand":
        target_from_flange = invert(edges.z) @ flange
        cam_from_target = invert(target_from_flange @ edges.x)
        by_arm = -adjoint(target_from_flange) @ moved
        by_z = np.broadcast_to(np.eye(6), (len(q), 6, 6))
    else:
        cam_from_target = invert(edges.x) @ flange @ edges.z
        by_arm = adjoint(invert(edges.z)) @ moved
        by_z = np.broadcast_to(np.eye(6), (len(q), 6, 6))
    by_x = -adjoint(invert(cam_from_target))
    return np.concatenate([by_x, by_z, by_arm], axis=2)


def workspace_sigmas(
    model: ArmModel, edges: Edges, mount: Mount, spread: FloatArray, at: FloatArray
) -> FloatArray:
    """Predicted sigma of a tool's place all over the workspace.

    Args:
        model: The arm.
        edges: x and z.
        mount: Where the camera is.
        spread: (12 + p, 12 + p) covariance of both edges and the arm's errors.
        at: (3,) the point that is looked at, in the target's frame [m].

    Returns:
        (k,) root of the trace of the point's covariance at each of k postures [m].
    """
    slopes = pose_slopes(model, edges, mount, postures(model.robot))
    turn = np.cross(np.eye(3), at)
    place = np.concatenate([turn, np.eye(3)], axis=1) @ slopes
    return np.asarray(np.sqrt(np.einsum("mij,jk,mik->m", place, spread, place)))


def observability(
    model: ArmModel, edges: Edges, mount: Mount, q: FloatArray, sigmas: FloatArray
) -> Observability:
    """Counts what the stops tell, and what any stops could.

    Args:
        model: The arm.
        edges: x and z.
        mount: Where the camera is.
        q: (m, n) joint angles of the stops [rad].
        sigmas: (12 + p,) what one unit of each value is.
    """
    everywhere = _singular(model, edges, mount, postures(model.robot), sigmas)
    here = _singular(model, edges, mount, q, sigmas)
    told = here[here > _LEAST_SHARE * here[0]]
    return Observability(
        len(sigmas),
        int(np.sum(everywhere > _LEAST_SHARE * everywhere[0])),
        len(told),
        float(told[0] / told[-1]),
    )


def _singular(
    model: ArmModel, edges: Edges, mount: Mount, q: FloatArray, sigmas: FloatArray
) -> FloatArray:
    slopes = pose_slopes(model, edges, mount, q).reshape(-1, len(sigmas)) * sigmas
    return np.asarray(np.linalg.svd(slopes, compute_uv=False))
