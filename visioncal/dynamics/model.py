"""Joint motions, and the torques of links, friction and rotors, linear in the parameters."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows
from visioncal.robot import Robot
from visioncal.robot.inertia import PARAMETER_NAMES
from visioncal.robot.torques import torque_regressor

# Below this speed a joint may stick, and the sign of its friction is undefined [rad/s].
SLOW_RAD_S = 0.005


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Positions, speeds and accelerations of n joints at m times."""

    times_s: FloatArray  # (m,) ascending [s].
    q: FloatArray  # (m, n) joint angles [rad].
    dq: FloatArray  # (m, n) their speeds [rad/s].
    ddq: FloatArray  # (m, n) their accelerations [rad/s^2].

    def __len__(self) -> int:
        return len(self.times_s)

    def chosen(self, rows: slice | IntArray | Mask) -> "JointMotion":
        """The samples of given rows."""
        return chosen_rows(self, rows)


@dataclass(frozen=True, eq=False)
class Measured:
    """A motion, and the torques (m, n) of the joints measured during it [N m]."""

    motion: JointMotion
    torques_nm: FloatArray

    def __len__(self) -> int:
        return len(self.motion)

    def chosen(self, rows: slice | IntArray | Mask) -> "Measured":
        """The samples of given rows."""
        return Measured(self.motion.chosen(rows), self.torques_nm[rows])


def sign(dq: FloatArray, slow_rad_s: float = SLOW_RAD_S) -> FloatArray:
    """Sign of a speed, linear within `slow_rad_s`: -1 to 1, of the same shape.

    Static friction may have any value between its bounds, and noise changes the sign of a speed
    that is near zero.

    Args:
        dq: Speeds [rad/s].
        slow_rad_s: From which speed on the sign is full [rad/s].
    """
    return np.asarray(np.clip(dq / slow_rad_s, -1.0, 1.0))


@dataclass(frozen=True)
class FrictionTerms:
    """Torque terms of each joint beside those of the rigid links."""

    coulomb: bool = True  # `Fc sign(dq)`: dry friction [N m].
    viscous: bool = True  # `Fv dq` [N m s/rad].
    offset: bool = True  # A constant: asymmetry of friction, or offset of the measurement [N m].
    # `Ia ddq`: the rotor's inertia on the joint's side of the gear [kg m^2].
    motor_inertia: bool = False
    slow_rad_s: float = SLOW_RAD_S  # See `sign`.

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of one joint's parameters."""
        terms = (
            ("Fc", self.coulomb),
            ("Fv", self.viscous),
            ("offset", self.offset),
            ("Ia", self.motor_inertia),
        )
        return tuple(name for name, is_fitted in terms if is_fitted)

    def names(self, joints: int) -> tuple[str, ...]:
        """Names of all joints' parameters: Fc1, Fv1, offset1, Fc2, ..."""
        return tuple(
            f"{symbol}{joint}" for joint in range(1, joints + 1) for symbol in self.symbols
        )

    def values(self, motion: JointMotion) -> FloatArray:
        """Derivatives (m, n, k) of each joint's torque over its own k parameters."""
        parts = {
            "Fc": sign(motion.dq, self.slow_rad_s),
            "Fv": motion.dq,
            "offset": np.ones_like(motion.dq),
            "Ia": motion.ddq,
        }
        columns = [parts[symbol] for symbol in self.symbols]
        return np.stack(columns, axis=-1) if columns else np.empty((*motion.dq.shape, 0))

    def columns(self, motion: JointMotion) -> FloatArray:
        """Regressor (m, n, k n) of the parameters `names`: zero for those of other joints."""
        joint_values = self.values(motion)
        count, joints, kinds = joint_values.shape
        columns = np.zeros((count, joints, joints, kinds))
        columns[:, range(joints), range(joints)] = joint_values
        return columns.reshape(count, joints, joints * kinds)


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction and rotor inertia of n drives.

    `(Fc + Fs exp(-(dq / vs)^2)) sign(dq) + Fv dq + offset + Ia ddq`: dry friction with Stribeck's
    increase at low speed (as in Armstrong-Helouvry, Dupont and Canudas de Wit 1994), viscous
    friction, and the rotor's inertia.
    """

    coulomb: FloatArray  # (n,) Fc [N m].
    viscous: FloatArray  # (n,) Fv [N m s/rad].
    offset: FloatArray  # (n,) [N m].
    motor_inertia: FloatArray  # (n,) Ia [kg m^2].
    breaking: FloatArray  # (n,) Fs, breakaway torque in excess of `coulomb` [N m].
    breaking_rad_s: FloatArray  # (n,) vs, Stribeck speed [rad/s].
    slow_rad_s: float = SLOW_RAD_S  # See `sign`.

    def torques(self, dq: FloatArray, ddq: FloatArray) -> FloatArray:
        """Torques (m, n) at (m, n) speeds and accelerations [N m]."""
        breaking = self.breaking * np.exp(-((dq / self.breaking_rad_s) ** 2))
        dry = (self.coulomb + breaking) * sign(dq, self.slow_rad_s)
        return np.asarray(dry + self.viscous * dq + self.offset + self.motor_inertia * ddq)


@dataclass(frozen=True, eq=False)
class DynamicModel:
    """`torques = regressor @ parameters`: rigid links, friction and rotors of a robot.

    The parameters are ten a link (`Inertias.values`), link by link, and then those of the joints'
    own terms, joint by joint.
    """

    robot: Robot
    terms: FrictionTerms

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p parameters: m1, m1*cx1, ..., Izz1, m2, ..., Fc1, Fv1, offset1, Fc2, ..."""
        joints = range(1, self.robot.joint_count + 1)
        links = tuple(name.format(joint) for joint in joints for name in PARAMETER_NAMES)
        return links + self.terms.names(self.robot.joint_count)

    def regressor(self, motion: JointMotion, columns: IntArray | None = None) -> FloatArray:
        """Regressor (m, n, c) of the torques at m times.

        Columns are (c,) ascending indices of the parameters, or all where None.

        Raises:
            DataError: The number of joints differs from the arm's.
        """
        robot = self.robot
        wanted = np.arange(len(self.names)) if columns is None else columns
        joint_columns = wanted[wanted >= 10 * robot.joint_count] - 10 * robot.joint_count
        links = wanted[: len(wanted) - len(joint_columns)]
        # One array, parameters before joints: much faster than concatenating two.
        rows = np.empty((len(motion), len(wanted), robot.joint_count))
        torque_regressor(robot, motion.q, motion.dq, motion.ddq, links, rows)
        rows[:, len(links) :] = 0.0
        values = self.terms.values(motion)
        for place, column in enumerate(joint_columns.tolist(), start=len(links)):
            joint, kind = divmod(column, values.shape[2])
            rows[:, place, joint] = values[:, joint, kind]
        return np.swapaxes(rows, 1, 2)
