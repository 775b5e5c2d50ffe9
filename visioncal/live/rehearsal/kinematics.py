"""The controller's own reckoning with poses: x, y, z [m] and a rotation vector [rad].

The arm is the simulation's, the one that the controller believes in.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from visioncal.core.types import FloatArray
from visioncal.live.rehearsal.machine import Machine
from visioncal.simulation.arms import forward, inverse

# Postures under a straight line of the tool.
_KNOTS = 64


def matrix_of(pose: FloatArray | Sequence[float]) -> FloatArray:
    """(4, 4) of six numbers."""
    numbers = np.asarray(pose, dtype=float)
    turn = Rotation.from_rotvec(numbers[3:])
    return np.asarray(RigidTransform.from_components(numbers[:3], turn).as_matrix())


def pose_of(matrix: FloatArray) -> FloatArray:
    """(6,) of a matrix."""
    turn = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([matrix[:3, 3], turn])


def tool_pose(machine: Machine, q: FloatArray) -> FloatArray:
    """(6,) the tool's pose in a posture [rad], with the offset that is set."""
    return flange_pose(machine, q, machine.tcp)


def flange_pose(machine: Machine, q: FloatArray, tcp: FloatArray | Sequence[float]) -> FloatArray:
    """(6,) the pose of a tool that sits on the flange at `tcp`."""
    return pose_of(forward(machine.believed, q[None])[0] @ matrix_of(tcp))


def posture(machine: Machine, pose: FloatArray, near: FloatArray) -> FloatArray | None:
    """(n,) joint angles for a pose of the tool, near others [rad]; None out of reach."""
    base_from_flange = matrix_of(pose) @ np.linalg.inv(matrix_of(machine.tcp))
    reach = inverse(machine.believed, base_from_flange[None], near[None])
    return reach.joints[0] if reach.solved[0] else None


def postures_to(
    machine: Machine, pose: FloatArray, start: FloatArray
) -> tuple[list[FloatArray], float]:
    """The postures under a straight line of the tool, and its length.

    Args:
        machine: The arm.
        pose: (6,) the line's end.
        start: (n,) the posture at its start [rad].

    Returns:
        The postures, none where the line leaves the reach, and the length [m]; of a turn on the
        spot, its angle [rad].
    """
    begin = tool_pose(machine, start)
    turns = Rotation.from_rotvec([begin[3:], pose[3:]])
    distance = float(np.linalg.norm(pose[:3] - begin[:3])) or float(
        (turns[0].inv() * turns[1]).magnitude()
    )
    knots = [start]
    between = Slerp([0.0, 1.0], turns)
    for share in np.linspace(0.0, 1.0, _KNOTS)[1:]:
        place = begin[:3] + share * (pose[:3] - begin[:3])
        next_knot = posture(machine, np.concatenate([place, between(share).as_rotvec()]), knots[-1])
        if next_knot is None:
            return [], distance
        knots.append(next_knot)
    return knots, distance
