"""Inverse dynamics of an arm with known inertias and friction."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import Friction
from visioncal.robot import Robot
from visioncal.robot.inertia import Inertias, parameter_transform
from visioncal.robot.torques import joint_torques
from visioncal.robot.writing import with_inertias


@dataclass(frozen=True, eq=False)
class ArmDynamics:
    """An arm with physically consistent inertias of its links, and the friction of its drives.

    Methods raise DataError where the number of joints differs from the robot's.
    """

    robot: Robot
    inertias: Inertias
    friction: Friction

    @classmethod
    def of(cls, identified: Identified) -> Self:
        """Builds the arm from identified dynamics that have physically consistent links.

        Raises:
            DataError: No link is consistent, because the robot's own inertias were not known.
        """
        robot, parameters = identified.robot, identified.standard.values
        links = 10 * robot.joint_count
        joint_values = dict(
            zip(identified.base.model.names[links:], parameters[links:], strict=True)
        )

        def by_joint(symbol: str) -> FloatArray:
            joints = range(1, robot.joint_count + 1)
            return np.array([joint_values.get(f"{symbol}{joint}", 0.0) for joint in joints])

        humps = identified.stribeck
        hump_nm, hump_speeds = np.zeros(robot.joint_count), np.ones(robot.joint_count)
        hump_nm[humps.joints], hump_speeds[humps.joints] = humps.hump_nm, humps.speed_rad_s
        friction = Friction(
            *(by_joint("Fc"), by_joint("Fv"), by_joint("offset"), by_joint("Ia")),
            *(hump_nm, hump_speeds, identified.base.model.terms.slow_rad_s),
        )
        return cls(robot, Inertias(parameters[:links].reshape(-1, 10)), friction)

    def torques(self, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
        """Drive torques (m, n) [N m] for feedforward; the motion is as in `torque_regressor`."""
        links = joint_torques(self.robot, self.inertias, q, dq, ddq)
        return links + self.friction.torques(np.asarray(dq), np.asarray(ddq))

    def gravity(self, q: FloatArray) -> FloatArray:
        """Gravity torques (m, n) [N m] at (m, n) joint angles [rad]."""
        still = np.zeros_like(q)
        return joint_torques(self.robot, self.inertias, q, still, still)

    def carrying(self, body: FloatArray) -> "ArmDynamics":
        """The arm with a payload of (10,) parameters in the flange's frame, as in `Inertias`."""
        values = self.inertias.values.copy()
        values[-1] += parameter_transform(self.robot.chain.placements[-1]) @ body
        return replace(self, inertias=Inertias(values))

    def weighed(self) -> Robot:
        """The robot with these inertias in its document, where the elastic level reads them."""
        return with_inertias(self.robot, self.inertias)
