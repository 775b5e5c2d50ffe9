"""An arm whose dynamics are known, put to use: what its drives have to give."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import Friction
from visioncal.robot import Inertias, Robot, joint_torques, momenta, moving, with_inertias


@dataclass(frozen=True, eq=False)
class ArmDynamics:
    """An arm with the inertias of its links and the friction of its drives.

    Attributes:
        robot: The arm.
        inertias: Of its links; those of bodies.
        friction: Of its drives.
    """

    robot: Robot
    inertias: Inertias
    friction: Friction

    @classmethod
    def of(cls, identified: Identified) -> Self:
        """Takes an identified arm, with links that are bodies.

        Raises:
            DataError: Its inertias were not known before, so that there are no bodies.
        """
        robot = identified.robot
        if identified.consistent is None:
            raise DataError(
                f"dynamics: nothing was known of the inertias of {robot.name}, so there are no "
                "links that are bodies.",
                culprits=[robot.name],
                next_step="State mass_kg, com_m and inertia_kg_m2 of its joints, and identify "
                "again.",
            )
        standard = identified.consistent.values
        links = 10 * robot.joint_count
        own = dict(zip(identified.base.model.names[links:], standard[links:], strict=True))

        def of_joints(symbol: str) -> FloatArray:
            joints = range(1, robot.joint_count + 1)
            return np.array([own.get(f"{symbol}{joint}", 0.0) for joint in joints])

        humps = identified.stribeck
        breaking, speeds = np.zeros(robot.joint_count), np.ones(robot.joint_count)
        breaking[humps.joints], speeds[humps.joints] = humps.hump_nm, humps.speed_rad_s
        friction = Friction(
            of_joints("Fc"),
            of_joints("Fv"),
            of_joints("offset"),
            of_joints("Ia"),
            breaking,
            speeds,
            identified.base.model.terms.slow_rad_s,
        )
        return cls(robot, Inertias(standard[:links].reshape(-1, 10)), friction)

    def torques(self, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
        """What the drives have to give for a motion: the torque to feed forward.

        Args:
            q: (m, n) joint angles [rad].
            dq: (m, n) their speeds [rad/s].
            ddq: (m, n) their accelerations [rad/s^2].

        Returns:
            (m, n) [N m].

        Raises:
            DataError: The number of joints differs from the robot's.
        """
        links = joint_torques(self.robot, self.inertias, q, dq, ddq)
        return links + self.friction.torques(np.asarray(dq), np.asarray(ddq))

    def gravity(self, q: FloatArray) -> FloatArray:
        """What holds the arm still against its weight: (m, n) [N m] at (m, n) joint angles.

        Raises:
            DataError: The number of joints differs from the robot's.
        """
        still = np.zeros_like(q)
        return joint_torques(self.robot, self.inertias, q, still, still)

    def momentum(self, q: FloatArray, dq: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The generalised momentum (m, n) [N m s], and its rate without any drive (m, n) [N m].

        The rotors count in the momentum, friction in the rate; see `robot.momenta`.

        Raises:
            DataError: The number of joints differs from the robot's, or an inertia is no body's.
        """
        momentum, rate = momenta(self.robot, self.inertias, q, dq)
        still = np.zeros_like(dq)
        rotors = self.friction.motor_inertia * dq
        return momentum + rotors, rate - self.friction.torques(dq, still)

    def carrying(self, body: FloatArray) -> "ArmDynamics":
        """The arm with a body on its flange.

        Args:
            body: (10,) inertial parameters in the flange's frame, in the order of `Inertias`.
        """
        values = self.inertias.values.copy()
        values[-1] += moving(self.robot.chain.placements[-1]) @ body
        return replace(self, inertias=Inertias(values))

    def weighed(self) -> Robot:
        """The robot whose document states these inertias, as the elastic level uses them."""
        return with_inertias(self.robot, self.inertias)
