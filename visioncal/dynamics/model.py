"""The torques of an arm, with what its drives take, linear in all parameters."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.motion import JointMotion
from visioncal.robot import PARAMETER_NAMES, Robot, torque_regressor

# Below this speed a joint may stick, and its friction has no sign of its own [rad/s].
SLOW_RAD_S = 0.005


def sign(dq: FloatArray, slow_rad_s: float = SLOW_RAD_S) -> FloatArray:
    """The sense of a motion, -1 to 1.

    A joint that stands still may be held by any torque between its friction's bounds, and noise
    lets it seem to move either way: up to `slow_rad_s` the sense grows with the speed, and is zero
    at rest; beyond, it is the sign of the speed.

    Args:
        dq: Speeds [rad/s].
        slow_rad_s: Where the sense is full [rad/s].

    Returns:
        The senses, of the same shape.
    """
    return np.asarray(np.clip(dq / slow_rad_s, -1.0, 1.0))


@dataclass(frozen=True)
class FrictionTerms:
    """Which torques each joint has of its own, beside those of the rigid links.

    Attributes:
        coulomb: `Fc sign(dq)`: dry friction [N m].
        viscous: `Fv dq` [N m s/rad].
        offset: A constant: an asymmetry of friction, or of the measurement [N m].
        motor_inertia: `Ia ddq`: the rotor's inertia, seen through the gear [kg m^2].
        slow_rad_s: See `sign`.
    """

    coulomb: bool = True
    viscous: bool = True
    offset: bool = True
    motor_inertia: bool = False
    slow_rad_s: float = SLOW_RAD_S

    @property
    def symbols(self) -> tuple[str, ...]:
        """The names of one joint's parameters."""
        terms = (
            ("Fc", self.coulomb),
            ("Fv", self.viscous),
            ("offset", self.offset),
            ("Ia", self.motor_inertia),
        )
        return tuple(name for name, there in terms if there)

    def names(self, joints: int) -> tuple[str, ...]:
        """The names of all joints' parameters: Fc1, Fv1, offset1, Fc2, ..."""
        return tuple(
            f"{symbol}{joint}" for joint in range(1, joints + 1) for symbol in self.symbols
        )

    def values(self, motion: JointMotion) -> FloatArray:
        """Derivatives (m, n, k) of each joint's torque by its own k parameters."""
        parts = {
            "Fc": sign(motion.dq, self.slow_rad_s),
            "Fv": motion.dq,
            "offset": np.ones_like(motion.dq),
            "Ia": motion.ddq,
        }
        columns = [parts[symbol] for symbol in self.symbols]
        return np.stack(columns, axis=-1) if columns else np.empty((*motion.dq.shape, 0))

    def columns(self, motion: JointMotion) -> FloatArray:
        """Derivatives (m, n, k n) of the joints' torques by `names`: zero for other joints'."""
        own = self.values(motion)
        count, joints, kinds = own.shape
        columns = np.zeros((count, joints, joints, kinds))
        columns[:, range(joints), range(joints)] = own
        return columns.reshape(count, joints, joints * kinds)


@dataclass(frozen=True, eq=False)
class Friction:
    """What each of n drives takes.

    `(Fc + Fs exp(-(dq / vs)^2)) sign(dq) + Fv dq + offset + Ia ddq`: dry friction that is greater
    where a joint breaks loose (Stribeck's, as in Armstrong-Helouvry, Dupont and Canudas de Wit
    1994), viscous friction, and the rotor's inertia.

    Attributes:
        coulomb: (n,) Fc [N m].
        viscous: (n,) Fv [N m s/rad].
        offset: (n,) [N m].
        motor_inertia: (n,) Ia [kg m^2].
        breaking: (n,) Fs, what breaking loose takes beyond `coulomb` [N m].
        breaking_rad_s: (n,) vs, the speed over which that fades [rad/s].
        slow_rad_s: See `sign`.
    """

    coulomb: FloatArray
    viscous: FloatArray
    offset: FloatArray
    motor_inertia: FloatArray
    breaking: FloatArray
    breaking_rad_s: FloatArray
    slow_rad_s: float = SLOW_RAD_S

    @classmethod
    def none(cls, joints: int) -> Self:
        """No friction at all."""
        nothing = np.zeros(joints)
        return cls(nothing, nothing, nothing, nothing, nothing, np.ones(joints))

    def torques(self, dq: FloatArray, ddq: FloatArray) -> FloatArray:
        """What the drives take at (m, n) speeds and accelerations: (m, n) [N m]."""
        breaking = self.breaking * np.exp(-((dq / self.breaking_rad_s) ** 2))
        dry = (self.coulomb + breaking) * sign(dq, self.slow_rad_s)
        return np.asarray(dry + self.viscous * dq + self.offset + self.motor_inertia * ddq)


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

    def regressor(self, motion: JointMotion, columns: IntArray | None = None) -> FloatArray:
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
