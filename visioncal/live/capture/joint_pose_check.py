"""Whether an arm's joint angles and its pose belong together."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.live.drivers.protocols import ArmState
from visioncal.robot import Robot

# A controller that knows its own arm's calibration departs from the nominal model by less.
_SAME_M, _SAME_RAD = 1e-2, 2e-2
# Joints that turned by less, and a flange that moved by less, stood still [rad, m].
_STOOD_RAD, _STOOD_M = 1e-4, 1e-4


@dataclass(eq=False)
class JointPoseCheck:
    """Compares poses with the robot's model, up to a base or a tool that stays the same.

    Of the states so far it keeps those that agreed with one another.

    Attributes:
        robot: The nominal model; None where it is not known, and nothing is compared.
    """

    robot: Robot | None
    _states: list[ArmState] = field(default_factory=list)

    def why_not(self, state: ArmState) -> str:
        """Says why a state's joints and pose cannot both be right; empty where they can.

        A state that agrees is remembered.
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
        shift_m, angle = self._away(self.robot, state)
        if shift_m <= _SAME_M and angle <= _SAME_RAD:
            self._states.append(state)
            return ""
        return (
            f"joint angles and pose disagree by {1e3 * shift_m:.0f} mm and "
            f"{np.rad2deg(angle):.1f} deg (limits {1e3 * _SAME_M:.0f} mm and "
            f"{np.rad2deg(_SAME_RAD):.1f} deg): {self._cause(state)}"
        )

    def _away(self, robot: Robot, state: ArmState) -> tuple[float, float]:
        """How far a state is from the nearest other one that it should share a constant with."""
        # With a tool of whatever kind on the flange, `invert(model) @ pose` is the same for all;
        # with another base, `pose @ invert(model)` is.
        states = [*self._states, state]
        model = robot.base_from_flange(np.array([arm_state.q for arm_state in states]))
        pose = np.array([arm_state.base_from_flange for arm_state in states])
        return min(
            (_nearest(value) for value in (invert(model) @ pose, pose @ invert(model))),
            key=lambda pair: pair[0] / _SAME_M + pair[1] / _SAME_RAD,
        )

    def _cause(self, state: ArmState) -> str:
        last = self._states[-1]
        turned = float(np.abs(_joints(state) - _joints(last)).max())
        moved = state.base_from_flange[:3, 3] - last.base_from_flange[:3, 3]
        stood = float(np.linalg.norm(moved)) < _STOOD_M
        if stood and turned > _STOOD_RAD:
            return "the joints turned and the pose stayed, so the pose is stale"
        if turned < _STOOD_RAD and not stood:
            return "the pose changed and the joints stayed, so the joint angles are stale"
        return (
            "one of them is of another moment, the tool was changed on the pendant, or the arm is "
            "no " + (self.robot.name if self.robot is not None else "")
        )


def _joints(state: ArmState) -> FloatArray:
    return np.zeros(0) if state.q is None else state.q


def _nearest(constants: Sequence[FloatArray] | FloatArray) -> tuple[float, float]:
    """How far the last of some poses (m, 4, 4) is from the nearest of the others [m], [rad]."""
    found = np.asarray(constants)
    apart = invert(found[:-1]) @ found[-1]
    shifts, angles = np.linalg.norm(apart[:, :3, 3], axis=1), rotation_angle(apart)
    nearest = int(np.argmin(shifts / _SAME_M + angles / _SAME_RAD))
    return float(shifts[nearest]), float(angles[nearest])
