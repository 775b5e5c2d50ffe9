"""Inverse dynamics of an arm with known inertias and friction."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import Friction, Measured
from visioncal.robot import Inertias, Robot, joint_torques, momenta, parameter_transform
from visioncal.robot.writing import with_inertias

# Observer gain: the inverse of the residual's time constant [1/s].
USUAL_GAIN = 25.0


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
        """Builds it from identified dynamics that have physically consistent links.

        Raises:
            DataError: They have none, because the robot's own inertias were not known.
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
        parameters = identified.consistent.values
        links = 10 * robot.joint_count
        own = dict(zip(identified.base.model.names[links:], parameters[links:], strict=True))

        def by_joint(symbol: str) -> FloatArray:
            joints = range(1, robot.joint_count + 1)
            return np.array([own.get(f"{symbol}{joint}", 0.0) for joint in joints])

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

    def momentum(self, q: FloatArray, dq: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Generalised momentum (m, n) [N m s], and its rate without drive torques (m, n) [N m].

        The momentum includes the rotors', the rate friction; see `robot.momenta` and its errors.
        """
        momentum, rate = momenta(self.robot, self.inertias, q, dq)
        still = np.zeros_like(dq)
        rotors = self.friction.motor_inertia * dq
        return momentum + rotors, rate - self.friction.torques(dq, still)

    def carrying(self, body: FloatArray) -> "ArmDynamics":
        """The arm with a payload of (10,) parameters in the flange's frame, as in `Inertias`."""
        values = self.inertias.values.copy()
        values[-1] += parameter_transform(self.robot.chain.placements[-1]) @ body
        return replace(self, inertias=Inertias(values))

    def weighed(self) -> Robot:
        """The robot with these inertias in its document, where the elastic level reads them."""
        return with_inertias(self.robot, self.inertias)


class MomentumObserver:
    """Estimates external torques on the joints of a moving arm, sample by sample.

    The residual r obeys `dr/dt = gain (external torque - r)`, a first-order filter joint by joint.
    It is integrated by implicit Euler steps, which are stable at any sampling rate.
    """

    def __init__(self, arm: ArmDynamics, gain_per_s: float | FloatArray = USUAL_GAIN) -> None:
        """Prepares an observer of an arm with its payload (`ArmDynamics.carrying`).

        The gain is the inverse time constant of the residual, one for all joints or (n,) [1/s];
        others than numbers above 0 raise DataError.
        """
        gain = np.broadcast_to(np.asarray(gain_per_s, dtype=float), (arm.robot.joint_count,))
        if not (np.isfinite(gain).all() and (gain > 0.0).all()):
            raise DataError(
                f"gain_per_s is {gain_per_s}; numbers above 0 are needed.", culprits=["gain_per_s"]
            )
        self._arm, self._gain = arm, gain
        self._time_s: float | None = None
        self._initial = self._integral = self._rate = self._residual = np.zeros(len(gain))

    def update(
        self, time_s: float, q: FloatArray, dq: FloatArray, torques_nm: FloatArray
    ) -> FloatArray:
        """Updates the residual with a sample.

        Args:
            time_s: Time [s], later than the sample before.
            q: (n,) joint angles [rad].
            dq: (n,) their speeds [rad/s].
            torques_nm: (n,) drive torques [N m].

        Returns:
            (n,) external torques, positive in the joints' sense [N m].

        Raises:
            DataError: Times do not ascend, or a shape is wrong.
        """
        rows = (np.asarray(array, dtype=float)[None] for array in (q, dq))
        momentum, rate = (array[0] for array in self._arm.momentum(*rows))
        return self._step(time_s, momentum, rate + torques_nm)

    def _step(self, time_s: float, momentum: FloatArray, rate: FloatArray) -> FloatArray:
        """Residual after a sample with its momentum and the momentum's known rate."""
        if self._time_s is None:
            self._initial = momentum
        else:
            step_s = time_s - self._time_s
            if not step_s > 0.0:
                raise DataError(
                    f"the sample at {time_s:g} s does not follow that at {self._time_s:g} s; "
                    "ascending times are needed.",
                    culprits=["time_s"],
                )
            # The known rate is integrated by the trapezoidal rule, the residual by its new value.
            integral = self._integral + 0.5 * step_s * (self._rate + rate)
            unexplained = momentum - self._initial - integral
            self._residual = self._gain * unexplained / (1.0 + self._gain * step_s)
            self._integral = integral + step_s * self._residual
        self._time_s, self._rate = time_s, rate
        return self._residual


def external_torques(
    arm: ArmDynamics, measured: Measured, gain_per_s: float | FloatArray = USUAL_GAIN
) -> FloatArray:
    """External torques on the joints during a recorded motion; see `MomentumObserver`.

    Accelerations are not used.

    Returns:
        (m, n) positive in the joints' sense [N m]; zero at the first sample.

    Raises:
        DataError: As for `MomentumObserver`.
    """
    observer = MomentumObserver(arm, gain_per_s)
    motion = measured.motion
    momentum, rate = arm.momentum(motion.q, motion.dq)
    samples = zip(motion.times_s.tolist(), momentum, rate + measured.torques_nm, strict=True)
    return np.array([observer._step(*sample) for sample in samples])
