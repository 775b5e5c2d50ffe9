"""What a cell's arm must keep away from: itself, floor, board, camera and declared boxes."""

import numpy as np

from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray, Target
from visioncal.live.planning.cell import PlanCell
from visioncal.robot.bodies import Body, arm_bodies, capsule
from visioncal.robot.collision import Collisions
from visioncal.vision.targets import extent_m

# A camera with its lens and plug, as a box about its housing [m].
_CAMERA_M, _CAMERA_BEHIND_M = np.array([0.1, 0.1, 0.1]), 0.03
# The plate under a board, and how far it reaches beyond the print [m].
_PLATE_M, _RIM_M = 0.01, 0.02
# What holds the camera or the board on the flange [m].
_HOLDER_RADIUS_M = 0.02
# Things stand where they are guessed to within so many standard deviations.
_SURELY = 2.0


def collisions_of(cell: PlanCell) -> Collisions:
    """Prepares the distances of a cell.

    What is only guessed, the camera and the board, is kept away from by what the guess may be off,
    besides the clearance.

    Args:
        cell: The cell.

    Returns:
        The distances between the arm, what it carries, and what stands around it.
    """
    hand = cell.robot.joint_count
    in_hand = cell.mount == "eye-in-hand"
    flange = cell.robot.chain.placements[-1]
    held, stands = (cell.x, cell.z) if in_hand else (cell.z, cell.x)
    unsure_m = _SURELY * (cell.sigma_m + cell.sigma_rad * 0.5 * board_size_m(cell.target))
    held_body, standing_body = (_camera, _board) if in_hand else (_board, _camera)
    carried = held_body(cell.target, hand, flange @ held, unsure_m)
    middle = carried.link_from_body[:3, 3]
    bodies = [
        *arm_bodies(cell.robot),
        capsule("holder", hand, flange[:3, 3], middle, _HOLDER_RADIUS_M, unsure_m=unsure_m),
        carried,
        standing_body(cell.target, 0, stands, unsure_m),
        *(Body(box.name, 0, "box", box.size_m, box.base_from_box) for box in cell.boxes),
    ]
    return Collisions(cell.robot, bodies, cell.limits.clearance_m, cell.limits.floor_m)


def board_size_m(target: Target) -> float:
    """The diagonal of the print [m]."""
    low, high = extent_m(target)
    return float(np.linalg.norm(high - low))


def _camera(_: Target, link: int, link_from_cam: FloatArray, unsure_m: float) -> Body:
    behind = compose(np.eye(3), np.array([0.0, 0.0, -_CAMERA_BEHIND_M]))
    return Body("camera", link, "box", _CAMERA_M, link_from_cam @ behind, unsure_m=unsure_m)


def _board(target: Target, link: int, link_from_target: FloatArray, unsure_m: float) -> Body:
    """The plate, whose face is the print."""
    low, high = extent_m(target)
    centre = compose(np.eye(3), np.append(0.5 * (low + high), 0.5 * _PLATE_M))
    size = np.append(high - low + 2.0 * _RIM_M, _PLATE_M)
    return Body("board", link, "box", size, link_from_target @ centre, unsure_m=unsure_m)
