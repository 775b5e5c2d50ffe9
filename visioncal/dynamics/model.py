"""The torques of an arm as a function that is linear in all its parameters."""

from dataclasses import dataclass

import numpy as np

from visioncal.dynamics.friction import FrictionTerms
from visioncal.dynamics.motion import Motion
from visioncal.robot import PARAMETER_NAMES, Robot, torque_regressor
from visioncal.types import FloatArray, IntArray


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
        wanted = np.arange(len(self.names)) if columns is None else columns
        first = 10 * self.robot.joint_count
        links = torque_regressor(
            self.robot, motion.q, motion.dq, motion.ddq, wanted[wanted < first]
        )
        own = self.terms.columns(motion)[:, :, wanted[wanted >= first] - first]
        # Parameters before joints, as they are in memory: that is several times faster.
        parts = [np.swapaxes(it, 1, 2) for it in (links, own)]
        return np.swapaxes(np.concatenate(parts, axis=1), 1, 2)
