"""Hand-eye solver for rotation about one axis only, as of an arm with four axes.

The relative rotations of robot and camera have one axis each, so X's rotation is known up to a
rotation about the robot's axis. The robot's translations determine that: the target's position in
the robot's frame is linear in the rotation's cosine and sine and in X's translation, whose
component along the axis remains undetermined.
"""

import numpy as np

from visioncal.core.transforms import nearest_rotation
from visioncal.core.types import FloatArray
from visioncal.estimation.closed_form.handeye import HandEye, solver
from visioncal.estimation.closed_form.pairs import rotation_pairs
from visioncal.estimation.closed_form.translation import complete, mean_camera


@solver
def lone_axis(robot: FloatArray, camera: FloatArray) -> HandEye:
    """Solves for X where all relative rotations have one axis; undetermined components are zero."""
    pairs = rotation_pairs(robot, camera)
    matched = (pairs.weight * pairs.robot[1:]) @ pairs.camera[1:].T
    axes, _, _ = np.linalg.svd(matched)
    axis, aligned = axes[:, 0], nearest_rotation(matched)
    # The target's point half-way to the camera: see `closed_form.translation`.
    seen = camera[:, :3, :3] @ (0.5 * mean_camera(camera)) + camera[:, :3, 3]
    seen = seen @ aligned.T
    along = (seen @ axis)[:, None] * axis
    columns = np.stack([seen - along, np.cross(axis, seen)], axis=2)
    turns = robot[:, :3, :3]
    system = np.concatenate([turns @ columns, turns], axis=2)
    right = -(robot[:, :3, 3] + (turns @ along[:, :, None])[:, :, 0])
    system, right = system - system.mean(axis=0), right - right.mean(axis=0)
    cosine, sine = np.linalg.lstsq(system.reshape(-1, 5), right.reshape(-1))[0][:2]
    cross = np.cross(np.eye(3), axis)
    angle = np.arctan2(sine, cosine)
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return complete(robot, camera, turn @ aligned)
