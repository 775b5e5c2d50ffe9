"""Consistency check of an arm's joint angles and its reported pose."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.live.drivers.protocols import ArmState
from visioncal.robot import Robot

# Greatest deviation of a controller's calibrated arm from the nominal model [m, rad].
_SAME_M, _SAME_RAD = 1e-2, 2e-2
# Largest motion of joints and of a flange that count as still [rad, m].
_STILL_RAD, _STILL_M = 1e-4, 1e-4


@dataclass(eq=False)
class JointPoseCheck:
    """Comparison of poses with the robot's model, up to a constant base or tool.

    It keeps the states so far that were consistent with one another.
    """

    robot: Robot | None  # The nominal model; None where it is not known, and nothing is compared.
    _states: list[ArmState] = field(default_factory=list)

    def why_not(self, state: ArmState) -> str:
        """States why a state's joints and pose are inconsistent; empty where they are not.

        A consistent state is kept.
        """
        if self.robot is None or state.q is None:
            return ""
        if len(state.q) != self.robot.joint_count:
            return (
                f"the arm reports {len(state.q)} joints, and {self.robot.name} has "
                f"{self.robot.joint_count}: check --robot"
            )
        if not self._states:
            self._states.append(state)
            return ""
        shift_m, angle = self._deviation(self.robot, state)
        if shift_m <= _SAME_M and angle <= _SAME_RAD:
            self._states.append(state)
            return ""
        return (
            f"joint angles and pose disagree by {1e3 * shift_m:.0f} mm and "
            f"{np.rad2deg(angle):.1f} deg (limits {1e3 * _SAME_M:.0f} mm and "
            f"{np.rad2deg(_SAME_RAD):.1f} deg): {self._cause(state)}"
        )

    def _deviation(self, robot: Robot, state: ArmState) -> tuple[float, float]:
        """Deviation of a state from the nearest one with which it should share a constant."""
        # With a tool on the flange, `invert(model) @ pose` is constant; with another base,
        # `pose @ invert(model)` is.
        states = [*self._states, state]
        model = robot.base_from_flange(np.array([arm_state.q for arm_state in states]))
        pose = np.array([arm_state.base_from_flange for arm_state in states])
        return min(
            (_distance_to_nearest(value) for value in (invert(model) @ pose, pose @ invert(model))),
            key=lambda pair: pair[0] / _SAME_M + pair[1] / _SAME_RAD,
        )

    def _cause(self, state: ArmState) -> str:
        last = self._states[-1]
        turned = float(np.abs(_joints(state) - _joints(last)).max())
        moved = state.base_from_flange[:3, 3] - last.base_from_flange[:3, 3]
        is_still = float(np.linalg.norm(moved)) < _STILL_M
        if is_still and turned > _STILL_RAD:
            return "the joints turned and the pose stayed, so the pose is stale"
        if turned < _STILL_RAD and not is_still:
            return "the pose changed and the joints stayed, so the joint angles are stale"
        return (
            "one of them is of another moment, the tool was changed on the pendant, or the arm is "
            "no " + (self.robot.name if self.robot is not None else "")
        )


def _joints(state: ArmState) -> FloatArray:
    return np.zeros(0) if state.q is None else state.q


def _distance_to_nearest(constants: Sequence[FloatArray] | FloatArray) -> tuple[float, float]:
    """Distance of the last of some poses (m, 4, 4) to the nearest of the others [m], [rad]."""
    poses = np.asarray(constants)
    differences = invert(poses[:-1]) @ poses[-1]
    shifts, angles = np.linalg.norm(differences[:, :3, 3], axis=1), rotation_angle(differences)
    nearest = int(np.argmin(shifts / _SAME_M + angles / _SAME_RAD))
    return float(shifts[nearest]), float(angles[nearest])
