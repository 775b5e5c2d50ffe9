"""The torques of an arm as a function that is linear in all its parameters."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.friction import FrictionTerms
from visioncal.dynamics.motion import Motion
from visioncal.robot import PARAMETER_NAMES, Robot, torque_regressor


@dataclass(frozen=True, eq=False)
class DynamicModel:
    """`torques = regressor @ parameters`: rigid links, friction and rotors.

    The parameters are ten a link (`Inertias.values`), link by link, and then those of friction,
    joint by joint.

    Attributes:
        robot: The arm.
        terms: What its joints have of their own.
    """

    robot: Robot
    terms: FrictionTerms

    @property
    def names(self) -> tuple[str, ...]:
        """The p parameters: m1, m1*cx1, ..., Izz1, m2, ..., Fc1, Fv1, offset1, Fc2, ..."""
        joints = range(1, self.robot.joint_count + 1)
        links = tuple(name.format(joint) for joint in joints for name in PARAMETER_NAMES)
        return links + self.terms.names(self.robot.joint_count)

    def regressor(self, motion: Motion, columns: IntArray | None = None) -> FloatArray:
        """Derivatives of the torques by the parameters.

        Args:
            motion: At m times.
            columns: (c,) ascending places of the parameters that are wanted; all where None.

        Returns:
            (m, n, c) [N m for a unit of each].

        Raises:
            DataError: The motion is not of as many joints as the arm has.
        """
        robot = self.robot
        wanted = np.arange(len(self.names)) if columns is None else columns
        own = wanted[wanted >= 10 * robot.joint_count] - 10 * robot.joint_count
        links = wanted[: len(wanted) - len(own)]
        # One array for all, parameters before joints: much faster than putting two together.
        rows = np.empty((len(motion), len(wanted), robot.joint_count))
        torque_regressor(robot, motion.q, motion.dq, motion.ddq, links, rows)
        rows[:, len(links) :] = 0.0
        values = self.terms.values(motion)
        for place, column in enumerate(own.tolist(), start=len(links)):
            joint, kind = divmod(column, values.shape[2])
            rows[:, place, joint] = values[:, joint, kind]
        return np.swapaxes(rows, 1, 2)
